"""Episodes exported as LeRobotDataset v3.0, opened by LeRobot: frames, statistics, tools and a training."""

import json
import shutil
from pathlib import Path

import pytest

from benchmarks.consumers.__main__ import export_episodes
from benchmarks.consumers.environment import CONSUMERS
from stable_data.robot.lerobot.videos import encoder_names
from tests.stable_data.robot.synthetic_episodes import episode, write_run

pytestmark = [pytest.mark.slow]

CONSUMER = CONSUMERS["lerobot_dataset"]


@pytest.fixture(scope="module", autouse=True)
def _needs_lerobot() -> None:
    if not CONSUMER.is_there:
        pytest.skip(CONSUMER.missing)


def exported(folder: Path, *, cameras: tuple[str, ...] = (), size: tuple[int, int] = (64, 80), is_video: bool = False) -> Path:
    episodes = [episode(f"scene-{s}", k, steps=9 + 3 * s + k, cameras=cameras, size=size) for s in range(3) for k in range(3)]
    out = folder / "opened"
    out.mkdir()
    export_episodes(write_run(folder / "run", episodes), out, is_video=is_video)
    return out


@pytest.mark.parametrize("cameras", [(), ("front", "wrist")])
def test_lerobot_sees_what_the_table_says_and_trains(cameras: tuple[str, ...], tmp_path: Path) -> None:
    [seen] = CONSUMER.open([exported(tmp_path, cameras=cameras)])
    assert seen["error"] is None
    assert seen["problems"] == []
    assert (seen["episodes"], seen["frames"]) == (9, 3 * sum((9, 12, 15)) + 3 * sum((0, 1, 2)))
    assert seen["last_loss"] < seen["first_loss"]


def test_large_pictures_have_the_same_statistics(tmp_path: Path) -> None:
    """LeRobot thins out pictures from 300 pixels on."""
    episodes = [episode("scene", k, steps=4, cameras=("front",), size=(240, 320)) for k in range(2)]
    (tmp_path / "opened").mkdir()
    export_episodes(write_run(tmp_path / "run", episodes), tmp_path / "opened")
    [seen] = CONSUMER.open([tmp_path / "opened"])
    assert (seen["error"], seen["problems"]) == (None, [])


@pytest.mark.parametrize("encoder", ["pyav", "ffmpeg"])
def test_videos_show_the_pictures(encoder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if encoder not in encoder_names():
        pytest.skip(f"{encoder} is not installed")
    monkeypatch.setattr("stable_data.robot.lerobot.videos.encoder_names", lambda: [encoder])
    [seen] = CONSUMER.open([exported(tmp_path, cameras=("front", "wrist"), is_video=True)])
    assert (seen["error"], seen["problems"]) == (None, [])


def test_each_kind_of_fault_is_found(tmp_path: Path) -> None:
    """A wrong statistic, another action in the table, another type of info.json, and a lost file."""
    out = exported(tmp_path)
    names = ("statistic", "table", "info", "lost")
    for name in names:
        shutil.copytree(out / "dataset", tmp_path / name / "dataset")
        (tmp_path / name / "run").symlink_to((tmp_path / "run").resolve())
    stats = json.loads((out / "dataset/meta/stats.json").read_text())
    stats["action"]["std"][0] *= 1.1
    (tmp_path / "statistic/dataset/meta/stats.json").write_text(json.dumps(stats))
    (tmp_path / "table/run").unlink()
    other = [episode(f"scene-{s}", k, steps=9 + 3 * s + k) for s in range(3) for k in range(3)]
    other[4] = episode("scene-1", 1, steps=13, actions=other[4].actions + 1e-6)
    write_run(tmp_path / "table/run", other)
    info = json.loads((out / "dataset/meta/info.json").read_text())
    (tmp_path / "info/dataset/meta/info.json").write_text(json.dumps(info | {"robot_type": 7, "splits": {}}))
    (tmp_path / "lost/dataset/data/chunk-000/file-000.parquet").unlink()
    statistic, table, described, lost = CONSUMER.open([tmp_path / name for name in names])
    assert len(statistic["problems"]) == 1
    assert "all: action: std" in statistic["problems"][0]
    assert {line.partition(": ")[2] for line in table["problems"]} >= {"action differs", "the chunk of actions differs"}
    assert any("info.json: splits" in line for line in described["problems"])
    assert lost["error"]
