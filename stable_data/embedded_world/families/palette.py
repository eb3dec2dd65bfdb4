"""Colours that several families share, in addition to the named ones."""

from collections.abc import Mapping
from types import MappingProxyType

PAPER = "#f4f3ef"
LEAF = "#5f8f3e"
DARK_GLASS = "#16191d"
"""A screen that is off, a lens."""

WINDOW = "#b9d7e6"

NEON: Mapping[str, str] = MappingProxyType(
    {"yellow": "#f0e04a", "pink": "#f06ba6", "green": "#7fdc5c", "orange": "#fb9a3e", "blue": "#56b6ee", "purple": "#b98be6"}
)
"""Fluorescent colours by name."""
