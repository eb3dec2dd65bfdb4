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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "Leave the big pumpkin, take the small one and set it on the cake stand.",
            ["big pumpkin", "small pumpkin", "cake stand"],
        ),
        ("The knife on the board is dirty, replace it with the clean one.", ["knife", "board", "clean knife"]),
        ("Put the red mug in the crate and the other one behind the kettle.", ["red mug", "crate", "mug", "kettle"]),
        ("Two mugs are on the tray. Put the blue one in the box.", ["blue mugs", "mugs", "tray", "box"]),
        ("Take the jar for the cotton pads to the mirror.", ["jar for the cotton pads", "mirror"]),
        ("Put the pear on the kitchen scales.", ["pear", "kitchen scales"]),
    ],
)
def test_another_one_is_an_object_of_its_own(reader: InstructionReader, text: str, words: list[str]) -> None:
    assert sorted(o.words for o in reader.read(text).objects) == sorted(words)


def test_the_topmost_of_several_is_that_of_a_stack(reader: InstructionReader) -> None:
    read = reader.read("Take the topmost of the three bowls and place it in front of the kettle.")
    assert {(r.subject, r.kind, r.target) for r in read.start} == {(0, "on", 1), (1, "on", 2)}
    assert {(r.subject, r.kind, r.target) for r in read.goal} == {(0, "front", 3)}


def test_an_edit_says_what_changes(reader: InstructionReader) -> None:
    found = {o.words: o.change for o in reader.read("Get rid of the mug and add a vase behind the lamp.", is_edit=True).objects}
    assert found == {"mug": "remove", "vase": "add", "lamp": ""}


@pytest.mark.parametrize(
    ("path", "right"),
    [(FILE, 29), *(pytest.param(DEVELOPMENT / f"development_{name}.jsonl", 28, marks=pytest.mark.slow) for name in "abc")],
)
def test_as_many_instructions_are_read_as_when_the_weights_were_made(reader: InstructionReader, path: Path, right: int) -> None:
    cases = read_handwritten(path)
    assert figures_of([compare(case, reader.read(case.instruction)) for case in cases])["right"] >= right
