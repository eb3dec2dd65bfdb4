"""The command that counts the goals of a run."""

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.storage.run_folder import RunFolder
from stable_data.tasks.run_goals import UNUSABLE, goals_table, run_goals

pytestmark = pytest.mark.filterwarnings("ignore::stable_data.errors.MissingColumnsWarning")

RUN = Path(__file__).parents[2] / "data" / "run_v3" / "preprocess"


def test_every_task_of_a_run_has_a_goal_or_a_reason() -> None:
    found = list(run_goals(RunFolder(str(RUN))))
    assert found
    assert all((one.goal is None) == bool(one.code) == bool(one.message) for one in found)
    assert len(list(run_goals(RunFolder(str(RUN)), limit=1))) == 1
    lines = goals_table(found).splitlines()
    assert lines[0].split()[:2] == ["goals", str(sum(one.goal is not None for one in found))]


def test_a_row_that_is_no_scene_costs_no_other_goal(tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(RUN, run)
    file = next((run / "scenes").glob("part-*.parquet"))
    rows = pq.read_table(file)
    sizes = rows["table_size"].to_pylist()
    column = pa.array([None, *sizes[1:]], rows.schema.field("table_size").type)
    pq.write_table(rows.set_column(rows.schema.get_field_index("table_size"), rows.schema.field("table_size"), column), file)
    found = list(run_goals(RunFolder(str(run))))
    assert len(found) == len(list(run_goals(RunFolder(str(RUN)))))
    (lost,) = (one for one in found if one.scene is None)
    assert lost.code == UNUSABLE
    result = CliRunner().invoke(app, ["tasks", str(run)])
    assert result.exit_code == 0, result.output
    assert "the row of its scene cannot be used" in result.output


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
