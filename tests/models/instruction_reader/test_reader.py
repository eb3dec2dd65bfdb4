"""The shipped reader: what it reads in sentences that are in no frame."""

from pathlib import Path

import pytest

from benchmarks.understanding import compare, figures_of
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reader import InstructionReader
from models.instruction_reader.reading import InstructionReading
from tests.models.semantic_reasoner.handwritten import FILE, read_handwritten

DEVELOPMENT = Path(__file__).parents[3] / "benchmarks" / "instructions"


@pytest.fixture(scope="module")
def reader() -> InstructionReader:
    return InstructionReader.load(read_nouns().nouns)


def facts(reading: InstructionReading, goal: bool = False) -> set[tuple[str, str, str]]:
    words = [o.words for o in reading.objects]
    return {(words[r.subject], r.kind, words[r.target]) for r in (reading.goal if goal else reading.start)}


@pytest.mark.parametrize(
    ("text", "start", "goal"),
    [
        ("Please take the red mug off the tray.", {("red mug", "on", "tray")}, set()),
        ("Put the apple in the bowl.", set(), {("apple", "in", "bowl")}),
        ("The pen is behind the laptop, could you put it in the cup?", {("laptop", "front", "pen")}, {("pen", "in", "cup")}),
        ("somebody left teh scisors under the magazine", {("magazine", "on", "scissors")}, set()),
        ("I never put my keys on the table.", set(), set()),
    ],
)
def test_start_and_goal_are_told_apart(
    reader: InstructionReader, text: str, start: set[tuple[str, str, str]], goal: set[tuple[str, str, str]]
) -> None:
    found = reader.read(text)
    assert facts(found) == start
    assert facts(found, goal=True) == goal


def test_counts_and_unknown_objects(reader: InstructionReader) -> None:
    found = reader.read("Three pencils are in the cup, and the typewriter is next to it.")
    assert [o.categories for o in found.objects].count(("pencil",)) == 3
    assert [o.words for o in found.unknown] == ["typewriter"]


def test_an_edit_says_what_changes(reader: InstructionReader) -> None:
    found = {o.words: o.change for o in reader.read("Get rid of the mug and add a vase behind the lamp.", is_edit=True).objects}
    assert found == {"mug": "remove", "vase": "add", "lamp": ""}


def test_as_many_instructions_are_read_as_when_the_weights_were_made(reader: InstructionReader) -> None:
    for path, right in ((FILE, 29), *((DEVELOPMENT / f"development_{name}.jsonl", 28) for name in "abc")):
        cases = read_handwritten(path)
        assert figures_of([compare(case, reader.read(case.instruction)) for case in cases])["right"] >= right, path.stem
