"""docs/reasoner.md: the settings of its engines are those of the jobs, and its links lead somewhere."""

import re
from pathlib import Path

from models.semantic_reasoner.engines.registry import KINDS
from pipelines.generate.settings import GenerateSettings
from pipelines.settings import resolve_settings

DOC = Path(__file__).resolve().parents[2] / "docs" / "reasoner.md"
TEXT = DOC.read_text("utf-8")
ENGINES = TEXT.partition("## Engines")[2].partition("## Training")[0]


def test_its_settings_are_settings() -> None:
    written = re.findall(r"--set ([a-z_]+\.\S+=\S+)", ENGINES)
    assert len(written) > 5
    resolve_settings(GenerateSettings, "generate", None, written)
    checked = 0
    for names, defaults in re.findall(r"^\| `([^|]*)` \| ([^|]*) \|", ENGINES.partition("### Settings")[2], re.MULTILINE):
        last = ""
        for name, default in zip(names.split("`, `"), defaults.split(", "), strict=False):
            name = last.rpartition(".")[0] + name if name.startswith(".") else name
            last = name
            if not name.endswith("*") and default not in ("", "none", "the engine's own"):
                resolve_settings(GenerateSettings, "generate", None, [f"{name}={default}"])
                found: object = GenerateSettings()
                for part in name.split("."):
                    found = getattr(found, part)
                assert str(found).lower() == default, name
                checked += 1
    assert checked > 5


def test_it_has_every_engine_and_no_dead_link() -> None:
    assert all(re.search(rf"^\| `{kind}", ENGINES, re.MULTILINE) for kind in KINDS)
    assert all((DOC.parent / link.partition("#")[0]).exists() for link in re.findall(r"\]\(([^)]+)\)", TEXT))
