"""Words and phrases that fill the frames, beside the nouns."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

WORDS = Path(__file__).with_name("words")
"""The files of words."""

RELATIONS = ("in", "on", "left", "right", "front", "behind", "under", "near")
"""Relations between two objects; ``under`` means that the target is on the subject."""

REGIONS: Mapping[str, str] = MappingProxyType(
    {
        "back left": "back_left", "back": "back_middle", "back right": "back_right",
        "left": "middle_left", "centre": "middle_middle", "right": "middle_right",
        "front left": "front_left", "front": "front_middle", "front right": "front_right",
    }
)  # fmt: skip
"""Regions of the table in frames, and the cells of the scene graph."""

POOLS = frozenset({"any", "small", "container", "carrier", "long", "stackable", "food", "drink", "device", "lid", "unknown"})
"""Pools of nouns that a frame may name."""

COUNT_WORDS: Mapping[int, tuple[str, ...]] = MappingProxyType(
    {
        2: ("two", "two", "two", "2", "a couple of", "a pair of"),
        3: ("three", "three", "three", "3"),
        4: ("four", "four", "4"),
        5: ("five", "5"),
        6: ("six", "6", "half a dozen"),
        7: ("seven", "7"),
        8: ("eight", "8"),
    }
)
"""Words of counts."""


def read_lines(name: str) -> tuple[str, ...]:
    """Returns the lines of a file of words without comments."""
    text = (WORDS / name).read_text("utf-8")
    return tuple(line.rstrip() for line in text.splitlines() if line.strip() and not line.startswith("#"))


def _phrases() -> dict[str, tuple[str, ...]]:
    lines = (line.partition(": ") for line in read_lines("phrases.txt"))
    return {key: tuple(phrase.strip() for phrase in text.split(";")) for key, _, text in lines}


_ALL = _phrases()

ADJECTIVES = _ALL.pop("adjectives")
"""Adjectives before nouns of objects."""

DETERMINERS = _ALL.pop("determiners")
"""Determiners that may stand for ``the`` before a singular noun."""

OPENINGS = _ALL.pop("openings")
"""Openings that state nothing of the table."""

CLOSINGS = _ALL.pop("closings")
"""Endings that state nothing of the table."""

MODIFIERS = _ALL.pop("modifiers")
"""Additions after a noun that state its relation to another object."""

DETAILS = _ALL.pop("details")
"""Words after a noun that describe its object, and mention no other one."""

PHRASES: Mapping[str, tuple[str, ...]] = MappingProxyType(_ALL)
"""Phrases by the name of their slot; those of relations are also the phrases of ``<r>``."""
