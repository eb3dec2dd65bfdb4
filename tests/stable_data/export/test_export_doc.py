"""docs/export.md as written: its commands and its code, on a small run."""

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.commands.command_line import DONE
from stable_data.storage.run_folder import RunFolder

pytestmark = pytest.mark.sim

DOC = (Path(__file__).parents[3] / "docs" / "export.md").read_text("utf-8")
CODE = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
COMMANDS = [line for line in DOC.splitlines() if line.startswith("stable-data export RUN ")]


def exported(command: str, run: RunFolder, out: Path) -> Path:
    """Runs a command of the page and gives the folder that it wrote."""
    program, verb, source, target, *options = shlex.split(command)
    assert (program, verb, source) == ("stable-data", "export", "RUN")
    result = CliRunner().invoke(app, [verb, run.uri, str(out / target), *options])
    assert result.exit_code == DONE, result.stderr
    return out / target


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_runs_as_written(command: str, run: RunFolder, tmp_path: Path) -> None:
    assert (exported(command, run, tmp_path) / "README.md").is_file()


def test_the_documented_code_opens_a_model(run: RunFolder, tmp_path: Path) -> None:
    [mjcf] = [command for command in COMMANDS if "mjcf_files" in command]
    code, _ = CODE
    names: dict[str, Any] = {"OUT": exported(mjcf, run, tmp_path), "SCENE": "falling"}
    exec(code, names)  # noqa: S102
    assert names["data"].time == pytest.approx(1.0)
    assert np.isfinite(names["data"].qpos).all()


def test_the_documented_code_places_objects(run: RunFolder, tmp_path: Path) -> None:
    [command] = [command for command in COMMANDS if "mjcf-objects" in command]
    _, code = CODE
    names: dict[str, Any] = {"OUT": exported(command, run, tmp_path), "SCENE": "falling"}
    exec(code, names)  # noqa: S102
    assert names["model"].njnt == len(names["layout"]["objects"]) == 2
