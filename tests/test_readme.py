"""What the README and CONTRIBUTING name is there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "CONTRIBUTING.md")
TEXT = "\n".join((ROOT / page).read_text("utf-8") for page in PAGES)


def test_both_commands_are_on_the_first_screen() -> None:
    first = "\n".join((ROOT / "README.md").read_text("utf-8").splitlines()[:20])
    assert "make demo" in first
    assert "make test" in first


@pytest.mark.parametrize("target", sorted(set(re.findall(r"`?make ([a-z-]+)", TEXT))))
def test_every_make_target_exists(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([^)#:]+)\)", TEXT))))
def test_every_link_leads_somewhere(link: str) -> None:
    assert (ROOT / link).exists()


@pytest.mark.parametrize("verb", sorted(set(re.findall(r"^stable-data ([a-z]+)", TEXT, re.MULTILINE))))
def test_every_verb_of_the_command_line_exists(verb: str) -> None:
    done = subprocess.run([sys.executable, "-m", "stable_data", verb, "--help"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_make_help_lists_every_public_target() -> None:
    listed = subprocess.run(["make", "help"], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    for target in ("demo", "test", "lint", "preprocess", "bench", "schemas", "clean"):
        assert f"make {target}" in listed
