"""What instructions require, their words for the engine, and what is said of what is not understood."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.semantic_reasoner.language.interpreter import (
    InstructionInterpreter,
    InterpretedInstruction,
    compare_with_instruction,
    relations_of_task,
)
from stable_data.scene import Relation, RelationKind, SceneObject
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, TABLE, interpreter, thing


def encode(texts: Sequence[str]) -> npt.NDArray[np.float32]:
    """Unit rows: an axis for each text, and one for a gramophone and a pitcher, which are alike here."""
    alike = ["a gramophone" if text == "a pitcher" else text for text in texts]
    return np.array([[float(text == "a gramophone"), float(text != "a gramophone")] for text in alike], np.float32)


def read(instruction: str) -> InterpretedInstruction:
    return interpreter()(instruction)


def codes(found: InterpretedInstruction) -> list[str]:
    return [n.code for n in found.notices]


def boxes(*objects: tuple[str, float, float, float]) -> list[SceneObject]:
    return [thing(name, x, y, bottom).to_scene_object() for name, x, y, bottom in objects]


def test_objects_and_relations_are_required() -> None:
    found = read("Take the mug off the plate.")
    assert found.reference is not None
    assert [r.categories[0] for r in found.reference.required] == ["mug", "plate"]
    (relation,) = found.reference.entailed
    assert relation.kind is RelationKind.ON
    assert not found.notices


def test_a_layout_is_compared_with_an_instruction() -> None:
    wanted = read("Take the mug off the plate.")
    aside, on_it = boxes(("plate_0", 70, 30, 0), ("mug_0", 20, 20, 0)), boxes(("plate_0", 70, 30, 0), ("mug_0", 70, 30, 2))
    alignment, broken = compare_with_instruction(aside, TABLE, wanted)
    assert broken == (Relation("mug_0", RelationKind.ON, "plate_0"),)
    assert alignment is not None
    assert relations_of_task(alignment) == broken
    assert compare_with_instruction(on_it, TABLE, wanted)[1] == ()
    alone, none_broken = compare_with_instruction(aside[:1], TABLE, wanted)
    assert alone is not None
    assert ([str(r) for r in alone.missing], none_broken) == (["mug"], ())


@pytest.mark.parametrize(
    ("instruction", "unknown"),
    [("Put an elephant on the plate.", "elephant"), ("Bring the helicopter to me.", "helicopter")],
)
def test_what_is_unknown_is_said_and_not_required(instruction: str, unknown: str) -> None:
    found = read(instruction)
    assert codes(found) == ["word_unknown"]
    assert repr(unknown) in found.notices[0].message
    assert "\n" not in found.notices[0].message
    assert unknown in found.wording


def test_an_unknown_noun_is_read_as_a_similar_one() -> None:
    found = InstructionInterpreter(STATISTICS, encode)("Put the gramophone on the plate.")
    assert codes(found) == ["word_read_as"]
    assert found.wording == "Put the pitcher on the plate."
    assert found.reference is not None
    assert ("pitcher",) in [r.categories for r in found.reference.required]


def test_the_engine_reads_its_own_words() -> None:
    assert read("Put the chopping board next to the mug.").wording == "Put the cutting board next to the mug."
    known = "Move the mug next to the plate."
    assert read(known).wording == known


@pytest.mark.parametrize(
    "instruction", ["Stell die Tasse bitte auf den Teller.", "把杯子放在盘子上", "Поставь кружку на тарелку", "asdf qwer zxcv"]
)
def test_another_language_is_said_once(instruction: str) -> None:
    found = read(instruction)
    assert codes(found) == ["language_unknown"]
    assert found.wording == instruction
    assert found.reference is None


@pytest.mark.parametrize("instruction", ["🍎➡️🥣", "12345", "Wipe the table."])
def test_an_instruction_without_objects_is_said(instruction: str) -> None:
    (notice,) = read(instruction).notices
    assert notice.code == "no_object"
    assert "mentions no object; name what shall be on the table" in notice.message


@pytest.mark.parametrize(
    "instruction",
    [
        "The mug stands on the plate and the plate stands on the mug.",
        "The mug is right of the plate and left of the plate. Take it.",
        "The mug is to the left of the plate, and also to the right of the plate.",
    ],
)
def test_a_contradiction_is_named_and_not_required(instruction: str) -> None:
    found = read(instruction)
    assert found.reference is not None
    assert found.stated is not None
    assert len(found.reference.entailed) == 1
    assert len(found.stated.entailed) == 2
    assert codes(found) == ["contradiction"]


def test_two_places_that_go_together_are_no_contradiction() -> None:
    for instruction in (
        "The mug is left of the plate and also in front of the plate.",
        "The fork is left of the plate and the knife is right of the plate.",
        "Put the mug left of the plate and the fork right of the plate.",
    ):
        assert "contradiction" not in codes(read(instruction)), instruction


@pytest.mark.parametrize("instruction", ["", "?!", "123 456", "🤖🍌", "for (;;) { x++; }", "mug " * 10_000])
def test_any_text_is_read(instruction: str) -> None:
    found = read(instruction)
    assert all("\n" not in n.message for n in found.notices)


@settings(max_examples=30, deadline=None)
@given(st.text(max_size=200))
def test_any_unicode_is_read(instruction: str) -> None:
    found = read(instruction)
    assert found.instruction == instruction
    for o in found.reading.objects:
        assert all(0 <= start < end <= len(instruction) for start, end in o.mentions)


def test_an_unknown_kind_of_table_is_any_table() -> None:
    known = InstructionInterpreter(STATISTICS)
    assert known.table_type("office_table") == ("office_table", ())  # no kind of table is known here


def test_an_object_is_of_the_category_that_has_just_its_name() -> None:
    interpret = interpreter()

    def categories(instruction: str) -> tuple[str, ...]:
        reference = interpret(instruction).reference
        assert reference is not None
        return reference.required[0].categories

    assert categories("Lift the drinking glass.") == ("drinking_glass",)
    assert categories("Lift the cans.") == ("can",)
    assert set(categories("Lift the glass.")) == {"drinking_glass", "wine_glass"}
