"""The demonstrate job: each episode is one row, local is Ray is resumed, and what cannot begin says why."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.demonstrate import environments
from pipelines.demonstrate.environments import EpisodeRef, open_episode
from pipelines.demonstrate.job import demonstrate
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.execution.ray_executor import WorkerPool
from stable_data.condition import ConditionKind, GoalCondition
from stable_data.errors import ConfigError
from stable_data.robot.acting.recording import record_episode
from stable_data.robot.episodes import episode_from_row
from stable_data.scene import Scene, Tabletop, TaskInfo
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.export.runs import thing, write_run
from tests.stable_data.robot.tables import CAN, laid_table

IN_PROCESS = WorkerPool(0)
SETTINGS = DemonstrateSettings(robot="simple", mount="front", max_steps=80, scenes_per_shard=1, num_pictures=2)


def asked(scene: Scene, *conditions: GoalCondition) -> Scene:
    task = TaskInfo("", "Do it.", task_objects=(CAN,), conditions=conditions)
    return replace(scene, task=task)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> str:
    held = GoalCondition(CAN, ConditionKind.HELD)
    far = Scene("far", Tabletop("desk", (1.0, 3.0)), (thing("can/0", CAN, 0.5, 2.9, 0.0),))
    found = [
        asked(laid_table(), held),
        replace(laid_table(), scene_id="untold", task=TaskInfo("", "Sing.", task_objects=(CAN,))),
        asked(far, held),
    ]
    return write_run(tmp_path_factory.mktemp("demonstrate") / "run", found).uri


def rows_of(out: Path) -> list[dict[str, Any]]:
    rows = [episode_from_row(row) for row in RunFolder(str(out)).table("episodes").to_pylist()]
    return [
        {"id": e.episode_id, "reason": e.reason, "actions": e.actions.tobytes(), "poses": e.object_poses.tobytes()}
        for e in rows
    ]


@pytest.fixture(scope="module")
def made(scenes: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demonstrate") / "out"
    demonstrate(scenes, str(out), SETTINGS, IN_PROCESS)
    return out


def test_each_episode_is_a_row_or_a_failure(made: Path) -> None:
    assert {row["id"]: row["reason"] for row in rows_of(made)} == {"laid/0": None}
    failures = {row["id"]: row for row in RunFolder(str(made)).table("failures").to_pylist()}
    assert {name: (row["step"], row["code"]) for name, row in failures.items()} == {
        "untold/0": ("scene", "no_goal"),
        "far/0": ("scene", "nothing_reachable"),
    }
    assert f"({CAN} out_of_reach)" in failures["far/0"]["message"]
    counts = json.loads((made / "manifest.json").read_text("utf-8"))["counts"]
    assert (counts["successes"], counts["episodes"], counts["failed_episodes"]) == (1, 1, 2)
    page = (made / "report" / "index.html").read_text("utf-8")
    assert "episodes that fulfil their goal" in page


def test_a_run_that_stopped_continues_to_the_same_rows(scenes: str, made: Path, tmp_path: Path) -> None:
    demonstrate(scenes, str(tmp_path / "out"), SETTINGS, IN_PROCESS)
    lost = sorted((tmp_path / "out" / "episodes").glob("*.parquet"))[0]
    lost.unlink()
    demonstrate(scenes, str(tmp_path / "out"), SETTINGS, IN_PROCESS)
    assert sorted(rows_of(tmp_path / "out"), key=lambda r: r["id"]) == sorted(rows_of(made), key=lambda r: r["id"])


@pytest.mark.slow
def test_workers_give_the_same_rows(scenes: str, made: Path, tmp_path: Path) -> None:
    demonstrate(scenes, str(tmp_path / "out"), SETTINGS, WorkerPool(2))
    assert sorted(rows_of(tmp_path / "out"), key=lambda r: r["id"]) == sorted(rows_of(made), key=lambda r: r["id"])


def test_other_settings_are_refused(scenes: str, made: Path) -> None:
    with pytest.raises(ConfigError, match="noise"):
        demonstrate(scenes, str(made), replace(SETTINGS, noise=0.1), IN_PROCESS)


def test_picks_are_of_different_objects(scenes: str, tmp_path: Path) -> None:
    settings = replace(SETTINGS, task="pick", episodes=3, max_steps=8)
    demonstrate(scenes, str(tmp_path / "out"), settings, IN_PROCESS, where="scene_id == 'laid'")
    told = RunFolder(str(tmp_path / "out")).table("episodes", ["instruction", "task_kind", "reason"]).to_pylist()
    assert len(told) == 3
    assert len({row["instruction"] for row in told}) > 1
    assert {row["task_kind"] for row in told} == {"pick"}
    assert {row["reason"] for row in told} == {"too_long"}


def test_the_command_line_writes_a_lerobot_dataset(scenes: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["demonstrate", "--scenes", scenes, "--out", str(out), "--robot", "simple", "--where", "scene_id == 'laid'"]
    command += ["--workers", "0", "--lerobot", "--set", "max_steps=80"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "1 fulfil their goal" in result.output
    frames = pl.read_parquet(out / "lerobot" / "data" / "chunk-000" / "file-000.parquet")
    assert frames.height == pl.read_parquet(out / "episodes" / "*.parquet")["num_steps"].sum()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--robot", "ur99"], "robot is 'ur99'"),
        (["--where", "scene_id == 'nowhere'"], "has no scenes where"),
        (["--set", 'cameras=["roof"]'], "demonstrate.cameras"),
        (["--set", "control=thought"], "demonstrate.control"),
        (["--set", "settled=true"], "expected rows of the table settled"),
    ],
)
def test_what_cannot_start_says_so_in_one_line(words: list[str], message: str, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", (laid_table(),))
    if "settled" in str(words):
        for file in (tmp_path / "run" / "settled").glob("*.parquet"):
            file.unlink()
    robot = [] if "--robot" in words else ["--robot", "simple"]
    result = CliRunner().invoke(app, ["demonstrate", "--scenes", run.uri, "--out", str(tmp_path / "out"), *robot, *words])
    assert result.exit_code == 2
    assert message in result.output + result.stderr
    assert not (tmp_path / "out").exists()


def test_an_episode_in_a_kept_environment_is_the_same_as_in_a_new_one(scenes: str) -> None:
    settings = replace(SETTINGS, task="pick")

    def record(number: int) -> bytes:
        found = open_episode(scenes, EpisodeRef("laid", number), settings)
        return record_episode(found.env, number=number, seed=found.seed).object_poses.tobytes()

    after_others = [record(number) for number in range(4)]
    environments._opened_picks.cache_clear()
    assert record(3) == after_others[3]
