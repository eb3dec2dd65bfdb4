"""Which nouns fit a wanted one."""

import pytest

from stable_data.assets.noun_fit import NounFit, is_named_in, noun_fit


@pytest.mark.parametrize(
    ("category", "wanted", "fit"),
    [
        ("apple", "apple", NounFit.EQUAL),
        ("wooden_blocks", "Wooden Block", NounFit.EQUAL),
        ("soup_can", "can", NounFit.KIND),
        ("knife", "table_knife", NounFit.KIND),
        ("knife", "kitchen_knife", NounFit.POSSIBLE),
        ("toothbrush_cup", "cup", NounFit.POSSIBLE),
        ("", "cup", NounFit.POSSIBLE),
        ("cup", "", NounFit.POSSIBLE),
        ("cookbook", "book", NounFit.KIND),
        ("book", "cookbook", NounFit.OTHER),
        ("pot_lid", "pot", NounFit.OTHER),
        ("tomato", "plum", NounFit.OTHER),
        ("strawberry", "apple", NounFit.OTHER),
        ("pineapple", "apple", NounFit.OTHER),
    ],
)
def test_a_noun_fits(category: str, wanted: str, fit: NounFit) -> None:
    assert noun_fit(category, wanted) is fit


def test_a_text_names_a_category_by_whole_words() -> None:
    assert is_named_in("A red coffee mug with a chip", "mug")
    assert is_named_in("two cups", "teacup")
    assert not is_named_in("a smug cat", "mug")
    assert not is_named_in("", "mug")
