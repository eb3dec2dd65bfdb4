"""Words of captions: articles, names of colours and materials, options written as text."""

import re
from collections.abc import Mapping
from types import MappingProxyType

from stable_data.embedded_world.modelling.family import VariantSampler

_NAMES: Mapping[str, str] = MappingProxyType(
    {
        "#c23a2e": "red", "#7fb0a8": "mint green", "#5f7f8c": "grey-blue", "#4a4e54": "dark grey", "#8fb0a2": "sage green",
        "#c39a6b": "light brown", "#a9cfe0": "light blue", "#cfe3c4": "light green", "#d9b878": "amber", "#c9c3d6": "smoky",
        "#b9a88c": "linen", "#d8653f": "terracotta", "#b7d8e2": "clear", "#8fb7d6": "light blue", "navy": "dark blue",
    }
)  # fmt: skip


def fix_articles(*captions: str) -> tuple[str, ...]:
    """Returns captions in which each article ``a`` before a vowel is ``an``."""
    return tuple(re.sub(r"\ba (?=[aeiou])", "an ", caption) for caption in captions)


def color_word(color: str) -> str:
    """The usual word for a colour."""
    return _NAMES.get(color, color)


def material_word(color: str) -> str:
    """The word for a kitchen object of a colour: its material if that is unpainted, otherwise the colour."""
    return {"silver": "stainless steel", "clear": "glass"}.get(color, color)


def pick_words(draw: VariantSampler, *options: str) -> list[str]:
    """Picks one of several options and splits it into words.

    Args:
        draw: The random choices of the variant.
        options: Options separated by commas, in one or several texts; ``_`` stands for a blank within a word.
    """
    return [word.replace("_", " ") for word in draw.pick(*", ".join(options).split(", ")).split()]
