"""The goals of instructions in free words, as conditions."""

import pytest

from models.instruction_reader.goals import conditions_of_reading
from models.instruction_reader.nouns import read_nouns
from models.instruction_reader.reader import InstructionReader
from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation


@pytest.fixture(scope="module")
def reader() -> InstructionReader:
    return InstructionReader.load(read_nouns().nouns)


def said(reader: InstructionReader, text: str) -> set[str]:
    reading = reader.read(text)
    names = {k: o.words.split()[-1] for k, o in enumerate(reading.objects)}
    return {str(c) for c in conditions_of_reading(reading, text, names)}


@pytest.mark.parametrize(
    ("text", "conditions"),
    [
        ("Put the apple in the bowl.", {"apple in bowl"}),
        ("Put the cup to the right of the plate.", {"cup right of plate"}),
        ("To the left of the bowl, put the spoon.", {"spoon left of bowl"}),
        ("Put the spoon between the cup and the plate.", {"spoon between cup, plate"}),
        ("Pick up the mug.", {"mug held"}),
        ("Take the mug out of the box.", {"mug not in box"}),
        ("Take the apple off the plate.", {"apple not on plate"}),
        ("Put the pen in the front left corner.", {"pen at front_left"}),
        ("Move the vase to the front edge.", {"vase at front_edge"}),
        ("Move the mug to the back of the table.", {"mug at back"}),
        ("Push the book 10 cm to the left.", {"book moved left 10 cm"}),
        ("Empty the bowl.", {"bowl empty"}),
        ("Swap the salt and the pepper.", {"salt at pepper", "pepper at salt"}),
        ("Hand me the cup.", {"cup held front_edge"}),
        ("I need the whisk. Get it out of the crock and hand it over.", {"whisk held front_edge"}),
        ("Bring the coaster to me.", {"coaster held front_edge"}),
        ("Hold the jar up to the camera.", {"jar held"}),
        ("Let me have a closer look at the vase.", {"vase held"}),
        ("There is a lamp on the left; put the alarm clock in front of it.", {"clock in front of lamp"}),
    ],
)
def test_a_goal_is_stated(reader: InstructionReader, text: str, conditions: set[str]) -> None:
    assert said(reader, text) == conditions


@pytest.mark.parametrize(
    "text",
    [
        "Put the mug in the box and hand me the cup.",
        "Hand me the cup and the plate.",
        "Let me have a closer look at the teapot, but first let me have the sugar bowl.",
        "Hand the spoon to me, then push the bowl to the left.",
        "Pour some juice into the glass and hand it to me.",
        "Give me a hand with the vase.",
        "Show me where the vase goes.",
        "Pour some juice into the glass.",
        "Turn the radio to face the bed.",
        "Press the button of the remote control.",
    ],
)
def test_an_instruction_that_also_asks_for_what_no_state_shows_has_no_goal(reader: InstructionReader, text: str) -> None:
    assert said(reader, text) == set()


def test_an_object_that_is_not_found_leaves_the_goal_unknown() -> None:
    objects = (MentionedObject("mug", ("mug",)), MentionedObject("tray", ("tray",)), MentionedObject("pen", ("pen",)))
    reading = InstructionReading(objects, goal=(MentionedRelation(0, "on", 1), MentionedRelation(2, "on", 1)))
    text = "Put the mug and the pen on the tray."
    assert len(conditions_of_reading(reading, text, {0: "mug_0", 1: "tray_0", 2: "pen_0"})) == 2
    assert conditions_of_reading(reading, text, {0: "mug_0", 1: "tray_0"}) == ()


def test_an_unsure_relation_leaves_the_goal_unknown() -> None:
    objects = (MentionedObject("mug", ("mug",)), MentionedObject("tray", ("tray",)))
    reading = InstructionReading(objects, goal=(MentionedRelation(0, "on", 1, 0.6),))
    assert conditions_of_reading(reading, "Put the mug on the tray.", {0: "mug_0", 1: "tray_0"}) == ()
