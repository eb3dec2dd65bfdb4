"""Families of assets: a family is a category with a function that designs its variants.

The function makes one variant from a :class:`VariantSampler`: a closed solid that stands on z = 0 and faces -y, metres, with its
material, captions, support areas and resting tilts.
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
"""Tilt of an upright object laid on its side, its top towards -y."""

ON_EDGE: QuatXyzw = (0.0, _HALF, 0.0, _HALF)
"""Tilt of a flat object put on its edge, its left side on top, its face towards +x."""

STANDING = (UPRIGHT,)
EITHER = (UPRIGHT, LAID)
LYING = (LAID,)

DENSITY: Mapping[str, float] = MappingProxyType(
    {
        "ceramic": 2300.0, "glass": 1200.0, "metal": 2700.0, "tin": 1000.0, "wood": 650.0, "plastic": 950.0, "rubber": 1100.0,
        "paper": 750.0, "cardboard": 250.0, "fabric": 200.0, "foam": 120.0, "plant": 400.0, "fruit": 850.0, "food": 350.0,
        "wax": 900.0, "electronics": 1300.0,
    }
)  # fmt: skip
"""Effective density of each material, kilograms per cubic metre: that of glass is low because bottles are empty or contain a
lighter material."""

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
    """A level area that can support objects: the top of a book, the inside of a bowl. Metres, frame of the solid.

    Attributes:
        width: Along x; the diameter if round.
        depth: Along y; the diameter if round.
        z: Height of the area.
        height: Height of the rim above the area for a hollow; 0 for a top.
        is_round: Whether the area is a circle or an ellipse instead of a rectangle.
        x: Middle of the area.
        y: Middle of the area.
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
        solid: One connected solid that stands on z = 0 and faces -y, metres.
        material: A key of ``DENSITY``.
        color: A key of ``COLORS``, or ``#rrggbb``.
        captions: Three or more names for it, lower case, without a full stop; the first is the plainest complete one.
        top: Area that objects can stand on.
        hollow: Space that objects can lie or stand in; an asset without one is no container.
        tilts: Its usual resting tilts; the first is the most usual.
        density: Replaces the density of the material, kilograms per cubic metre, for example for an object that is hollow inside.
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
    """The random choices of one variant, the same for the same category and variant.

    Args:
        category: Category of the family.
        variant: Number of the variant, from 0.
    """

    def __init__(self, category: str, variant: int) -> None:
        self._key, self._variant = zlib.crc32(category.encode()), variant
        self._rng = np.random.default_rng([self._key, variant])
        self._num_picks = 0

    def between(self, low: float, high: float) -> float:
        """Draws a length between two bounds, metres, rounded to 0.1 mm."""
        return round(float(self._rng.uniform(low, high)), 4)

    def pick(self, *options: T) -> T:
        """Picks one of several options; as many variants as there are options use all of them."""
        self._num_picks += 1
        # Each pick has its own order, so that variants differ in the combination of their options.
        order = np.random.default_rng([self._key, self._num_picks]).permutation(len(options))
        return options[int(order[self._variant % len(options)])]


Drawing: TypeAlias = Callable[[VariantSampler], AssetDesign]
"""Designs one variant of a family; the name of the function is the category: words joined by ``_``, singular."""
