"""Words of turns on the spot."""

import math

import pytest

from models.semantic_reasoner.edit_planning.turns import yaw_after_turn
from stable_data.scene_graph.relations import facing_of


@pytest.mark.parametrize(
    ("words", "yaw"),
    [
        ("a quarter turn", 120),
        ("a quarter turn clockwise", -60),
        ("by 45 degrees", 75),
        ("through 180°", -150),
        ("around", -150),
        ("half a turn", -150),
        ("the other way round", -150),
        ("a bit clockwise", 10),
        ("sideways", 120),
        ("turned", 120),
        ("thirty degrees ccw", 60),
        ("back the other way", -150),
        ("through a right angle", 120),
        ("to face the wall", 180),
        ("so that it faces left", -90),
        ("darker", None),
        ("into something with a round foot and a lid", None),
        ("light blue", None),
    ],
)
def test_a_turn_in_words(words: str, yaw: int | None) -> None:
    assert yaw_after_turn(words.split(), 30) == yaw


@pytest.mark.parametrize(("word", "facing"), [("left", "left"), ("right", "right"), ("me", "front"), ("wall", "back")])
def test_facings_are_those_of_the_scene_graph(word: str, facing: str) -> None:
    yaw = yaw_after_turn(["towards", word], 30)
    assert yaw is not None
    assert facing_of(math.radians(yaw)) == facing
