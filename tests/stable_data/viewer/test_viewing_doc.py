"""docs/viewing.md as written: its commands and its code, on a small run."""

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.storage.run_folder import RunFolder
from tests.stable_data.viewer.pages import Page

ROOT = Path(__file__).parents[3]
DOC = (ROOT / "docs" / "viewing.md").read_text("utf-8")
COMMANDS = re.findall(r"^stable-data .*$", DOC, re.MULTILINE)


def test_the_command_of_a_page_runs_as_written(viewed_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    [command] = [command for command in COMMANDS if "--page" in command]
    done = CliRunner().invoke(app, [part.replace("RUN", viewed_run.uri) for part in shlex.split(command)[1:]])
    assert done.exit_code == 0, done.output
    assert len(Page(Path("scenes.html").read_text("utf-8")).articles) == 3


def test_the_command_of_the_viewer_runs_until_it_is_interrupted(viewed_run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(seconds: float) -> None:
        if seconds > 1000:
            raise KeyboardInterrupt

    monkeypatch.setattr("stable_data.viewer.live.time.sleep", interrupt)
    [command] = [command for command in COMMANDS if "--live" in command]
    options = [part.replace("RUN", viewed_run.uri) for part in shlex.split(command)[1:]]
    done = CliRunner().invoke(app, [*options, "--port", "0"])
    assert done.exit_code == 0, done.output
    assert re.search(r"4 scenes at http://127\.0\.0\.1:\d+; Ctrl-C ends the viewer", done.output)


def test_the_documented_code_writes_a_page(viewed_run: RunFolder, tmp_path: Path) -> None:
    [code] = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
    exec(code, {"RUN": viewed_run.uri, "OUT": str(tmp_path / "page.html")})  # noqa: S102
    assert len(Page((tmp_path / "page.html").read_text("utf-8")).articles) == 3


def test_the_pictures_are_small() -> None:
    for name in re.findall(r"\]\((pictures/\S+)\)", DOC):
        assert (ROOT / "docs" / name).stat().st_size < 250_000
