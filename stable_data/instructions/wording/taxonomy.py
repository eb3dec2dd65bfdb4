"""Which things are kinds of which: a taxonomy of the things on tables.

``taxonomy.csv`` has one row for each thing: its name, the name of what it is a kind of (``parent``), its synonyms, and the source of
the row: WordNet 3.0 (``taxonomy_licence.txt``), this project's vocabulary
(:mod:`stable_data.instructions.wording.vocabulary`), or this project. A row has several sources if its parent and its synonyms do
not have the same.
"""

import csv
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path

from stable_data.instructions.wording.words import category_words

TAXONOMY_FILE = Path(__file__).with_name("taxonomy.csv")
"""The table."""

Words = tuple[str, ...]


@cache
def _things() -> tuple[Mapping[Words, Words], Mapping[Words, Words]]:
    """Returns the name that each name or synonym stands for, and the parent of each name, all as singular words."""
    names: dict[Words, Words] = {}
    parents: dict[Words, Words] = {}
    with TAXONOMY_FILE.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            own = category_words(row["name"])
            names |= {category_words(name): own for name in (row["name"], *filter(None, row["synonyms"].split("; ")))}
            if row["parent"]:
                parents[own] = category_words(row["parent"])
    return names, parents


@lru_cache(maxsize=65536)
def is_listed(category: str) -> bool:
    """Whether the taxonomy has a category, by its name or a synonym."""
    return category_words(category) in _things()[0]


@lru_cache(maxsize=16384)
def is_kind_of(category: str, wanted: str) -> bool:
    """Whether a category is a wanted one by its name or a synonym, or is a kind of it.

    A category of more words than the taxonomy has is what its last words are: a ``red_coffee_mug`` is a ``mug``.

    Args:
        category: The category.
        wanted: A category that the taxonomy has; no other one has kinds.
    """
    names, parents = _things()
    asked, words = names.get(category_words(wanted)), category_words(category)
    ends = (words[start:] for start in range(len(words)))
    thing = next((names[end] for end in ends if end in names), None)
    while thing is not None and asked is not None and thing != asked:
        thing = parents.get(thing)
    return thing is not None and thing == asked
