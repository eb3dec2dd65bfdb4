"""Which nouns fit a wanted one."""

import pytest

from stable_data.assets.noun_fit import NounFit, noun_fit


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
        ("pot_lid", "pot", NounFit.OTHER),
        ("tomato", "plum", NounFit.OTHER),
        ("strawberry", "apple", NounFit.OTHER),
        ("pineapple", "apple", NounFit.OTHER),
    ],
)
def test_a_noun_fits(category: str, wanted: str, fit: NounFit) -> None:
    assert noun_fit(category, wanted) is fit
