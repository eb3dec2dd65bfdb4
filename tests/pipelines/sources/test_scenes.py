"""Where scenes come from: how the scenes of a run are cut into shards."""

from pathlib import Path

import pytest

from pipelines.correct.settings import CorrectSettings
from pipelines.preprocess.scene import SceneSettings
from pipelines.sources.scenes import TableSource
from stable_data.content_id import content_id
from tests.pipelines.execution.test_own_step import run_of


@pytest.mark.parametrize(("count", "size"), [(1, 4), (40, 5), (100, 13), (10_000, 32)])
def test_the_size_of_a_shard_follows_from_the_number_of_scenes(count: int, size: int) -> None:
    assert CorrectSettings().of_items(count).scenes_per_shard == size
    assert CorrectSettings(scenes_per_shard=64).of_items(count).scenes_per_shard == 64


def test_a_large_file_of_a_run_is_cut_and_a_small_one_keeps_its_name(tmp_path: Path) -> None:
    source = TableSource(str(run_of(tmp_path / "run", *[0] * 40)))
    whole, inputs = source.parts(SceneSettings(), 64)
    assert [part.scene_ids for part in whole] == [source.scene_ids]
    assert whole[0].content == content_id("part-0000000000000000.parquet", inputs["meshes"], inputs["assets"])
    parts, _ = source.parts(SceneSettings(), 5)
    assert [len(part.scene_ids) for part in parts] == [5] * 8
    assert tuple(scene_id for part in parts for scene_id in part.scene_ids) == source.scene_ids
    assert len({part.content for part in (*parts, *whole)}) == 9
