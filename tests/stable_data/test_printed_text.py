"""Names from files cannot act on a terminal: what is printed is escaped, wherever it is printed."""

import ast
import pickle
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from stable_data.cli import app
from stable_data.commands.command_line import echo
from stable_data.errors import MeshError, Notice, one_line

ROOT = Path(__file__).parents[2]
HOSTILE = "\x1b[2J\x1b]0;title\x07mug\r\n\u202etxt.exe\ud800\x00"
ESCAPED = r"\x1b[2J\x1b]0;title\x07mug\r\n\u202etxt.exe\ud800\x00"


def test_errors_and_notices_are_one_line_that_can_be_printed() -> None:
    assert str(MeshError(HOSTILE, "x")) == one_line(HOSTILE) == ESCAPED
    assert Notice("mug", "read", "x", HOSTILE).message == ESCAPED
    assert str(pickle.loads(pickle.dumps(MeshError(HOSTILE, "x")))) == ESCAPED
    words = "tasse à café — 1 µm “ß” 漢字"
    assert one_line(words) == words


def test_commands_print_lines_and_no_other_control_characters(capfd: pytest.CaptureFixture[str]) -> None:
    echo("one\ntwo\t\x1b[31m\r")
    echo(HOSTILE, err=True)
    out, err = capfd.readouterr()
    assert out == "one\ntwo\\t\\x1b[31m\\r\n"
    assert err == ESCAPED.replace(r"\n", "\n") + "\n"


def test_a_hostile_manifest_is_shown_escaped(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"job": "\\u001b[2J\\u202e"}')
    result = CliRunner().invoke(app, ["inspect", str(tmp_path)])
    assert result.exit_code == 0
    assert "\x1b" not in result.stdout
    assert r"\x1b[2J\u202e" in result.stdout.replace(r"\u001b", r"\x1b")


@pytest.mark.parametrize("content", [b"\xff", b"{" * 100_000, b"[" * 100_000 + b"]" * 100_000, b'{"a":' + b"9" * 5000 + b"}"])
def test_a_damaged_manifest_is_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_bytes(content)
    result = CliRunner().invoke(app, ["inspect", str(tmp_path)])
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "unexpected" not in result.stderr


def test_nothing_is_printed_in_another_way() -> None:
    """``typer.echo`` and ``print`` would pass control characters on."""
    ways = ("typer.echo", "click.echo", "typer.secho", "print")
    offending = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for package in ("stable_data", "models", "pipelines")
        for path in sorted((ROOT / package).rglob("*.py"))
        if re.search(r"\b(echo|secho|print)\b", text := path.read_text("utf-8"))  # parsing takes nearly all the time
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ways
    ]
    assert len(offending) == 1, offending  # echo itself
    assert offending[0].startswith("stable_data/commands/command_line.py")
