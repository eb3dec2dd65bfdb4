"""docs/generate.md: its settings are those of the job, all of them, its commands are commands, and its links lead somewhere."""

import re
import shlex
from dataclasses import fields
from itertools import zip_longest
from pathlib import Path

from typer.testing import CliRunner

from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.__main__ import app
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import GenerateWork
from pipelines.sources.tasks import read_tasks

DOC = Path(__file__).resolve().parents[3] / "docs" / "generate.md"
TEXT = DOC.read_text("utf-8")


def test_it_has_every_setting_with_its_default() -> None:
    table = TEXT.partition("## Settings")[2]
    told: dict[str, str] = {}
    for names, defaults in re.findall(r"^\| (`[^|]*`) \|([^|]*)\|", table, re.MULTILINE):
        told |= dict(zip_longest(re.findall(r"`([^`]+)`", names), defaults.strip().split(", "), fillvalue=""))
    nested = {name.partition(".")[0] for name in told if name.endswith(".*")}
    known = {field.name: str(getattr(GenerateSettings(), field.name)) for field in fields(GenerateSettings)}
    assert known.keys() == nested | {name for name in told if not name.endswith(".*")}
    assert {name: told[name] for name in known if name not in nested} == {
        name: value.lower() if value in ("True", "False") else value for name, value in known.items() if name not in nested
    }


def test_its_commands_are_commands(clean_run: Path, tmp_path: Path) -> None:
    commands = re.findall(r"^python -m pipelines (.*)$", TEXT, re.MULTILINE)
    assert len(commands) > 1
    for command in commands:
        words = shlex.split(command.replace("OUT", str(tmp_path / "out")).replace("transformers:MODEL", "embedded"))
        words = [str(clean_run) if word == "RUN" else word for word in words]
        words = ["2" if word == "100000" else word for word in words]  # the fewer are as good a plan
        result = CliRunner().invoke(app, [*words, "--dry-run"])
        assert result.exit_code == 0, result.output
    assert not (tmp_path / "out").exists()


def test_its_task_file_can_be_read(tmp_path: Path) -> None:
    (block,) = re.findall(r"```json\n(.*?)```", TEXT, re.DOTALL)
    path = tmp_path / "tasks.jsonl"
    path.write_text(block)
    found = list(read_tasks(path))
    assert len(found) == 2
    assert all(isinstance(task, LayoutTask) for task in found)


def test_it_has_every_table_and_no_dead_link() -> None:
    assert all(f"`{table}`" in TEXT for table in GenerateWork.TABLES)
    assert all((DOC.parent / link.partition("#")[0]).exists() for link in re.findall(r"\]\(([^)]+)\)", TEXT))
