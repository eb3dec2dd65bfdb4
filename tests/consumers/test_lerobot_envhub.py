"""An EnvHub folder in LeRobot: its own code makes the environments and rolls a policy out."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.consumers.environment import CONSUMERS
from stable_data.condition import ConditionKind, GoalCondition
from stable_data.robot.env import RobotOptions
from stable_data.robot.envhub import write_envhub
from stable_data.scene import TaskInfo
from tests.stable_data.export.runs import write_run
from tests.stable_data.robot.tables import CAN, laid_table

pytestmark = [pytest.mark.slow]

CONSUMER = CONSUMERS["lerobot_envhub"]


def folder_in(place: Path) -> Path:
    task = TaskInfo("", "Pick up the can.", task_objects=(CAN,), conditions=(GoalCondition(CAN, ConditionKind.HELD),))
    scenes = [replace(laid_table(), scene_id=f"laid-{k}", task=task) for k in range(2)]
    write_envhub(write_run(place / "run", scenes), place / "hub", None, RobotOptions(robot="simple", max_steps=4))
    return place / "hub"


def test_lerobot_rolls_out_in_the_environments(tmp_path: Path) -> None:
    if not CONSUMER.is_there:
        pytest.skip(CONSUMER.missing)
    assert CONSUMER.open([folder_in(tmp_path)]) == [{"error": None, "problems": []}]


def test_a_folder_that_is_none_is_an_error(tmp_path: Path) -> None:
    if not CONSUMER.is_there:
        pytest.skip(CONSUMER.missing)
    folder = folder_in(tmp_path)
    (folder / "settings.json").write_text("{}", "utf-8")
    [seen] = CONSUMER.open([folder])
    assert "is no settings file" in seen["error"]
