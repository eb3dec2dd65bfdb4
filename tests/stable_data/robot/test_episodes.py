"""Episodes are checked, and come back from the table bit for bit; other readers see the same numbers."""

import pickle
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.errors import ConfigError
from stable_data.robot.episodes import Episode, EpisodeError, episode_from_row, episode_row, read_episodes
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import arrow_table
from stable_data.storage.torch_dataset import TableStream
from tests.stable_data.robot.synthetic_episodes import episode, png, write_run


def is_same(one: Episode, other: Episode) -> bool:
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in fields(Episode)]
    return all(
        a.dtype == b.dtype and np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b and type(a) is type(b)
        for a, b in pairs
    )


@given(
    number=st.integers(0, 5),
    steps=st.integers(1, 6),
    cameras=st.sampled_from([(), ("front",), ("front", "wrist")]),
    environment=st.integers(0, 3),
    objects=st.integers(0, 3),
)
def test_a_row_gives_the_episode_back(
    number: int, steps: int, cameras: tuple[str, ...], environment: int, objects: int
) -> None:
    one = episode(number=number, steps=steps, cameras=cameras, size=(4, 6), environment=environment, objects=objects)
    row = arrow_table("episodes", [episode_row(one)]).to_pylist()[0]
    assert is_same(one, episode_from_row(row))
    assert is_same(one, pickle.loads(pickle.dumps(one)))
    assert one.states.dtype == np.float32
    assert not one.states.flags.writeable


def test_runs_give_episodes_back_in_order(tmp_path: Path) -> None:
    written = [
        episode(f"scene-{s}", k, cameras=("front",), split="test" if s == 2 else "train") for s in range(3) for k in range(3)
    ]
    run = write_run(tmp_path / "run", written)
    found = list(read_episodes(run.uri))
    assert len(found) == len(written)
    assert all(map(is_same, written, found))
    assert [e.episode_id for e in read_episodes(run.uri, where="success and task_kind == 'pick'", split="test")] == [
        "scene-2/1"
    ]
    blind = list(read_episodes(run.uri, with_pictures=False))
    assert [(e.pictures, e.image_size) for e in blind] == [({}, None)] * 9
    assert np.array_equal(blind[4].actions, written[4].actions)
    assert all(map(is_same, written, TableStream(run.uri, "episodes", decode=episode_from_row)))


def test_other_readers_see_the_numbers(tmp_path: Path) -> None:
    one = episode(cameras=("front", "wrist"))
    write_run(tmp_path / "run", [one])
    row = pl.read_parquet(tmp_path / "run/episodes/*.parquet").row(0, named=True)
    assert np.array_equal(np.reshape(row["actions"], (row["num_steps"], -1)), one.actions)
    assert {c["camera"]: tuple(c["images"]) for c in row["pictures"]} == one.pictures
    [row] = pq.read_table(tmp_path / "run/episodes").to_pylist()
    assert np.array_equal(np.reshape(row["object_poses"], (row["num_steps"] + 1, -1, 7)), one.object_poses)


def test_row_groups_are_small_where_pictures_are_large(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (500, 700, 3), np.uint8)  # 1 MB, and no encoder makes it smaller
    pictures = {"front": (png(noise),) * 3}
    heavy = [episode(f"scene-{k}", steps=3, pictures=pictures, image_size=(500, 700)) for k in range(6)]
    run = write_run(tmp_path / "heavy", heavy, per_shard=6)
    [path] = run.files("episodes")
    groups = [pq.ParquetFile(path).metadata.row_group(k) for k in range(pq.ParquetFile(path).num_row_groups)]
    assert max(group.total_byte_size for group in groups) < 10 * 10**6
    light = write_run(tmp_path / "light", [episode(f"scene-{k}") for k in range(6)], per_shard=6)
    assert pq.ParquetFile(light.files("episodes")[0]).num_row_groups == 1


def _not_finite() -> Any:
    actions = np.zeros((12, 8))
    actions[3, 2] = np.inf
    return actions


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"episode_id": "other/0"}, "episode_id is 'other/0', expected scene-000/0"),
        ({"instruction": " "}, "instruction is empty"),
        ({"seed": -1}, "seed is -1"),
        ({"reason": "fell"}, "success is True and reason is 'fell'"),
        ({"success": False}, "success is False and reason is None"),
        ({"fps": 0.0}, "fps is 0.0"),
        ({"state_names": ("a",) * 7}, "state_names is"),
        ({"lead": " "}, "lead is empty, expected a name, or None for no policy"),
        ({"split": "training"}, "split is 'training', expected one of train"),
        ({"randomization": "[1]"}, "randomization is '[1]', expected a JSON object"),
        ({"actions": np.zeros((0, 8))}, "actions has shape (0, 8), expected at least one action"),
        ({"actions": 1.0}, "actions has shape ()"),
        ({"states": np.zeros((11, 7))}, "states has shape (11, 7), expected (12, 7)"),
        ({"action_names": (), "actions": np.zeros((12, 0))}, "actions has shape (12, 0), expected at least one name"),
        ({"rewards": np.zeros((12, 1))}, "rewards has shape (12, 1), expected (12,)"),
        ({"actions": _not_finite()}, "actions[3, 2] is inf, expected finite numbers"),
        ({"rewards": np.full(12, 1e300)}, "rewards[0] is inf"),
        ({"object_poses": np.zeros((12, 2, 7))}, "object_poses has shape (12, 2, 7), expected (13, 2, 7)"),
        ({"object_poses": np.ones((13, 2, 7))}, "quaternion of norm 2, expected norm 1"),
        ({"image_size": (4, 4)}, "image_size is (4, 4) with 0 cameras"),
        ({"pictures": {"front": (b"",) * 12}}, "image_size is None with 1 cameras"),
        (
            {"pictures": {"front": (b"",) * 12}, "image_size": (4, 9999)},
            "image_size is (4, 9999), expected sides of at least 1 and at most 4,096 pixels",
        ),
        ({"pictures": {"a/b": (b"",) * 12}, "image_size": (4, 4)}, "a camera is 'a/b'"),
        ({"pictures": {"front": (b"",) * 3}, "image_size": (4, 4)}, "camera front has 3 pictures, expected 12"),
        (
            {"pictures": {"front": (png(np.zeros((4, 5, 3), np.uint8)),) * 12}, "image_size": (4, 4)},
            "picture 0 of camera front is another file, expected PNG, 8-bit RGB, 4 x 4",
        ),
        ({"pictures": {"front": (png(np.zeros((4, 4), np.uint8)),) * 12}, "image_size": (4, 4)}, "is another file"),
    ],
)
def test_an_invalid_episode_is_refused_in_one_line(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(EpisodeError) as refused:
        episode(**changes)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
    assert refused.value.code == "episode_invalid"


def test_a_row_with_too_few_numbers_is_refused() -> None:
    row = episode_row(episode())
    with pytest.raises(EpisodeError, match=r"scene-000/0: states has 83 numbers, expected 84, \(12, 7\)"):
        episode_from_row(row | {"states": row["states"][:-1]})


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("robot", None),
        ("fps", None),
        ("num_steps", None),
        ("action_names", None),
        ("state_names", ["a", None]),
        ("subjects", [None]),
        ("image_size", [4, None]),
        ("pictures", [{"camera": None, "images": []}]),
        ("pictures", [None]),
    ],
)
def test_a_row_with_a_null_for_a_value_is_refused(column: str, value: object) -> None:
    with pytest.raises(EpisodeError, match=f"scene-000/0: {column} is null, or a part of it is"):
        episode_from_row(episode_row(episode()) | {column: value})


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [("num_steps", -1, "is -1, expected at least 1"), ("image_size", [4], "has 1 numbers, expected 2")],
)
def test_a_row_without_steps_or_with_another_size_is_refused(column: str, value: object, said: str) -> None:
    with pytest.raises(EpisodeError, match=f"{column} {said}"):
        episode_from_row(episode_row(episode()) | {column: value})


def test_a_run_without_episodes_and_a_wrong_condition_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no table episodes"):
        list(read_episodes(tmp_path / "none"))
    run = write_run(tmp_path / "run", [episode()])
    with pytest.raises(ConfigError, match="num_objects"):
        list(read_episodes(run.uri, where="num_objects > 2"))


def test_columns_that_may_be_null_are_not_required() -> None:
    nullable = {"split", "reason", "image_size", "pictures", "randomization"}
    row = episode_row(episode())
    assert is_same(episode(split=None), episode_from_row({name: value for name, value in row.items() if name not in nullable}))
    assert set(SCHEMAS["episodes"].names) == set(row)
