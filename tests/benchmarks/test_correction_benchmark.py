"""Start layouts and the benchmark of the baselines: what is read, what is made, how it is counted."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import steerable_drake
from benchmarks.correction import Result, chosen_layouts, judged, ratios, run, table
from benchmarks.corrector_parts import CorrectorParts, CorrectorTerms
from benchmarks.layouts import BUCKETS, StartLayout, bucket_of, read_layouts, shaken, shaken_layouts
from models.baselines.outcome import BaselineResult
from models.baselines.steerable import Steerable
from stable_data.assets.store import AssetStore
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Relation, RelationKind, Scene


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> MesaTaskDataset:
    root = tmp_path_factory.mktemp("world")
    write_world(root, 2, EmbeddedWorld(pictures=False))
    return MesaTaskDataset(root)


@pytest.fixture(scope="module")
def store(dataset: MesaTaskDataset) -> AssetStore:
    return AssetStore(dataset)


@pytest.fixture(scope="module")
def scene(dataset: MesaTaskDataset, store: AssetStore) -> Scene:
    return store.resolved(dataset.read(dataset.scene_ids[0])[0])[0]


def row_of(scene: Scene, start: Scene) -> dict[str, Any]:
    return {
        "id": "made",
        "bucket": "0-10",
        "n_collisions": 3,
        "settled_valid": True,
        "table": {"size_xy_m": list(scene.table.size_xy)},
        "objects": [
            {
                "instance": o.instance,
                "uid": o.asset_id,
                "scale_factor": [100 * s for s in o.scale or ()],
                "base_quat_xyzw": list(o.tilt_quat_xyzw),
                "start": {"position_m": list(before.position), "yaw": before.yaw},
                "settled": {"position_m": list(o.position), "yaw": o.yaw},
                "relation": "on" if n == 1 else "table",
                "parent": scene.objects[0].instance if n == 1 else "table",
            }
            for n, (o, before) in enumerate(zip(scene.objects, start.objects, strict=True))
        ],
    }


def test_a_layout_is_read_as_it_was_written(scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    start = shaken(scene, 0.05, np.random.default_rng(0))
    path = tmp_path / "layouts.jsonl"
    path.write_text(json.dumps(row_of(scene, start)) + "\n")
    (layout,) = read_layouts(path, store)
    assert layout.target is not None
    assert (layout.bucket, layout.num_collisions) == ("0-10", 3)
    assert layout.start.poses() == pytest.approx(start.poses())
    assert layout.target.poses() == pytest.approx(scene.poses())
    assert layout.start.relations == (Relation(scene.objects[1].instance, RelationKind.ON, scene.objects[0].instance),)
    for read, written in zip(store.shapes(layout.target)[0], store.shapes(scene)[0], strict=True):
        assert np.abs(read.vertices - written.vertices).max() < 1e-9


def test_without_a_valid_target_there_is_none(scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    path = tmp_path / "layouts.jsonl"
    path.write_text(json.dumps({**row_of(scene, scene), "settled_valid": False}))
    assert next(read_layouts(path, store)).target is None


def test_every_nth_layout_of_a_file_is_taken(scene: Scene, dataset: MesaTaskDataset, store: AssetStore, tmp_path: Path) -> None:
    path = tmp_path / "layouts.jsonl"
    path.write_text("\n".join(json.dumps({**row_of(scene, scene), "id": str(n)}) for n in range(5)))
    found = {(n, most): chosen_layouts("unused", store, path, most, every=n) for n, most in ((1, 9), (2, 9), (2, 1))}
    names = {key: [layout.start.scene_id for layout in layouts] for key, layouts in found.items()}
    assert names == {(1, 9): list("01234"), (2, 9): list("024"), (2, 1): ["0"]}


@pytest.mark.parametrize("change", [{"table": {}}, {"objects": [{}]}, {"objects": None}, {"n_collisions": "many"}])
def test_a_line_that_is_no_layout_is_named(change: dict[str, Any], scene: Scene, store: AssetStore, tmp_path: Path) -> None:
    path = tmp_path / "layouts.jsonl"
    path.write_text(json.dumps(row_of(scene, scene)) + "\n" + json.dumps({**row_of(scene, scene), **change}))
    with pytest.raises(SceneError, match="line 2"):
        list(read_layouts(path, store))


def test_buckets() -> None:
    assert [bucket_of(n) for n in (0, 1, 9, 10, 39, 40)] == ["", "0-10", "0-10", "10-20", "30-40", ""]


def test_shaken_scenes_fill_the_buckets_that_they_can(scene: Scene, store: AssetStore) -> None:
    layouts = list(shaken_layouts([scene], store, 1))
    assert layouts
    assert len({layout.bucket for layout in layouts}) == len(layouts)
    for layout in layouts:
        assert layout.bucket in BUCKETS
        assert layout.target == scene
        assert audit_scene(layout.start, store.shapes(layout.start)[0]).card().num_collisions == layout.num_collisions
        assert ((layout.start.poses()[:, :2] >= 0) & (layout.start.poses()[:, :2] <= scene.table.size_xy)).all()


class Thrower:
    """Throws the first object away and claims success."""

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        first, *rest = scene.objects
        x, y, z = first.position
        return BaselineResult(replace(scene, objects=(first.moved((x + 10.0, y, z + 1.0), first.yaw), *rest)), True, 1.5)


def test_a_method_is_judged_by_what_it_gives_back(scene: Scene, store: AssetStore) -> None:
    layout = StartLayout(scene, scene, "0-10", 1)
    thrown = judged("thrower", Thrower(), layout, store)
    assert (thrown.converged, thrown.clean) == (True, False)
    assert thrown.num_outside == 1
    assert thrown.num_floating >= 1
    assert thrown.move_max_mm == pytest.approx(1e3 * np.hypot(10, 1))
    assert thrown.move_mean_mm == pytest.approx(thrown.move_max_mm / len(scene.objects))
    assert thrown.emd_mm == pytest.approx(thrown.move_mean_mm)
    assert judged("thrower", Thrower(), replace(layout, target=None), store).emd_mm is None
    results = run([layout], store, {"thrower": Thrower()})
    assert [r.method for r in results] == ["start", "thrower"]
    start = results[0]
    assert start.clean
    assert start.kept.on_in_kept == start.kept.on_in_held > 0
    assert start.kept.directional_kept == start.kept.directional_held > 0
    lines = table(results).splitlines()
    assert [line.split()[:4] for line in lines[1:]] == [
        [name, bucket, "1", clean] for name, clean in (("start", "1/1"), ("thrower", "0/1")) for bucket in ("0-10", "all")
    ]


def test_seconds_of_the_baselines_are_set_against_ours(scene: Scene, store: AssetStore) -> None:
    one = judged("thrower", Thrower(), StartLayout(scene, scene, "0-10", 1), store)

    def took(method: str, bucket: str, *seconds: float) -> list[Result]:
        return [replace(one, method=method, bucket=bucket, seconds=s) for s in seconds]

    ours_ = took("certify", "0-10", 1.0, 2.0, 9.0) + took("certify", "10-20", 4.0) + took("start", "0-10", 0.0)
    theirs = took("steerable", "0-10", 1.0) + took("steerable", "10-20", 8.0)
    head, row = ratios([*ours_, *theirs]).splitlines()
    assert head.split() == ["seconds", "of", "over", "0-10", "10-20", "all"]
    assert row.split() == ["steerable", "certify", "0.5", "2", "1.5"]  # medians: 1 / 2, 8 / 4, 4.5 / 3
    assert ratios(ours_) == ""


def test_the_time_cap_is_said(scene: Scene, store: AssetStore, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([StartLayout(scene, scene, "0-10", 1)], store, {}, limit=-1.0) == []
    assert "left out" in capsys.readouterr().out


def test_relations_that_a_correction_breaks_are_counted(scene: Scene, store: AssetStore) -> None:
    start = shaken(scene, 0.08, np.random.default_rng(1))
    result: Result = judged("steerable", Steerable(), StartLayout(start, scene, "0-10", 1), store)
    assert 0 <= result.kept.on_in_kept <= result.kept.on_in_held


def test_ours_is_judged_as_the_others_are(scene: Scene, store: AssetStore) -> None:
    start = shaken(scene, 0.08, np.random.default_rng(1))
    result = judged(
        "certify",
        CorrectorParts(CorrectorTerms(), flows=False, refines=False),
        StartLayout(start, scene, "0-10", 1),
        store,
        settles=True,
    )
    assert result.clean
    assert result.converged
    assert result.num_resting is not None
    assert 0 < result.num_resting <= result.num_objects - result.num_dropped


def test_drake_is_a_method_where_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steerable_drake, "find_spec", lambda _: None)
    assert not steerable_drake.in_drake()
    monkeypatch.setattr(steerable_drake, "find_spec", lambda name: name)
    assert [method.with_parts for method in steerable_drake.in_drake().values()] == [False, True]
