"""Words that pick one of several objects."""

import pytest

from models.semantic_reasoner.edit_planning.superlatives import picked, words_around
from stable_data.scene import SceneObject
from tests.models.semantic_reasoner.language.known_categories import thing

ROW: list[SceneObject] = [thing(f"mug_{k}", 20 + 20 * k, 30).to_scene_object() for k in range(4)]


@pytest.mark.parametrize(
    ("text", "mention", "word"),
    [
        ("bin the left box", "box", "left"),
        ("left knife can go", "knife", "left"),
        ("the right-hand cup", "cup", "right"),
        ("take the second mug from the left", "mug", "1 left"),
        ("take the second mug from the left", "second mug", "1 left"),
        ("the last mug on the right is mine", "mug", "right"),
        ("the tablet nearer to me would be safer", "tablet", "front"),
        ("the jar that is farthest to the left", "jar", "left"),
        ("the clicker that is in the middle", "clicker", "middle"),
        ("the middle one of the three pink varnishes leaks", "varnishes", "middle"),
        ("the tallest of the vases", "vases", "tallest"),
        ("of the two teal jars, the taller one is empty", "jars", "taller"),
    ],
)
def test_words_around_a_mention_pick_it_out(text: str, mention: str, word: str) -> None:
    start = text.index(mention)
    assert word in set(words_around(text, start, start + len(mention)))


@pytest.mark.parametrize(
    ("text", "mention"), [("bring the jar nearer to me", "jar"), ("put it left of the jar", "jar"), ("left of box", "box")]
)
def test_places_and_goals_pick_nothing_out(text: str, mention: str) -> None:
    start = text.index(mention)
    assert not set(words_around(text, start, start + len(mention))) - {"the"}


@pytest.mark.parametrize(
    ("word", "place"), [("left", 0), ("right", 3), ("0 left", 0), ("1 left", 1), ("1 right", 2), ("3 right", 0)]
)
def test_a_word_picks_the_object_at_its_place(word: str, place: int) -> None:
    assert picked(ROW, word, 1) == [ROW[place]]


def test_a_number_beyond_the_row_picks_none_out() -> None:
    assert picked(ROW[:2], "4 left", 1) == ROW[:2]
    assert picked(ROW, "red", 1) == ROW
