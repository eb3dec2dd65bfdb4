"""What is a kind of what, and that the table behind it is whole."""

import csv
from collections import Counter

import networkx as nx
import pytest

from stable_data.embedded_world.families.catalogue import BY_CATEGORY
from stable_data.instructions.wording.taxonomy import TAXONOMY_FILE, is_kind_of, is_listed
from stable_data.instructions.wording.vocabulary import closeness, nouns_of
from stable_data.instructions.wording.words import singular, type_words

SOURCES = {"WordNet 3.0", "this project's vocabulary", "this project"}
with TAXONOMY_FILE.open(encoding="utf-8", newline="") as file:
    ROWS = list(csv.DictReader(file))


def names(row: dict[str, str]) -> list[str]:
    return [row["name"], *filter(None, row["synonyms"].split("; "))]


def test_each_row_states_its_source_and_each_name_stands_for_one_thing() -> None:
    assert list(ROWS[0]) == ["name", "parent", "synonyms", "source"]
    assert all(row["source"] and set(row["source"].split("; ")) <= SOURCES for row in ROWS)
    counts = Counter(singular(type_words(name)) for row in ROWS for name in names(row))
    assert not [words for words, count in counts.items() if count > 1 or not words]


def test_a_parent_is_a_row_and_nothing_is_a_kind_of_itself_by_a_circle() -> None:
    known = {row["name"] for row in ROWS}
    edges = [(row["name"], row["parent"]) for row in ROWS if row["parent"]]
    assert {parent for _, parent in edges} <= known
    assert nx.is_directed_acyclic_graph(nx.DiGraph(edges))


def test_the_embedded_world_is_listed_and_its_names_still_fit() -> None:
    categories = tuple(BY_CATEGORY)
    assert categories
    assert not [category for category in categories if not is_listed(category)]
    assert not [(c, noun) for c in categories for noun in nouns_of(c) if not closeness(c, noun)]


@pytest.mark.parametrize(
    ("found", "wanted", "how"),
    [
        ("soup_can", "can", 1),  # a kind
        ("tomato_soup_can", "can", 1),  # what its last words are
        ("coffee_mug", "mug", 1),  # a synonym
        ("mug", "coffee_mug", 1),
        ("skillet", "frying_pan", 1),
        ("racquetball", "ball", 1),
        ("apple", "fruit", 1),
        ("potted_cactus", "potted_plant", 1),
        ("brick_car", "toy_car", 1),
        ("fruit", "apple", 0),  # the other way round
        ("bowl", "mixing_bowl", 0),
        ("wine_glass", "drinking_glass", 0),  # a sibling
        ("spice_jar", "teapot", 0),
        ("paper_towel", "towel", 0),  # the last word says something else
        ("crate_buns", "bun", 0),
        ("chopped_carrot", "carrot", 0),
        ("snow_globe", "globe", 0),
        ("watering_can", "can", 0),
        ("toothbrush_cup", "cup", 0),
        ("violin_case", "violin", 0),
        ("red_thingummy", "thingummy", 1),  # no row: the last words alone
    ],
)
def test_a_kind_counts_and_a_wider_noun_or_a_sibling_does_not(found: str, wanted: str, how: int) -> None:
    assert closeness(found, wanted) == how


def test_what_the_table_does_not_have_is_no_kind_of_anything() -> None:
    assert not is_listed("thingummy")
    assert not is_kind_of("thingummy", "thingummy")
    assert not is_kind_of("", "mug")
    assert is_kind_of("mug", "mug")
