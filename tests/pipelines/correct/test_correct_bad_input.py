"""Odd and bad scenes go through the correct job, flow included: each is one row of scenes or of failures, and it is said why."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from models.physics_corrector.flow.checkpoint import DEFAULT_WEIGHTS
from models.point_encoder import save as save_encoder
from models.point_encoder.checkpoint import DEFAULT_WEIGHTS as ENCODER
from pipelines.correct.job import correct
from pipelines.correct.settings import CorrectSettings
from pipelines.edit.settings import EditSettings
from pipelines.execution.ray_executor import WorkerPool
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset, write_annotations, write_scene
from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder
from tests.models.point_encoder.clouds import tiny_encoder

SETTINGS = CorrectSettings(num_pictures=0, position_convention="box_centre", write_dataset=False, fixed="stays_a,stays_b")


@pytest.fixture(scope="module")
def odd(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One scene for each thing that may be wrong."""
    root = tmp_path_factory.mktemp("odd") / "data"
    source = MesaTaskDataset(dataset)
    write_annotations(root, source.annotations)
    shutil.copytree(dataset / "Assets_library", root / "Assets_library")
    plain = replace(source.read(source.scene_ids[0])[0], task=None, source=None)
    plain = replace(plain, objects=tuple(replace(o, source=None) for o in plain.objects))
    some = [o for o in plain.objects if abs(o.position[2] - o.size[2] / 2) < 1e-3]
    first, second = sorted(some, key=lambda o: o.size[0] * o.size[1])[:2]
    x, y, z = first.position
    fixed = (replace(first, instance="stays_a"), replace(first.moved((x + 0.3 * first.size[0], y, z), 0.0), instance="stays_b"))
    table = plain.table
    scenes: Mapping[str, Scene] = {
        "empty": replace(plain, objects=()),
        "fixed": replace(plain, objects=(*fixed, second)),
        "meshless": replace(plain, objects=tuple(replace(o, asset_id="nobody_has_it") for o in (first, second))),
        "nan": replace(plain, objects=(first, second)),
        "one": replace(plain, objects=(first.moved((-1.0, 9.0, 3.0), 2.0),)),
        "small": replace(plain, objects=(first, second), table=replace(table, size_xy=(0.01, 0.01))),
    }
    for name, scene in scenes.items():
        folder = write_scene(root, replace(scene, scene_id=name), annotations=source.annotations)
        if name == "nan":
            layout = json.loads((folder / "layout.json").read_text("utf-8"))
            layout["objects"][0]["position"][0] = float("nan")
            (folder / "layout.json").write_text(json.dumps(layout), "utf-8")
    return root


@pytest.fixture(scope="module")
def run(odd: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp("odd_out") / "out"
    correct(str(odd), str(out), SETTINGS, WorkerPool(), report=False)
    return RunFolder(str(out))


def rows_of(run: RunFolder, table: str, key: str = "scene_id") -> dict[str, dict[str, Any]]:
    return {row[key].rpartition("/")[2]: row for row in run.table(table).to_pylist()}


def test_each_is_one_row_and_says_why(run: RunFolder) -> None:
    scenes, failures = rows_of(run, "scenes"), rows_of(run, "failures", "id")
    assert {name: (row["step"], row["code"]) for name, row in failures.items()} == {
        "empty": ("read", "objects_empty"),
        "fixed": ("certify", "infeasible"),
        "nan": ("read", "position_nan"),
        "small": ("certify", "infeasible"),
    }
    assert sorted(scenes) == ["meshless", "one"]
    said = {"fixed": "stays_a is in stays_b", "nan": "expected finite centimetres", "small": "the table of 0.01 x 0.01 m"}
    assert all(words in failures[name]["message"] for name, words in said.items())


def test_one_object_comes_back_from_far_off(run: RunFolder) -> None:
    row = rows_of(run, "scenes")["one"]
    (o,) = row["objects"]
    assert row["clean"]
    assert all(0 < at < side for at, side in zip(o["position"], row["table_size"], strict=False))
    assert o["support"] == "table"


def test_without_meshes_boxes_are_moved_and_it_is_said(run: RunFolder) -> None:
    assert rows_of(run, "scenes")["meshless"]["clean"] is None
    assert rows_of(run, "corrections")["meshless"]["status"] == "unknown"
    warnings = [row for row in run.table("warnings").to_pylist() if row["id"].endswith("meshless")]
    assert "the meshes of" in next(row["message"] for row in warnings if row["code"] == "unknown")


def test_what_is_fixed_is_not_dropped_either(run: RunFolder) -> None:
    row = rows_of(run, "corrections")["fixed"]
    assert (row["dropped"], row["card_after"]) == ([], None)
    assert {p["instance"] for p in row["raw"]} == {p["instance"] for p in row["start"]}
    still = [{p["instance"]: p for p in row[key] if p["instance"].startswith("stays")} for key in ("start", "raw")]
    assert still[0] == still[1]


@pytest.mark.slow
def test_two_hundred_objects(dataset: Path, tmp_path: Path) -> None:
    source = MesaTaskDataset(dataset)
    plain = source.read(source.scene_ids[0])[0]
    o = min(plain.objects, key=lambda o: o.size[0] * o.size[1])
    step = 0.9 * max(o.size[:2])
    places = [(0.2 + step * (n % 15) * (1 + n % 2), 0.2 + 2 * step * (n // 15), o.size[2] / 2) for n in range(200)]
    objects = tuple(replace(o.moved(place, 0.0), instance=f"{n}_thing_0", source=None) for n, place in enumerate(places))
    many = replace(
        plain, scene_id="many", objects=objects, task=None, source=None, table=replace(plain.table, size_xy=(6.0, 6.0))
    )
    write_scene(tmp_path / "data", many, annotations=source.annotations)
    shutil.copytree(dataset / "Assets_library", tmp_path / "data" / "Assets_library")
    manifest = correct(str(tmp_path / "data"), str(tmp_path / "out"), SETTINGS, WorkerPool(), report=False)
    assert manifest["counts"]["by_status"] == {"certified": 1}
    (row,) = rows_of(RunFolder(str(tmp_path / "out")), "scenes").values()
    assert (row["num_objects"], row["clean"]) == (200, True)


def test_weights_that_cannot_be_used_leave_nothing_behind(odd: Path, tmp_path: Path) -> None:
    weights = tmp_path / "physics_corrector.safetensors"
    shutil.copy(DEFAULT_WEIGHTS, weights)
    save_encoder(tiny_encoder(), tmp_path / ENCODER.name)
    for file, message in ((weights, "was trained on the features of encoder"), (ENCODER, "has no settings in its header")):
        with pytest.raises(ConfigError, match=message):
            correct(str(odd), str(tmp_path / "out"), replace(SETTINGS, weights=str(file)), WorkerPool())
    assert not (tmp_path / "out").exists()


def test_settings_of_which_one_would_be_ignored_are_refused() -> None:
    with pytest.raises(ConfigError, match="settle needs certification, but polish is off"):
        replace(SETTINGS, settle=True, polish="off").check()
    with pytest.raises(ConfigError, match="expected certify for edits"):
        EditSettings(polish="verify").check()
    replace(SETTINGS, polish="verify").check()
