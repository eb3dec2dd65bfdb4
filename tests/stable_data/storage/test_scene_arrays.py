"""Scenes as arrays and padded tensors."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SceneArrays
from stable_data.storage.torch_dataset import collate_scenes
from tests.stable_data.storage.small_run import SCENES, stream, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_run(tmp_path_factory.mktemp("run") / "run")


def test_a_batch_holds_the_scenes_and_zeros() -> None:
    scenes = [SCENES[4], SCENES[0], SCENES[2]]
    batch = collate_scenes(scenes)
    assert batch["mask"].tolist() == [[True] * 4, [False] * 4, [True, True, False, False]]
    for row, one in enumerate(scenes):
        num_objects = len(one.objects)
        assert torch.equal(batch["poses"][row, :num_objects], torch.tensor(one.poses(), dtype=torch.float32))
        for name in ("poses", "size", "tilt_quat_xyzw"):
            assert not batch[name][row, num_objects:].any()
        assert (batch["stage"][row, num_objects:] == -1).all()
        assert batch["instances"][row] == tuple(o.instance for o in one.objects)
        assert batch["asset_ids"][row] == tuple(o.asset_id for o in one.objects)
    assert batch["stage"][0].tolist() == [-1, 0, 1, 2]
    assert batch["instructions"] == ["Do 4.", None, "Do 2."]
    assert batch["poses"].dtype == batch["size"].dtype == batch["table_size"].dtype == torch.float32


def test_padding_leaks_nothing() -> None:
    alone, padded = collate_scenes([SCENES[2]]), collate_scenes([SCENES[2], SCENES[9]])
    moved = replace(SCENES[9], objects=tuple(o.moved((9.0, 9.0, 9.0), 9.0) for o in SCENES[9].objects))
    beside = collate_scenes([SCENES[2], moved])
    for name in ("poses", "size", "tilt_quat_xyzw", "stage", "mask"):
        assert torch.equal(padded[name][0], beside[name][0])
        assert torch.equal(padded[name][0, :2], alone[name][0])


@pytest.mark.parametrize("scenes", [[], [SCENES[0]], [SCENES[0], SCENES[5]]])
def test_scenes_without_objects_make_a_batch(scenes: list[Scene]) -> None:
    assert collate_scenes(scenes)["poses"].shape == (len(scenes), 0, 4)
    assert collate_scenes(scenes)["size"].shape == (len(scenes), 0, 3)


def test_columns_make_the_same_tensors_as_scenes(run: str) -> None:
    direct = list(stream(run, batch_size=4, collate=collate_scenes))
    by_scene = [collate_scenes(scenes) for scenes in stream(run, batch_size=4)]
    for one, other in zip(direct, by_scene, strict=True):
        found, expected = ({name: _plain(value) for name, value in batch.items()} for batch in (one, other))
        assert found == expected


def _plain(value: Any) -> Any:
    return (value.dtype, value.tolist()) if isinstance(value, torch.Tensor) else value


def test_arrays_of_columns_are_those_of_the_scenes(run: str) -> None:
    table = RunFolder(run).table("scenes").slice(5, 20)
    found, expected = SceneArrays.from_table(table), SceneArrays.from_scenes(SCENES[5:25])
    for field in fields(SceneArrays):
        assert np.array_equal(getattr(found, field.name), getattr(expected, field.name)), field.name
