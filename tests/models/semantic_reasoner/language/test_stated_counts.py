"""The number before a plural is read from its words."""

from collections import Counter

import pytest

from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.semantic_reasoner.language.stated_counts import number_of, with_stated_counts
from tests.models.semantic_reasoner.language.known_categories import interpreter


@pytest.mark.parametrize(
    ("words", "number"),
    [
        ("seven", 7),
        ("forty-two", 42),
        ("1,000", 1000),
        ("a dozen", 12),
        ("half a dozen", 6),
        ("one hundred and twenty", 120),
        ("two thousand five hundred and ten", 2510),
        ("three million", 3_000_000),
    ],
)
def test_numbers_are_read_from_words_and_digits(words: str, number: int) -> None:
    assert number_of(words.removeprefix("a ")) == number


def plural(instruction: str, noun: str, count: int, name: int = 0) -> list[MentionedObject]:
    """What the reader gives for a plural."""
    start = instruction.index(noun)
    return [MentionedObject(noun, ("mug",), mentions=((start, start + len(noun)),), name=name)] * count


@pytest.mark.parametrize(
    ("instruction", "noun", "count"),
    [
        ("Put forty big mugs on the table.", "big mugs", 40),
        ("THIRTY-FIVE MUGS", "MUGS", 35),
        ("Take ten of the 12 mugs away.", "mugs", 12),
        ("Take twelve of my mugs away.", "mugs", 12),
        ("between ten and twenty mugs", "mugs", 20),
        ("There are twelve more mugs.", "mugs", 12),
        ("20 mugs", "20 mugs", 20),
        ("half a dozen mugs", "mugs", 6),
        ("Put the 15 inch mug down.", "15 inch mug", 5),  # one mug
        ("the 500 ml mugs", "500 ml mugs", 5),
        ("a 12-pack of mugs", "12-pack of mugs", 5),
        ("the mugs", "mugs", 5),
        ("1" * 5000 + " mugs", "mugs", 5),  # the number of no layout
    ],
)
def test_a_plural_gets_the_number_before_it(instruction: str, noun: str, count: int) -> None:
    found, number = with_stated_counts(InstructionReading(tuple(plural(instruction, noun, 5))), instruction)
    assert len(found.objects) == count
    assert number == count or number > 10**70


def test_what_is_true_of_all_is_true_of_the_others() -> None:
    text = "twelve mugs on twelve saucers beside a stack of ten plates on the tray"
    objects = [
        *plural(text, "mugs", 2),
        *plural(text, "saucers", 2, 1),
        *plural(text, "plates", 2, 2),
        *plural(text, "tray", 1, 3),
    ]
    stated = [(0, "on", 2), (1, "on", 3), (4, "on", 5), (5, "on", 6), (0, "left", 6)]
    reading = InstructionReading(tuple(objects), tuple(MentionedRelation(*r) for r in stated))
    found, number = with_stated_counts(reading, text)
    names = [o.words for o in found.objects]
    assert number == len(names) == 35
    kinds = Counter((names[r.subject], r.kind, names[r.target]) for r in found.start)
    assert kinds == {
        ("mugs", "on", "saucers"): 12,
        ("plates", "on", "plates"): 9,
        ("plates", "on", "tray"): 10,
        ("mugs", "left", "tray"): 12,
    }
    saucers = [r.target for r in found.start if (names[r.subject], r.kind) == ("mugs", "on")]
    assert len(set(saucers)) == 12


def test_parts_of_a_small_plural_are_not_counted_twice() -> None:
    text = "Of the four mugs, two are in a box. The loose mugs are not."
    objects = [*plural(text, "mugs", 2), *plural(text, "loose mugs", 2, 1)]
    assert len(with_stated_counts(InstructionReading(tuple(objects)), text)[0].objects) == 4


def test_more_objects_than_a_layout_can_have_are_counted_but_not_listed() -> None:
    text = "a million mugs"
    found, number = with_stated_counts(InstructionReading(tuple(plural(text, "mugs", 2))), text)
    assert (len(found.objects), number) == (2, 1_000_000)


def test_an_instruction_requires_as_many_objects_as_it_states() -> None:
    found = interpreter()("There are twelve cookies on the plate.")
    assert found.reference is not None
    assert Counter(str(r) for r in found.reference.required) == {"cookie": 12, "plate": 1}
    assert len(found.reference.entailed) == 12
    assert found.num_objects == 13


def test_a_task_has_no_new_objects() -> None:
    """The network takes "12 mugs" for new ones, as in an edit."""
    found = interpreter()("Put 12 mugs on the serving tray.")
    assert found.reference is not None
    assert Counter(str(r) for r in found.reference.required) == {"mug": 12, "serving tray": 1}
