"""Names that are gone: one line says what to write instead, wherever they are written."""

from pathlib import Path

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.generate.settings import GenerateSettings
from pipelines.retired import RETIRED
from pipelines.settings import resolve_settings
from stable_data.errors import ConfigError

TABLE = ["--table", "dining_table", "--size", "120", "80"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["propose"], "generate --instruction"),
        (["propose", "--help"], "--set corrects=never --set accept="),
        (["propose", "--instruction", "Lift it.", *TABLE, "--one-shot", "--set", "pictures=false"], "--format mesatask"),
        (["generate", "--instruction", "Lift it.", *TABLE, "--one-shot"], "--set schedule=whole"),
    ],
)
def test_a_retired_name_is_one_line_and_status_2(words: list[str], message: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    (line,) = done.output.strip().splitlines()
    assert line.startswith("error: ")
    assert " is retired; write python -m pipelines generate " in line
    assert message in line
    assert not (tmp_path / "out").exists()


def test_the_table_of_a_retired_verb_is_refused_likewise(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[generate]\n[propose]\none_shot = true\n")
    with pytest.raises(ConfigError, match=r"run.toml: the table \[propose\] .* write python -m pipelines generate") as caught:
        resolve_settings(GenerateSettings, "generate", file, [])
    assert caught.value.code == "retired"


def test_no_name_that_is_there_is_retired() -> None:
    commands = get_command(app).commands  # type: ignore[attr-defined]
    there = {*commands, *(f"{verb} {option}" for verb, found in commands.items() for p in found.params for option in p.opts)}
    assert "generate --count" in there
    assert not there & RETIRED.keys()


def test_other_unknown_verbs_are_usage_errors_as_ever() -> None:
    done = CliRunner().invoke(app, ["generrate"])
    assert done.exit_code == 2
    assert "No such command" in done.output
    assert "unexpected" not in done.output
    assert isinstance(app, typer.Typer)
