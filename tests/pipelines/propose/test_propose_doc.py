"""docs/propose.md: its settings are those of the job, its task file can be read, and its links lead somewhere."""

import re
from pathlib import Path

from models.semantic_reasoner.engines.registry import KINDS
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.propose.settings import ProposeSettings
from pipelines.settings import resolve
from pipelines.sources.tasks import read_tasks

DOC = Path(__file__).resolve().parents[3] / "docs" / "propose.md"
TEXT = DOC.read_text("utf-8")


def test_its_settings_are_settings() -> None:
    written = re.findall(r"--set ([a-z_]+\.\S+=\S+)", TEXT)
    assert len(written) > 5
    resolve(ProposeSettings, "propose", None, written)
    table = TEXT.partition("## Settings")[2].partition("## Forty")[0]
    for names, defaults in re.findall(r"^\| `([^|]*)` \| ([^|]*) \|", table, re.MULTILINE):
        last = ""
        for name, default in zip(names.split("`, `"), defaults.split(", "), strict=False):
            name = last.rpartition(".")[0] + name if name.startswith(".") else name
            last = name
            if not name.endswith("*") and default not in ("", "none", "the engine's own"):
                resolve(ProposeSettings, "propose", None, [f"{name}={default}"])
                found: object = ProposeSettings()
                for part in name.split("."):
                    found = getattr(found, part)
                assert str(found).lower() == default, name


def test_its_task_file_can_be_read(tmp_path: Path) -> None:
    (block,) = re.findall(r"```json\n(.*?)```", TEXT, re.DOTALL)
    path = tmp_path / "tasks.jsonl"
    path.write_text(block)
    found = list(read_tasks(path))
    assert len(found) == 2
    assert all(isinstance(task, LayoutTask) for task in found)


def test_it_has_every_engine_and_no_dead_link() -> None:
    assert all(re.search(rf"^\| `{kind}", TEXT, re.MULTILINE) for kind in KINDS)
    assert all((DOC.parent / link.partition("#")[0]).exists() for link in re.findall(r"\]\(([^)]+)\)", TEXT))
