"""An export as LeRobotDataset v3.0: its files say what the table says; what LeRobot makes of it is in tests/consumers."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.errors import ConfigError
from stable_data.robot.episodes import Episode, EpisodeError
from stable_data.robot.lerobot.dataset_writer import EpisodeSelection, LeRobotWriter, write_lerobot
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.robot.synthetic_episodes import episode, write_run

EPISODES = [
    episode(f"scene-{s}", k, steps=4 + s + k, cameras=("front", "wrist"), size=(8, 10)) for s in range(3) for k in range(3)
]
DONE = [e for e in EPISODES if e.success]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return write_run(tmp_path_factory.mktemp("episodes") / "run", EPISODES, per_shard=4)


@pytest.fixture(scope="module")
def dataset(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "dataset"
    result = write_lerobot(run, out)
    assert (result.num_episodes, result.num_failed, result.num_tasks) == (6, 3, 2)
    return out


def rows(dataset: Path, part: str) -> list[dict[str, Any]]:
    return [row for path in sorted((dataset / part).glob("*/*.parquet")) for row in pq.read_table(path).to_pylist()]


def written(folder: Path, episodes: list[Episode], **settings: Any) -> Path:
    writer = LeRobotWriter(folder, episodes[0].features, **settings)
    for one in episodes:
        writer.add(one)
    writer.close()
    return folder


def test_frames_are_those_of_the_successful_episodes(dataset: Path) -> None:
    frames = rows(dataset, "data")
    assert len(frames) == sum(e.num_steps for e in DONE)
    tasks = pd.read_parquet(dataset / "meta/tasks.parquet")
    expected = iter(enumerate((k, step) for k, e in enumerate(DONE) for step in range(e.num_steps)))
    for frame, (index, (k, step)) in zip(frames, expected, strict=True):
        one, is_last = DONE[k], step == DONE[k].num_steps - 1
        assert np.array_equal(np.float32(frame["observation.state"]), one.states[step])
        assert np.array_equal(np.float32(frame["observation.environment_state"]), one.environment_states[step])
        assert np.array_equal(np.float32(frame["action"]), one.actions[step])
        assert frame["next.reward"] == one.rewards[step]
        assert (frame["next.done"], frame["next.success"]) == (is_last, is_last)
        assert (frame["index"], frame["episode_index"], frame["frame_index"]) == (index, k, step)
        assert frame["timestamp"] == np.float32(step / 20)
        assert tasks.iloc[frame["task_index"]].name == one.instruction
        for camera in ("front", "wrist"):
            assert frame[f"observation.images.{camera}"] == {
                "bytes": one.pictures[camera][step],
                "path": f"frame-{step:06d}.png",
            }


def test_info_describes_them(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    num_frames = sum(e.num_steps for e in DONE)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (6, num_frames, 2)
    assert (info["codebase_version"], info["fps"], info["robot_type"], info["splits"]) == (
        "v3.0",
        20,
        "panda",
        {"train": "0:6"},
    )
    assert info["features"]["action"] == {"dtype": "float32", "shape": [8], "names": list(DONE[0].action_names)}
    assert info["features"]["observation.images.wrist"] == {
        "dtype": "image",
        "shape": [8, 10, 3],
        "names": ["height", "width", "channels"],
    }
    assert info["video_path"] is None
    assert set(info["features"]) == set(rows(dataset, "data")[0])


def test_episodes_say_where_they_come_from_and_where_they_are(dataset: Path) -> None:
    described = rows(dataset, "meta/episodes")
    assert [e["episode_id"] for e in described] == [e.episode_id for e in DONE]
    ends = np.cumsum([0, *(e.num_steps for e in DONE)]).tolist()
    for k, (row, one) in enumerate(zip(described, DONE, strict=True)):
        assert (row["dataset_from_index"], row["dataset_to_index"], row["length"]) == (ends[k], ends[k + 1], one.num_steps)
        assert (row["scene_id"], row["seed"], row["split"], row["success"]) == (one.scene_id, one.seed, "train", True)
        assert row["tasks"] == [one.instruction]
        assert row["stats/action/max"] == one.actions.max(axis=0).tolist()
    stats = json.loads((dataset / "meta/stats.json").read_text())
    whole = np.concatenate([e.actions for e in DONE]).astype(np.float64)
    assert np.allclose(stats["action"]["mean"], whole.mean(axis=0))
    assert np.allclose(stats["action"]["std"], whole.std(axis=0))
    assert np.shape(stats["observation.images.front"]["mean"]) == (3, 1, 1)


def test_hugging_face_datasets_shows_pictures(dataset: Path) -> None:
    import datasets

    opened = datasets.Dataset.from_parquet(
        str(dataset / "data/chunk-000/file-000.parquet"), cache_dir=str(dataset.parent / "cache")
    )
    assert opened[0]["observation.images.front"].size == (10, 8)
    assert opened.features["action"].length == 8


def test_full_files_are_followed_by_others(tmp_path: Path) -> None:
    out = written(tmp_path / "out", DONE, max_bytes=8_000, chunk_files=2)
    files = sorted(path.relative_to(out / "data").as_posix() for path in (out / "data").rglob("*.parquet"))
    assert files[:3] == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    for row in rows(out, "meta/episodes"):
        place = f"chunk-{row['data/chunk_index']:03d}/file-{row['data/file_index']:03d}.parquet"
        indices = pq.read_table(out / "data" / place, columns=["episode_index"])["episode_index"].to_pylist()
        assert indices.count(row["episode_index"]) == row["length"]
    assert [frame["index"] for frame in rows(out, "data")] == list(range(sum(e.num_steps for e in DONE)))


def test_many_episodes_are_described_in_several_row_groups_and_files(tmp_path: Path) -> None:
    many = [episode(f"scene-{k}", steps=2, environment=0) for k in range(230)]
    out = written(tmp_path / "out", many, max_bytes=150_000)
    described = rows(out, "meta/episodes")
    assert [row["episode_index"] for row in described] == list(range(230))
    places = [(row["meta/episodes/chunk_index"], row["meta/episodes/file_index"]) for row in described]
    files = sorted((out / "meta/episodes").glob("*/*.parquet"))
    assert len(files) > 1
    assert [place for k, path in enumerate(files) for place in [(0, k)] * pq.read_metadata(path).num_rows] == places
    assert "observation.environment_state" not in rows(out, "data")[0]


def test_a_state_of_one_number_is_a_number(tmp_path: Path) -> None:
    one = episode(state_names=("width",), states=np.zeros((12, 1)))
    assert rows(written(tmp_path / "out", [one]), "data")[0]["observation.state"] == 0.0


def test_selections(run: RunFolder, tmp_path: Path) -> None:
    def ids(name: str, **choice: Any) -> list[str]:
        write_lerobot(run, tmp_path / name, EpisodeSelection(**choice))
        return [row["episode_id"] for row in rows(tmp_path / name, "meta/episodes")]

    assert ids("all", with_failures=True) == [e.episode_id for e in EPISODES]
    assert ids("some", where="task_kind == 'pick' or seed < 0", limit=2) == ["scene-0/1", "scene-1/1"]
    assert ids("scene", scene_ids=("scene-2",)) == ["scene-2/0", "scene-2/1"]
    assert ids("failed", where="not success", with_failures=True) == ["scene-0/2", "scene-1/2", "scene-2/2"]
    assert not any(frame["next.success"] for frame in rows(tmp_path / "failed", "data"))


def refusal(run: RunFolder, out: Path, **choice: Any) -> str:
    with pytest.raises((ConfigError, EpisodeError)) as refused:
        write_lerobot(run, out, EpisodeSelection(**choice))
    assert "\n" not in str(refused.value)
    assert list(out.parent.iterdir()) == []
    return str(refused.value)


def test_what_cannot_be_exported_is_refused_and_leaves_nothing(run: RunFolder, tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    assert "add --failures" in refusal(run, place / "x", where="not success")
    assert "change the selection" in refusal(run, place / "x", where="num_steps > 99")
    assert "no episodes of scenes ['none']" in refusal(run, place / "x", scene_ids=("scene-1", "none"))
    assert "num_objects" in refusal(run, place / "x", where="num_objects > 1")
    for change, said in (
        ({"fps": 10.0}, "scene-9/0: fps is 10.0, expected 20.0"),
        ({"robot": "ur5e"}, "robot is 'ur5e', expected 'panda'"),
        ({"state_names": tuple("abcdefg")}, "state_names is"),
        ({"cameras": ("front",)}, "cameras is"),
        ({"cameras": ("front", "wrist"), "size": (6, 6)}, "image_size is (6, 6), expected (8, 10)"),
    ):
        size: dict[str, Any] = {"cameras": ("front", "wrist"), "size": (8, 10)} | change
        mixed = write_run(tmp_path / "-".join(change), [EPISODES[0], episode("scene-9", **size)])
        assert said in refusal(mixed, place / "x")
    slow = write_run(tmp_path / "slow", [episode(fps=12.5)])
    assert "fps is 12.5, expected a whole number" in refusal(slow, place / "x")
    broken = episode(cameras=("front",))
    cut = {"front": tuple(content[:60] for content in broken.pictures["front"])}
    damaged = write_run(tmp_path / "damaged", [episode(pictures=cut, image_size=(64, 80))])
    assert "picture 0 of camera front cannot be decoded" in refusal(damaged, place / "x")


def test_a_video_needs_an_encoder_and_even_sizes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = episode(cameras=("front",), steps=2)
    monkeypatch.setattr("stable_data.robot.lerobot.videos.encoder_names", list)
    with pytest.raises(ConfigError, match="neither PyAV nor the program ffmpeg is there; install one of them"):
        LeRobotWriter(tmp_path / "x", one.features, is_video=True)
    monkeypatch.setattr("stable_data.robot.lerobot.videos.encoder_names", lambda: ["ffmpeg"])
    with pytest.raises(ConfigError, match="pictures have 65 x 80 pixels, expected even numbers from 64 on"):
        LeRobotWriter(tmp_path / "x", episode(cameras=("front",), size=(65, 80), steps=2).features, is_video=True)
    assert not (tmp_path / "x").exists()
    written(tmp_path / "states", [episode()], is_video=True)  # without pictures there is nothing to encode


def test_an_encoder_that_fails_is_an_error_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\necho 'Unknown encoder libsvtav1' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:/usr/bin:/bin")
    monkeypatch.setattr("stable_data.robot.lerobot.videos.encoder_names", lambda: ["ffmpeg"])
    run = write_run(tmp_path / "run", [episode(cameras=("front",), steps=40)])
    with pytest.raises(ConfigError, match="Unknown encoder libsvtav1"):
        write_lerobot(run, tmp_path / "out" / "x", is_video=True)
    assert not list((tmp_path / "out").iterdir())


def test_the_command_writes_and_refuses(run: RunFolder, tmp_path: Path) -> None:
    def call(*words: str) -> Any:
        return CliRunner().invoke(app, ["export", run.root, *words])

    done = call(str(tmp_path / "out"), "--format", "lerobot", "--limit", "5")
    assert done.exit_code == 0, done.stderr
    assert "5 episodes as a LeRobotDataset v3.0" in done.stdout
    assert "3 failed episodes are left out, --failures exports them too" in done.stdout
    for words, said in (
        ((str(tmp_path / "out"), "--format", "lerobot"), "exists already"),
        ((str(tmp_path / "x"), "--format", "lerobot", "--settled"), "leave out --settled"),
        ((str(tmp_path / "x"), "--format", "mjcf", "--failures"), "options of --format lerobot"),
    ):
        refused = call(*words)
        assert refused.exit_code == 2
        assert said in refused.stderr
    query = CliRunner().invoke(app, ["query", run.root, "success", "--to", str(tmp_path / "x"), "--format", "lerobot"])
    assert query.exit_code == 2
