"""The plan: every input of a shard is in its name, and nothing else is."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.execution.shard_step import Shard
from pipelines.preprocess.asset import AssetUse
from pipelines.preprocess.plan import PreprocessPlan, plan_run
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset, write_text_features
from stable_data.scene import QuatXyzw
from tests.pipelines.runs import SMALL, used_assets

ONE_EACH = PreprocessSettings(scenes_per_shard=1, assets_per_shard=1, all_assets=False, position_convention="box_centre")


@pytest.fixture
def root(tiny: Path, tmp_path: Path) -> Path:
    copied = tmp_path / "data"
    shutil.copytree(tiny, copied)
    return copied


def plan(root: Path, settings: PreprocessSettings = ONE_EACH) -> PreprocessPlan:
    return plan_run(MesaTaskDataset(root), settings)


def asset_shards(planned: PreprocessPlan) -> dict[str, Shard[AssetUse]]:
    return {shard.items[0].asset_id: shard for shard in planned.assets}


def scene_ids(planned: PreprocessPlan) -> list[str]:
    return [shard.shard_id for shard in planned.scenes]


def annotate(root: Path, change: Callable[[str, Any], Any]) -> None:
    path = root / "Asset_annotation.json"
    path.write_text(json.dumps({u: change(u, e) for u, e in json.loads(path.read_text("utf-8")).items()}), "utf-8")


def test_a_used_annotation_is_an_input_of_its_asset_and_of_the_scene(root: Path) -> None:
    before, uid = plan(root), min(used_assets(root))
    annotate(root, lambda u, entry: entry | {"mass": 7.0} if u == uid else entry)
    after = plan(root)
    changed = {a for a, shard in asset_shards(after).items() if shard != asset_shards(before)[a]}
    assert changed == {uid}
    assert scene_ids(after) != scene_ids(before)
    assert {kind for kind in after.inputs if after.inputs[kind] != before.inputs[kind]} == {"annotations"}


def test_an_annotation_that_nothing_uses_is_no_input(root: Path) -> None:
    before = plan(root)
    path = root / "Asset_annotation.json"
    path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | {"0" * 32: {"category": "unused"}}), "utf-8")
    assert plan(root) == before
    assert plan(root, SMALL).notices == before.notices
    everything = plan(root, PreprocessSettings(position_convention="box_centre"))
    assert "0" * 32 in {n.item_id for n in everything.notices if n.code == "glb_missing"}


def test_a_text_feature_is_an_input_of_its_asset(root: Path) -> None:
    uids = sorted(used_assets(root))
    features = np.eye(len(uids), dtype=np.float32)
    write_text_features(root / "sbert_text_features.pkl", uids, features)
    before = plan(root)
    features[0] *= -1
    write_text_features(root / "sbert_text_features.pkl", uids, features)
    after = plan(root)
    changed = {a for a, shard in asset_shards(after).items() if shard != asset_shards(before)[a]}
    assert changed == {uids[0]}
    assert scene_ids(after) == scene_ids(before)
    assert {kind for kind in after.inputs if after.inputs[kind] != before.inputs[kind]} == {"text_features"}


def test_the_name_of_the_dataset_is_an_input_of_scenes(root: Path) -> None:
    before = plan(root)
    root = root.rename(root.with_name("renamed"))
    assert asset_shards(plan(root)) == asset_shards(before)
    assert scene_ids(plan(root)) != scene_ids(before)


def test_folders_without_a_layout_are_scenes_of_the_plan(root: Path) -> None:
    before = plan(root)
    (next(root.glob("Layout_info/*")) / "empty").mkdir()
    after = plan(root)
    assert after.scene_ids == (*before.scene_ids, "empty")
    assert after.inputs != before.inputs
    assert (after.assets, after.scenes) == (before.assets, before.scenes)


def turn(root: Path, index: int, tilt: QuatXyzw) -> None:
    path = next(root.glob("Layout_info/*/*/layout.json"))
    layout = json.loads(path.read_text("utf-8"))
    layout["objects"][index] |= {"rotation": list(tilt), "z_rotation": 0.0}
    for entry in layout["objects"]:  # all of them the same asset
        entry["retrieved_uid"] = entry["selected_uid"] = min(used_assets(root))
    path.write_text(json.dumps(layout), "utf-8")


def test_tilts_are_unit_and_those_within_a_degree_count_as_one(root: Path) -> None:
    exact = (math.sin(math.pi / 8), 0.0, 0.0, math.cos(math.pi / 8))  # not so when rounded to 0.01
    turn(root, 0, exact)
    turn(root, 1, (-math.sin(math.pi / 8 + 1e-3), 0.0, 0.0, -math.cos(math.pi / 8 + 1e-3)))
    [shard] = asset_shards(plan(root)).values()
    tilts = dict(shard.items[0].tilts)
    assert tilts[min(tilts, key=lambda tilt: math.dist(tilt, exact))] == 2
    assert min(math.dist(tilt, exact) for tilt in tilts) < 1e-9
    for tilt in tilts:
        assert math.hypot(*tilt) == pytest.approx(1.0, abs=1e-12)


def test_a_file_that_cannot_be_read_does_not_end_the_plan(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    dataset = MesaTaskDataset(root)
    monkeypatch.setattr(Path, "open", fail)
    assert plan_run(dataset, ONE_EACH).scene_ids == dataset.scene_ids


@pytest.mark.parametrize(
    "setting",
    [
        {"important_threshold": math.nan},
        {"seconds_per_item": math.inf},
        {"train_share": math.nan},
        {"task_cache": "s3://bucket/cache"},
    ],
)
def test_settings_that_no_run_can_follow_are_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        PreprocessSettings(**setting)
