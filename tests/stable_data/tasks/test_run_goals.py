"""The command that counts the goals of a run."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.storage.run_folder import RunFolder
from stable_data.tasks.run_goals import goals_table, run_goals

pytestmark = pytest.mark.filterwarnings("ignore::stable_data.errors.MissingColumnsWarning")

RUN = Path(__file__).parents[2] / "data" / "run_v3" / "preprocess"


def test_every_task_of_a_run_has_a_goal_or_a_reason() -> None:
    found = list(run_goals(RunFolder(str(RUN))))
    assert found
    assert all((one.goal is None) == bool(one.code) == bool(one.message) for one in found)
    assert len(list(run_goals(RunFolder(str(RUN)), limit=1))) == 1
    lines = goals_table(found).splitlines()
    assert lines[0].split()[:2] == ["goals", str(sum(one.goal is not None for one in found))]


def test_the_command_prints_a_table_and_examples() -> None:
    result = CliRunner().invoke(app, ["tasks", str(RUN)])
    assert result.exit_code == 0, result.output
    assert "goals" in result.output
    assert "without a goal" in result.output


def test_the_command_refuses_what_is_no_run(tmp_path: Path) -> None:
    assert CliRunner().invoke(app, ["tasks", str(tmp_path)]).exit_code == 2
    result = CliRunner().invoke(app, ["tasks", str(RUN), "--where", "num_objects > 1000"])
    assert result.exit_code == 2
    assert "no scene is selected" in result.output
