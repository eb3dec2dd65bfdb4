"""What an instruction says of the scene it starts from."""

import pytest

from stable_data.instructions.claims import StatedRelation, emptied_numbers, number_mentions, read_claims
from stable_data.scene import RelationKind

IN, ON, FRONT = RelationKind.IN, RelationKind.ON, RelationKind.IN_FRONT_OF
TYPES = ("Apple", "FruitBowl", "Bowl")


def test_the_longest_types_are_marked_first() -> None:
    assert (
        number_mentions("Put the apple and all apples from the fruit bowl into a bowl.", TYPES)
        == "put <0> and <0> from <1> into <2>."
    )


@pytest.mark.parametrize(
    ("marked", "claims"),
    [
        ("take <0> out of <1>.", [StatedRelation(0, IN, 1)]),
        ("remove <0> from <1>.", [StatedRelation(0, None, 1)]),
        ("reach into <1> and take out <0>.", [StatedRelation(0, IN, 1)]),
        (
            "lift <0> that is to the right of <2> off <1>.",
            [StatedRelation(0, ON, 1), StatedRelation(0, RelationKind.RIGHT_OF, 2)],
        ),
        ("take <0>, which is in front of <2>, out of <1>.", [StatedRelation(0, IN, 1), StatedRelation(0, FRONT, 2)]),
        ("clear <1> by lifting <0> and <2> off it.", [StatedRelation(0, ON, 1), StatedRelation(2, ON, 1)]),
        ("<0> does not belong in <1>. take it out.", [StatedRelation(0, IN, 1)]),
        ("i need <0>. take it out of <1> and hand it over.", [StatedRelation(0, IN, 1)]),
        ("clear the space in front of <1> by moving <0> to the left.", [StatedRelation(0, FRONT, 1)]),
        ("<0> is in the way in front of <1>.", [StatedRelation(0, FRONT, 1)]),
        ("<0> in <1> is also in <2>. put it on <3>.", [StatedRelation(0, IN, 1), StatedRelation(0, IN, 2)]),
        (
            "<0> is on <1> and in front of <2>, and in <3>.",
            [StatedRelation(0, ON, 1), StatedRelation(0, FRONT, 2), StatedRelation(0, IN, 3)],
        ),
        ("<0> is on <1> and <2> is in <3>.", [StatedRelation(0, ON, 1), StatedRelation(2, IN, 3)]),
        ("put <0> on <1> and in front of <2>.", []),
        ("<3> with <0> on <1> is also in <2>.", [StatedRelation(0, ON, 1), StatedRelation(0, IN, 2)]),
        ("move <0> away from <1>.", []),
        ("fill <0> from <1>.", []),
        ("get me a drop of <0> from <1>.", []),
        ("take some of <0> from <1>.", [StatedRelation(0, None, 1)]),
        ("<0> should hold <1> instead of <2>. take <3> out first.", [StatedRelation(2, IN, 0)]),
        (
            "<0> should hold <1> instead of <2> and <4>. take <3> out first.",
            [StatedRelation(2, IN, 0), StatedRelation(4, IN, 0)],
        ),
        ("separate <0> from <1>: the former go left.", []),
        ("<0> belongs in <1> and <2> in <1>.", []),
        ("put <0> on <1>.", []),
        ("lift <2>, then hand me <1> after taking <0> off it.", [StatedRelation(0, ON, 1)]),
        ("arrange things so that the right-hand <0> is in front of <1>.", []),
        ("make sure that the small red <0> is on <1>.", []),
        ("put the right-hand <0>, <1> and <2> inside <3>.", []),
    ],
)
def test_claims_are_what_the_words_presuppose(marked: str, claims: list[StatedRelation]) -> None:
    assert list(read_claims(marked)) == claims


@pytest.mark.parametrize(
    "text",
    [
        "empty <3>.",
        "take everything out of <3>.",
        "clear <3>, please.",
        "i need <3> empty.",
        "i need <3>. take what lies on top off first.",
        "i need <3> that is to the right of <1>. take what lies on top off first.",
        "i need <3> that is in the front left corner. take everything off first.",
        "i need <3> that is to the left of <1> and behind <2>. take what lies on top off first.",
    ],
)
def test_what_is_to_be_emptied_is_found(text: str) -> None:
    assert emptied_numbers(text) == (3,)
