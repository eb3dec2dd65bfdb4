"""Categories and descriptions from names."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from stable_data.assets.text_embeddings import Rows
from stable_data.importers.conversion import ConversionContext
from stable_data.importers.conversion.naming import related_categories, words_of_name
from stable_data.importers.source import SourceAsset

VOCABULARY = ConversionContext().vocabulary


def named(name: str, **given: Any) -> tuple[str, str | None]:
    found = VOCABULARY.name(SourceAsset("a", name, (), **given))
    return found.category, found.category_source


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("ycb_025_mug", "mug"),
        ("ycb_065-a_cups", "cup"),
        ("ycb_077_rubiks_cube", "puzzle_cube"),
        ("ycb_003_cracker_box", "cracker_box"),
        ("food_ingredient_burger_cooked", "burger"),
        ("food_ingredient_vegetableburger_cooked", "burger"),
        ("food_ingredient_potato_mashed", "potato"),
        ("jar_A_small", "jar"),
        ("pan_006", "pan"),
        ("pot_A_stew", "pot"),
        ("crate_buns", "crate"),
        ("crate_cheese", "crate"),
        ("crate_tomatoes", "crate"),
        ("crate_lid", "lid"),
        ("bowl_with_fruits", "bowl"),
        ("can_of_soup", "can"),
        ("cuttingboard", "cutting_board"),
        ("papertowel", "paper_towel"),
        ("kitchentable_A", "table"),
        ("aws_robomaker_residential_ReadingDesk_01", "desk"),
        ("Threshold_Porcelain_Teapot_White", "teapot"),
        ("Cole_Hardware_Mug_Classic_Blue", "mug"),
        ("wine-glass", "wine_glass"),
        ("WineGlass2.obj", "wine_glass"),
    ],
)
def test_a_name_means_a_known_category(name: str, category: str) -> None:
    assert named(name) == (category, "name")


def test_a_name_without_words_means_nothing() -> None:
    found = VOCABULARY.name(SourceAsset("a", "obj_000012", ()))
    assert (found.category, found.category_source, found.description, found.description_source) == ("object", None, "", None)
    for name in ("茶杯", "3cc47c3f78d34985bf4314de2f8196dd", "20f7cb0a-518a-b9d6-2f6a-1b244e6fd26b"):
        assert named(name) == ("object", None)


def test_words_that_are_not_known_are_kept_and_none_is_added() -> None:
    found = VOCABULARY.name(SourceAsset("a", "Blue_Zorble_3", ()))
    assert (found.category, found.description) == ("zorble", "blue zorble")


def test_what_the_source_states_counts_first() -> None:
    assert named("mug", category="Coffee Mug") == ("coffee_mug", "given")
    found = VOCABULARY.name(SourceAsset("a", "mug", (), description=" A red mug. "))
    assert (found.description, found.description_source) == ("A red mug.", "given")
    assert named("x_17", tags=("ceramic", "teapot")) == ("teapot", "given")


def test_a_description_of_the_file_is_not_one_of_the_thing() -> None:
    about_file = "This model has been converted from another set. Distributed under a free licence."
    found = VOCABULARY.name(SourceAsset("a", "ycb_025_mug", (), description=about_file))
    assert (found.description, found.description_source) == ("mug", "name")
    found = VOCABULARY.name(SourceAsset("a", "ycb_025_mug", (), description="striped", category="mug"))
    assert (found.description, found.description_source) == ("striped", "given")


def test_accents_are_letters_and_words_of_the_set_are_left_out() -> None:
    assert words_of_name("Tasse_\u00e9t\u00e9")[0] == ("tasse", "ete")
    assert words_of_name("KayKit_mug_b", "KayKit Restaurant")[0] == ("mug",)


def test_related_categories_go_from_near_to_far() -> None:
    assert list(related_categories("coffee_mug"))[:2] == ["coffee_mug", "mug"]
    assert "bottle" in related_categories("ketchup")


class Letters:
    """An encoder for tests: two texts are alike if they have the same letters."""

    fingerprint = "letters"

    def __call__(self, texts: Sequence[str], /) -> Rows:
        rows = np.array([[text.count(chr(97 + k)) for k in range(26)] for text in texts], np.float32) + 1e-3
        return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def test_the_encoder_names_what_words_do_not() -> None:
    found = ConversionContext(Letters()).vocabulary.name(SourceAsset("a", "pot_tea", ()))
    assert found.category_source in ("name", "encoder")
    found = ConversionContext(Letters()).vocabulary.name(SourceAsset("a", "pottea", ()))
    assert (found.category, found.category_source) == ("teapot", "encoder")
    assert found.likeness == pytest.approx(1, abs=1e-3)
