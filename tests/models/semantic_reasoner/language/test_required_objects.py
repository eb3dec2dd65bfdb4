from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.required_objects import ObjectRequirement, required_objects
from stable_data.instructions.wording.words import plural
from tests.models.semantic_reasoner.language.known_categories import SIZES_CM, STATISTICS

NOUNS = ("mug", "plate", "laptop", "pen", "apple", "cookie", "napkin", "pitcher")


def asked(instruction: str, statistics: CategoryStatistics = STATISTICS) -> dict[str, int]:
    return {r.words.lower(): r.at_least for r in required_objects(instruction, statistics)}


@pytest.mark.parametrize(
    ("instruction", "expected"),
    [
        ("Move the mug next to the plate.", {"mug": 1, "plate": 1}),
        ("Put both mugs on the tray.", {"mugs": 2, "tray": 1}),
        ("Stack all three plates.", {"plates": 3}),
        ("Take two of the cookies.", {"cookies": 2}),
        ("Put the 4 pens into the pen holder.", {"pens": 4, "pen holder": 1}),
        ("The cookies go on a plate.", {"cookies": 2, "plate": 1}),
        ("Give me the scissors.", {"scissors": 1}),
        ("Put the red mug on the plate and the blue mug on the tray.", {"mug": 2, "plate": 1, "tray": 1}),
        ("Pick up the mug. Put the mug on the plate, it is dirty.", {"mug": 1, "plate": 1}),
        ("Put the red mug on the plate. Then turn the mug around.", {"mug": 1, "plate": 1}),
        ("Take the mug that is on the left and the mug that is on the right.", {"mug": 2}),
        ("Take the right-hand mug, then move the left-hand mug.", {"mug": 2}),
        ("Take a mug and put another mug beside it.", {"mug": 2}),
        ("Put the orange pitcher away.", {"pitcher": 1}),
        ("Put the butter knife beside the plate.", {"butter knife": 1, "plate": 1}),
        ("Set the plates.", {"plates": 2}),
        ("Can you hand me the can?", {"can": 1}),
        ("The pitcher should stand so that it can be seen.", {"pitcher": 1}),
        ("Put the pitcher on the stand.", {"pitcher": 1}),
        ("Find the can opener.", {}),
        ("There are no plates here, only a mug.", {"mug": 1}),
        ("Drink without a cup.", {}),
        ("Make room for a laptop behind the mug.", {"mug": 1}),
        ("Make room for the laptop.", {"laptop": 1}),
        ("Put all the fruit on the plate.", {"fruit": 1, "plate": 1}),
        ("Set 250 plates.", {}),
        ("Set 0 plates and ² mugs.", {"mugs": 2}),
        ("PUT THE MUG ON A PLATE!", {"mug": 1, "plate": 1}),
        ("I want everything in order. Move the mug.", {"mug": 1}),
        ("", {}),
        ("Lege die Tasse auf den Teller.", {}),
    ],
)
def test_what_is_asked_for(instruction: str, expected: dict[str, int]) -> None:
    assert asked(instruction) == expected


@pytest.mark.parametrize(
    ("instruction", "words", "categories"),
    [
        ("Take the tin.", "tin", {"can"}),
        ("Take the jar of spice.", "jar of spice", {"spice_jar"}),
        ("Take the cup.", "cup", {"mug", "cup", "teacup"}),
        ("Take the glass.", "glass", {"drinking_glass"}),
        ("Take the knives.", "knives", {"table_knife"}),
        ("Take the butter knives.", "butter knives", {"butter_knife"}),
        ("Take the spicejar.", "spicejar", {"spice_jar"}),
        ("Sort the fruit.", "fruit", {"apple", "orange"}),
    ],
)
def test_other_names_mean_the_categories_that_answer_to_them(instruction: str, words: str, categories: set[str]) -> None:
    (found,) = required_objects(instruction, STATISTICS)
    assert found.words == words
    assert set(found.categories) == categories


@pytest.mark.parametrize(
    "text",
    ["Take everything off the tray.", "Empty the black tray.", "Clear the tray.", "Move everything that is on the tray."],
)
def test_what_is_emptied_holds_something(text: str) -> None:
    tray, content = required_objects(text, STATISTICS)
    assert tray.categories == ("serving_tray",)
    assert not content.is_met_by(["serving_tray"])
    assert content.is_met_by(["serving_tray", "mug"])


def test_one_thing_that_is_many_is_enough() -> None:
    (found,) = required_objects("Put the wooden blocks away.", CategoryStatistics.of_names(["wooden_block", "wooden_blocks"]))
    assert found.at_least == 2
    assert not found.is_met_by(["wooden_block"])
    assert found.is_met_by(["wooden_blocks"])


def test_a_doubtful_word_asks_for_nothing() -> None:
    doubting = replace(STATISTICS, doubts={"camera": {"*": False, "to": True}})
    assert asked("Lift the mug up to the camera.", doubting) == {"mug": 1}
    assert asked("Take the camera.", doubting) == {"camera": 1}


@settings(deadline=None)
@given(st.lists(st.sampled_from(NOUNS), min_size=1, unique=True), st.data())
def test_exactly_the_named_things_are_asked_for(nouns: list[str], data: st.DataObject) -> None:
    counts = [data.draw(st.integers(1, 5)) for _ in nouns]
    said = [f"the {n}" if k == 1 else f"{k} {plural(n)}" for n, k in zip(nouns, counts, strict=True)]
    found = required_objects(f"Please put {' and '.join(said)} in a row.", STATISTICS)
    there = [n for n, k in zip(nouns, counts, strict=True) for _ in range(k)]
    assert all(r.is_met_by(there) for r in found)
    assert [r.at_least for r in found] == counts
    for noun in nouns:
        fewer = there.copy()
        fewer.remove(noun)
        assert [r for r in found if not r.is_met_by(fewer)] == [r for r in found if r.categories == (noun,)]


@settings(deadline=None)
@given(st.text(max_size=300))
def test_any_text_can_be_read(text: str) -> None:
    found = required_objects(text, STATISTICS)
    assert found == required_objects(text, STATISTICS)
    assert all(set(r.categories) <= set(SIZES_CM) and r.at_least >= 1 for r in found)


def test_a_very_long_text_can_be_read() -> None:
    assert asked("Put the mug on the plate. " * 1700) == {"mug": 1, "plate": 1}


def test_statistics_of_names_alone_suffice() -> None:
    found = required_objects("Take the nesting cup.", CategoryStatistics.of_names(["nesting_cups", "Burger Patty"]))
    assert found == (ObjectRequirement("nesting cup", ("nesting_cups",)),)
