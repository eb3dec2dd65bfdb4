"""The correct job: a broken set comes out clean, nothing is lost, the same rows however it was run."""

import io
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.correct.job import correct
from pipelines.correct.report import write_correct_report
from pipelines.correct.settings import CorrectSettings
from pipelines.correct.shard import CorrectWork
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_step import Shard, ShardTask, ShardWriter
from stable_data.assets.store import AssetStore
from stable_data.cli import app as stable_data
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset, write_scene
from stable_data.mesatask.lint import lint_folder
from stable_data.scene import Scene
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import settle
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row
from tests.pipelines.runs import content, set_options
from tests.stable_data.viewer.pages import Page
from tests.whole import check_whole

SMALL = CorrectSettings(weights="none", scenes_per_shard=2, num_pictures=0, position_convention="box_centre")
ALONE = WorkerPool()
SPOILT = slice(1, 3)
"""Which scenes of the dataset are spoilt. Of the first one nearly all objects belong to its task, so that none may be dropped."""


def on_top_of_each_other(scene: Scene) -> Scene:
    """A scene with one of its things pushed into its neighbour, and another in the air."""
    on_table = [o for o in scene.objects if abs(o.position[2] - o.size[2] / 2) < 1e-3]
    first, second = sorted(on_table, key=lambda o: o.size[0] * o.size[1])[-2:]
    x, y, _ = second.position
    flies = min(on_table, key=lambda o: o.size[2])
    new = {
        first.instance: first.moved((x + 0.01, y, first.position[2]), first.yaw),
        flies.instance: flies.moved((*flies.position[:2], flies.position[2] + 0.03), flies.yaw),
    }
    return replace(scene, objects=tuple(new.get(o.instance, o) for o in scene.objects))


@pytest.fixture(scope="module")
def broken(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset with two of its scenes spoilt."""
    root = tmp_path_factory.mktemp("spoilt") / "data"
    shutil.copytree(dataset, root)
    source = MesaTaskDataset(dataset)
    for scene_id in source.scene_ids[SPOILT]:
        write_scene(root, on_top_of_each_other(source.read(scene_id)[0]), annotations=source.annotations)
    return root


@pytest.fixture(scope="module")
def corrected(broken: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("corrected") / "out"
    manifest = correct(str(broken), str(out), SMALL, ALONE)
    assert manifest["counts"]["by_status"] == {"certified": 4}
    return out


def rows_of(out: Path, table: str) -> dict[str, dict[str, Any]]:
    return {row["scene_id"]: row for row in RunFolder(str(out)).table(table).to_pylist()}


def test_a_broken_set_comes_out_clean(broken: Path, corrected: Path) -> None:
    before, after = rows_of(corrected, "corrections"), rows_of(corrected, "scenes")
    spoilt = sorted(before)[SPOILT]
    assert [before[s]["card_before"]["clean"] for s in sorted(before)] == [True, False, False, True]
    assert all(row["clean"] for row in after.values())
    assert all(after[s]["move_max_mm"] > 1 for s in spoilt)
    assert before.keys() == after.keys()
    assert "corrected" in (corrected / "report" / "index.html").read_text("utf-8")


def test_a_corrected_folder_is_whole(corrected: Path) -> None:
    """Its meshes are those of the dataset that is written beside the tables."""
    assert check_whole(corrected).num_audited == 4


def test_a_corrected_folder_is_published_without_its_meshes(broken: Path, corrected: Path, tmp_path: Path) -> None:
    """They stay in the dataset, so that only who has it can judge the published scenes again; all else is verified."""
    out = tmp_path / "out"
    done = CliRunner().invoke(stable_data, ["publish", str(corrected), str(out), "--quiet", "--verdicts", "audit"])
    assert done.exit_code == 0, done.output
    assert "verdicts of 4 of 4 scenes by audit" in (out / "README.md").read_text("utf-8")
    assert "`stable-data verify --verdicts none`" in (out / "README.md").read_text("utf-8")
    assert not (out / "meshes").exists()
    assert not (out / "dataset").exists()
    done = CliRunner().invoke(stable_data, ["verify", str(out), "--quiet"])
    assert done.exit_code == 1
    assert "not known to be whole" in done.stdout
    assert "--verdicts none leaves verdicts out" in done.stdout
    check_whole(out, verdicts="none")
    done = CliRunner().invoke(stable_data, ["verify", str(out), "--quiet", "--verdicts", "audit", "--assets", str(broken)])
    assert (done.exit_code, "verdicts of 4 of 4 scenes by audit" in done.stdout) == (0, True), done.stdout


def test_a_page_shows_a_scene_before_and_after(broken: Path, corrected: Path, tmp_path: Path) -> None:
    out = shutil.copytree(corrected, tmp_path / "out")
    manifest = json.loads((out / "manifest.json").read_text("utf-8"))
    write_correct_report(RunFolder(str(out)), manifest, AssetStore(MesaTaskDataset(broken)), CorrectSettings(num_pictures=4))
    before, after = rows_of(out, "corrections"), rows_of(out, "scenes")
    for scene_id, row in after.items():
        page = Page((out / "report" / "scenes" / f"{scene_id}.html").read_text("utf-8"))
        assert len(page.articles) == 2
        for number, poses in enumerate((before[scene_id]["start"], row["objects"])):
            loaded = trimesh.load(io.BytesIO(page.models[number]), file_type="glb")
            loaded.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))  # z up again
            for pose in poses:
                parents = loaded.graph.transforms.parents  # trimesh makes a node for each colour
                nodes = [n for n in loaded.graph.nodes_geometry if pose["instance"] in (n, parents[n])]
                placed = ((loaded.geometry[geometry], place) for place, geometry in map(loaded.graph.get, nodes))
                corners = np.concatenate([trimesh.transform_points(mesh.vertices, place) for mesh, place in placed])
                corners = Rotation.from_euler("z", -pose["yaw"]).apply(corners - pose["position"])
                np.testing.assert_allclose((corners.max(axis=0) + corners.min(axis=0)) / 2, 0, atol=1e-5)
        is_clean = before[scene_id]["card_before"]["clean"]
        assert ("not clean" in page.articles[0]) is not is_clean
        assert "not clean" not in page.articles[1]


def test_what_was_clean_stays_where_it_is(broken: Path, corrected: Path) -> None:
    source = MesaTaskDataset(broken)
    rows = rows_of(corrected, "scenes")
    for scene_id in sorted(rows.keys() - set(sorted(rows)[SPOILT])):
        row = rows[scene_id]
        was = source.read(scene_id)[0]
        assert [(o.position, o.yaw) for o in scene_from_row(row).objects] == [(o.position, o.yaw) for o in was.objects]
        assert (row["move_max_mm"], row["turn_max_deg"]) == (0.0, 0.0)
        assert (row["relations_kept_on_in"], row["relations_kept_directional"]) == (1.0, 1.0)


def test_lint_sees_the_difference(broken: Path, corrected: Path) -> None:
    was, now = lint_folder(broken), lint_folder(corrected / "dataset")
    assert [sum(bool(row["clean"]) for row in result.rows) for result in (was, now)] == [2, 4]
    assert not now.failures


def test_the_start_is_kept(broken: Path, corrected: Path) -> None:
    source = MesaTaskDataset(broken)
    for scene_id, row in rows_of(corrected, "corrections").items():
        starts = {p["instance"]: (*p["position"], p["yaw"]) for p in row["start"]}
        assert starts == {o.instance: (*o.position, o.yaw) for o in source.read(scene_id)[0].objects}
        assert row["raw"] is None
        assert row["card_raw"] is None


def test_what_is_not_certified_is_said_to_be_unclean(broken: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    correct(str(broken), str(out), replace(SMALL, refine=True, polish="verify", write_dataset=False), ALONE, report=False)
    solved = {scene_id: row["solved_by"] for scene_id, row in rows_of(out, "corrections").items()}
    scenes = rows_of(out, "scenes")
    unclean = {scene_id for scene_id, row in scenes.items() if row["clean"] is not True}
    assert {scene_id for scene_id, by in solved.items() if by is None} == unclean
    assert set(solved.values()) <= {None, "start", "refine"}
    told = {row["id"] for row in RunFolder(str(out)).table("warnings").to_pylist() if row["code"] == "unclean"}
    assert told == unclean


def test_what_the_engine_moves_is_put_where_it_stays_or_named(broken: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    correct(str(broken), str(out), replace(SMALL, settle=True, write_dataset=False), ALONE, report=False)
    store = AssetStore(MesaTaskDataset(broken))
    named = {row["scene_id"] for row in rows_of(out, "warnings").values() if row["reason"] == "unsteady"}
    for scene_id, row in rows_of(out, "scenes").items():
        scene, shapes, _ = store.resolved(scene_from_row(row))
        assert row["clean"]
        assert bool(settle(bodies_of(scene, shapes, store), scene.table).stable) != (scene_id in named)


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_gives_the_same_bytes_as_this_process(broken: Path, corrected: Path, tmp_path: Path) -> None:
    where = ["--scenes", str(broken), "--out", str(tmp_path / "out"), "--workers", "2"]
    done = CliRunner().invoke(app, ["correct", *where, *set_options(SMALL.shaping())])
    assert done.exit_code == 0, done.output
    assert "4 of 4 scenes (4 certified)" in done.stdout
    assert content(tmp_path / "out") == content(corrected)


@pytest.mark.slow
def test_an_item_in_a_process_of_its_own_gives_the_same_rows(broken: Path, corrected: Path, tmp_path: Path) -> None:
    manifest = json.loads((corrected / "manifest.json").read_text("utf-8"))
    ids = sorted(rows_of(corrected, "scenes"))[:2]
    write = ShardWriter(str(tmp_path), (CorrectWork(str(broken), SMALL, manifest["input_fingerprint"]),))
    write(ShardTask(0, Shard("0" * 16, tuple(ids))), isolated=True)
    whole = rows_of(corrected, "scenes")
    assert rows_of(tmp_path, "scenes") == {scene_id: whole[scene_id] for scene_id in ids}


def test_odd_names_of_scene_folders_stop_no_job(bare: Path, tmp_path: Path) -> None:
    """A name that is not UTF-8 is written in another way; one that other systems cannot have is a failure of its scene."""
    data = Path(shutil.copytree(bare, tmp_path / "data"))
    (layout,) = data.glob("Layout_info/*/*/layout.json")
    for name in (b"s\xff", rb"a\b"):
        folder = Path(os.fsdecode(os.fsencode(layout.parent.parent) + b"/" + name))
        folder.mkdir()
        shutil.copy(layout, folder)
    counts = correct(str(data), str(tmp_path / "out"), CorrectSettings(weights="none", num_pictures=0), WorkerPool())["counts"]
    assert (counts["scenes"], counts["failures_by_code"]) == (2, {"scene_id_invalid": 1})
    assert sorted(rows_of(tmp_path / "out", "scenes")) == [layout.parent.name, "s%FF"]
    assert {p.name for p in tmp_path.glob("out/dataset/Layout_info/*/*")} == {layout.parent.name, "s%FF"}


@pytest.mark.parametrize("table", CorrectWork.TABLES)
def test_a_shard_that_is_missing_is_made_again(broken: Path, corrected: Path, tmp_path: Path, table: str) -> None:
    out = tmp_path / "out"
    shutil.copytree(corrected, out, symlinks=True)
    sorted((out / table).glob("part-*.parquet"))[0].unlink()
    correct(str(broken), str(out), SMALL, ALONE, report=False)
    assert content(out) == content(corrected)


def test_another_configuration_is_refused(broken: Path, corrected: Path) -> None:
    with pytest.raises(ConfigError, match=r"when_full: drop -> infeasible"):
        correct(str(broken), str(corrected), replace(SMALL, when_full="infeasible"), ALONE)


def test_a_run_is_corrected_as_its_folder_is(clean_run: Path, tmp_path: Path) -> None:
    manifest = correct(str(clean_run), str(tmp_path / "out"), SMALL, ALONE)
    assert manifest["counts"]["by_status"] == {"certified": 4}
    for table in ("assets", "meshes", "sdf"):
        assert RunFolder(str(tmp_path / "out")).table(table) == RunFolder(str(clean_run)).table(table)
    was, now = rows_of(clean_run, "scenes"), rows_of(tmp_path / "out", "scenes")
    same = ("objects", "relations", "task", "split", "layout_sha256", "duplicate_group", "clean")
    assert {s: {k: row[k] for k in same} for s, row in now.items()} == {s: {k: row[k] for k in same} for s, row in was.items()}


def test_what_is_fixed_stays(broken: Path, tmp_path: Path) -> None:
    source = MesaTaskDataset(broken)
    scene = source.read(source.scene_ids[0])[0]
    kept = max(scene.objects, key=lambda o: o.size[0] * o.size[1])
    correct(str(broken), str(tmp_path / "out"), replace(SMALL, fixed=kept.category), ALONE, report=False)
    row = rows_of(tmp_path / "out", "scenes").get(scene.scene_id)
    if row is not None:  # else it says that it is infeasible
        found = {o["instance"]: (tuple(o["position"]), o["yaw"]) for o in row["objects"]}
        assert found[kept.instance] == (kept.position, kept.yaw)
    else:
        assert rows_of(tmp_path / "out", "corrections")[scene.scene_id]["status"] == "infeasible"


def test_two_fixed_things_in_each_other_are_infeasible(broken: Path, tmp_path: Path) -> None:
    source = MesaTaskDataset(broken)
    everything = ",".join(o.category for s in source.scene_ids for o in source.read(s)[0].objects)
    manifest = correct(str(broken), str(tmp_path / "out"), replace(SMALL, fixed=everything), ALONE, report=False)
    assert manifest["counts"]["by_status"] == {"certified": 2, "infeasible": 2}
    failures = RunFolder(str(tmp_path / "out")).table("failures").to_pylist()
    assert {(row["id"], row["step"], row["code"]) for row in failures} == {
        (scene_id, "certify", "infeasible") for scene_id in source.scene_ids[SPOILT]
    }
    assert all("cannot be moved" in row["message"] for row in failures)
    corrections = rows_of(tmp_path / "out", "corrections")
    assert all(corrections[scene_id]["card_after"] is None for scene_id in source.scene_ids[SPOILT])


def test_boxes_stand_in_and_it_is_said(bare: Path, tmp_path: Path) -> None:
    manifest = correct(str(bare), str(tmp_path / "out"), SMALL, ALONE)
    assert manifest["counts"]["by_status"] == {"unknown": 1}
    (row,) = rows_of(tmp_path / "out", "scenes").values()
    assert row["clean"] is None
    codes = {row["code"] for row in RunFolder(str(tmp_path / "out")).table("warnings").to_pylist()}
    assert "unknown" in codes


def test_real_scenes_with_defects_are_certified(real_data: Path, tmp_path: Path) -> None:
    manifest = correct(str(real_data), str(tmp_path / "out"), SMALL, ALONE, report=False)
    assert manifest["counts"]["by_status"] == {"certified": 12}
    rows = rows_of(tmp_path / "out", "scenes")
    assert all(row["clean"] for row in rows.values())
    truth = json.loads((real_data / "truth.json").read_bytes())
    assert {scene_id: len(row["objects"]) for scene_id, row in rows.items()} == {
        scene_id: len(scene["objects"]) for scene_id, scene in truth.items()
    }


def test_broken_scenes_are_all_accounted_for(broken_data: Path, tmp_path: Path) -> None:
    manifest = correct(str(broken_data), str(tmp_path / "out"), SMALL, ALONE, report=False)
    source = MesaTaskDataset(broken_data)
    scenes, failures = set(rows_of(tmp_path / "out", "scenes")), RunFolder(str(tmp_path / "out")).table("failures").to_pylist()
    assert scenes | {row["id"] for row in failures} >= set(source.scene_ids)
    assert not scenes & {row["id"] for row in failures}
    assert manifest["counts"]["failures_by_code"].get("unexpected", 0) == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"weights": "/nowhere/corrector.safetensors"}, "no such file"),
        ({"when_full": "pray"}, "expected drop or infeasible"),
        ({"steps": -1}, "steps is -1, expected at least 0"),
        ({"position_convention": "top"}, "expected auto, box_centre or mesh_centre"),
    ],
)
def test_settings_that_cannot_be_are_refused(bare: Path, tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        correct(str(bare), str(tmp_path / "out"), replace(SMALL, **settings), ALONE)


def test_the_output_may_not_lie_in_the_input(bare: Path) -> None:
    with pytest.raises(ConfigError, match="is inside the folder of the input scenes"):
        correct(str(bare), str(bare / "out"), SMALL, ALONE)
