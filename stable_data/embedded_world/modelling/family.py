"""What a family of assets is: a category and how its variants are drawn.

A family's ``design`` makes one variant from a :class:`VariantSampler`: a closed solid that stands on z = 0 and faces -y,
metres, with what the rest of the world needs to know of it.
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias, TypeVar

import numpy as np

from stable_data.embedded_world.modelling.solids import Solid
from stable_data.scene import UPRIGHT, QuatXyzw

T = TypeVar("T")

_HALF = 0.7071067811865476
LAID: QuatXyzw = (_HALF, 0.0, 0.0, _HALF)
"""What stands on its end laid on its side, its top towards -y."""

ON_EDGE: QuatXyzw = (0.0, _HALF, 0.0, _HALF)
"""What lies flat put on its edge, what was its left now on top, its face towards +x."""

STANDING = (UPRIGHT,)
EITHER = (UPRIGHT, LAID)
LYING = (LAID,)

DENSITY: Mapping[str, float] = MappingProxyType(
    {
        "ceramic": 2300.0,
        "glass": 1200.0,  # bottles are hollow or full of something lighter
        "metal": 2700.0,
        "tin": 1000.0,
        "wood": 650.0,
        "plastic": 950.0,
        "rubber": 1100.0,
        "paper": 750.0,
        "cardboard": 250.0,
        "fabric": 200.0,
        "foam": 120.0,
        "plant": 400.0,
        "fruit": 850.0,
        "food": 350.0,
        "wax": 900.0,
        "electronics": 1300.0,
    }
)
"""Effective density of each material, kilograms per cubic metre."""

COLORS: Mapping[str, str] = MappingProxyType(
    {
        "white": "#eeebe4", "cream": "#efe3c8", "grey": "#9aa1a6", "silver": "#b9c0c6", "black": "#34373b", "brown": "#7a5236",
        "oak": "#c79a63", "walnut": "#80573a", "bamboo": "#dcb978", "red": "#b93a3f", "orange": "#e2792d", "yellow": "#eac646",
        "green": "#4f8a58", "olive": "#87904f", "teal": "#3c8c8a", "blue": "#3f72a8", "navy": "#2f4463", "purple": "#7b5a8c",
        "pink": "#df9aa8", "gold": "#c9a24a", "copper": "#b8714a", "clear": "#bfd6da", "amber": "#9c5f24", "kraft": "#bd9467",
        "terracotta": "#b5623f",
    }
)  # fmt: skip
"""Colours by name, ``#rrggbb``."""


@dataclass(frozen=True, slots=True)
class SupportArea:
    """A level place where other things can be: the top of a book, the inside of a bowl. Metres, frame of the solid.

    Attributes:
        width: Along x; the diameter where it is round.
        depth: Along y; likewise.
        z: Height of its floor.
        height: Up to the rim, for what is inside; 0 for a top.
        is_round: Whether it is a circle (or an ellipse) instead of a rectangle.
        x: Its middle.
        y: Its middle.
    """

    width: float
    depth: float
    z: float
    height: float = 0.0
    is_round: bool = False
    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class AssetDesign:
    """One variant of a family.

    Attributes:
        solid: Its shape: one connected solid that stands on z = 0 and faces -y, metres.
        material: A key of ``DENSITY``.
        color: A key of ``COLORS``, or ``#rrggbb``.
        captions: Three or more ways to name it, lower case, without a full stop; the first is the plainest full one.
        top: Where other things can stand on it.
        hollow: Where other things can lie or stand in it; only what has one counts as a container.
        tilts: Its usual resting tilts; the first is the most usual.
        density: Overrides that of the material, kilograms per cubic metre: things that are hollow inside.
    """

    solid: Solid
    material: str
    color: str
    captions: tuple[str, ...]
    top: SupportArea | None = None
    hollow: SupportArea | None = None
    tilts: tuple[QuatXyzw, ...] = STANDING
    density: float | None = None


class VariantSampler:
    """The chance behind one variant: the same for the same category and number.

    Args:
        category: The family's.
        variant: Number of the variant, from 0.
    """

    def __init__(self, category: str, variant: int) -> None:
        self._key, self._variant = zlib.crc32(category.encode()), variant
        self._rng = np.random.default_rng([self._key, variant])
        self._num_picks = 0

    def between(self, low: float, high: float) -> float:
        """A length between two, metres, to the tenth of a millimetre."""
        return round(float(self._rng.uniform(low, high)), 4)

    def pick(self, *options: T) -> T:
        """One of several; as many variants as there are options show them all."""
        self._num_picks += 1
        order = np.random.default_rng([self._key, self._num_picks]).permutation(len(options))
        return options[int(order[self._variant % len(options)])]


Drawing: TypeAlias = Callable[[VariantSampler], AssetDesign]


@dataclass(frozen=True, slots=True)
class AssetFamily:
    """A category of assets.

    Attributes:
        category: Its kind, words joined by ``_``, singular.
        design: Makes a variant.
        tables: Kinds of table that it is usual on.
    """

    category: str
    design: Drawing
    tables: tuple[str, ...]
