"""Who stands where: small groups of things that belong together, in the yaw frame of the group, before anything has settled.

A group lists what carries before what is carried; heights are found later, by lowering each thing onto what lies under it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from stable_data.scene import UPRIGHT, QuatXyzw
from stable_data.synth.catalogue import LAID


@dataclass(frozen=True, slots=True)
class Item:
    """One thing of a group.

    Attributes:
        key: Which asset.
        x: Of its box's centre, metres, group frame.
        y: Likewise.
        yaw: Radians, group frame.
        tilt_quat_xyzw: Its tilt.
        scale: Factor on its size.
    """

    key: str
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    tilt_quat_xyzw: QuatXyzw = UPRIGHT
    scale: float = 1.0

    def placed(self, x: float, y: float, yaw: float) -> "Item":
        """The item of a group that stands at a place of the table, turned by ``yaw``."""
        c, s = math.cos(yaw), math.sin(yaw)
        return replace(self, x=x + c * self.x - s * self.y, y=y + s * self.x + c * self.y, yaw=self.yaw + yaw)


Group: TypeAlias = list[Item]
Arrange: TypeAlias = Callable[[np.random.Generator], Group]
"""Draws a group."""

_FRUIT = ("apple/red", "orange/ripe", "lemon/small", "apple/red", "orange/ripe")
_TOPPERS = ("mug/tall", "apple/red", "can/tuna", "candle/pillar", "mug/wide")
_BOOKS = ("book/atlas", "book/novel", "notebook/a5", "book/pocket")


def one(key: str, *, wobble: float = 0.25) -> Arrange:
    """A thing by itself, turned by up to ``wobble`` radians."""
    return lambda rng: [Item(key, yaw=_around(rng, wobble), scale=_scale(rng))]


def laid(key: str) -> Arrange:
    """A thing that lies on its side."""
    return lambda rng: [Item(key, yaw=rng.uniform(0.5, 2.6), tilt_quat_xyzw=LAID, scale=_scale(rng))]


def row(*keys: str, step: float) -> Arrange:
    """Things side by side, ``step`` metres apart."""
    middle = (len(keys) - 1) / 2
    return lambda rng: [Item(key, x=(k - middle) * step, yaw=_around(rng, 0.15)) for k, key in enumerate(keys)]


def place_setting(rng: np.random.Generator) -> Group:
    """A plate, perhaps a second thing on it, a spoon on the right, something to drink from behind."""
    setting = [Item("plate/dinner")]
    extra = rng.integers(3)
    if extra == 0:
        setting.append(Item("plate/side"))
    elif extra == 1:
        setting.append(Item("bowl/deep", yaw=_around(rng, 3)))
    setting.append(Item("spoon/table", x=0.172, y=rng.uniform(-0.02, 0.02), yaw=math.pi + _around(rng, 0.06)))
    drink = ("mug/tall", "cup/tumbler", "mug/wide")[rng.integers(3)]
    return [*setting, Item(drink, x=0.13, y=0.2, yaw=_around(rng, 0.6))]


def books(rng: np.random.Generator) -> Group:
    """A stack of books, the largest at the bottom, sometimes with a thing on top."""
    chosen = [_BOOKS[0], *(key for key in _BOOKS[1:] if rng.random() < 0.75)]
    stack = [Item(key, _around(rng, 0.01), _around(rng, 0.01), _around(rng, 0.2), scale=_scale(rng)) for key in chosen]
    if rng.random() < 0.6:
        stack.append(Item(_TOPPERS[rng.integers(len(_TOPPERS))], yaw=_around(rng, 3), scale=0.95))
    return stack


def boxes(rng: np.random.Generator) -> Group:
    """A smaller box on a larger one."""
    return [Item("box/storage", scale=1.15), Item("box/storage", _around(rng, 0.01), 0.0, _around(rng, 0.4), scale=0.72)]


def plates(rng: np.random.Generator) -> Group:
    """A stack of plates."""
    kind = ("plate/dinner", "plate/side")[rng.integers(2)]
    return [Item(kind, _around(rng, 0.001), _around(rng, 0.001), _around(rng, 3)) for _ in range(rng.integers(3, 5))]


def fruit_bowl(rng: np.random.Generator) -> Group:
    """A large bowl with three or four fruits."""
    kinds = rng.permutation(np.array(_FRUIT))[: rng.integers(3, 5)]
    return [Item("bowl/fruit", yaw=_around(rng, 3)), *_ring_of(kinds.tolist(), 0.052, rng)]


def cup_of_pens(rng: np.random.Generator) -> Group:
    """A holder with two or three pens."""
    return _cup("pen_holder/round", rng.choice(["pen/ball", "pencil/hexagonal"], rng.integers(2, 4)).tolist(), 0.011, rng)


def cup_of_brushes(rng: np.random.Generator) -> Group:
    """A tumbler with two toothbrushes."""
    return _cup("cup/tumbler", ["toothbrush/soft"] * 2, 0.012, rng)


def crate_of_jars(rng: np.random.Generator) -> Group:
    """A crate with jars, tins and a bottle."""
    kinds = rng.choice(["jar/jam", "can/soup", "bottle/sauce", "can/tuna"], 4)
    places = [(-0.09, 0.052), (0.0, -0.05), (0.09, 0.05), (-0.095, -0.055)][: rng.integers(3, 5)]
    contents = [Item(str(key), *at, _around(rng, 3)) for key, at in zip(kinds, places, strict=False)]
    return [Item("crate/wooden", yaw=0.0), *contents]


def crate_with_bowl(rng: np.random.Generator) -> Group:
    """A crate that holds a jar and a bowl, which holds a fruit."""
    fruit = ("orange/ripe", "apple/red")[rng.integers(2)]
    return [
        Item("crate/wooden"),
        Item("jar/jam", 0.1, 0.03),
        Item("bowl/deep", -0.055),
        Item(fruit, -0.055, 0.004, _around(rng, 3)),
    ]


def basket_of_fruit(rng: np.random.Generator) -> Group:
    """A low basket with two or three fruits side by side."""
    kinds = rng.choice(["apple/red", "orange/ripe", "lemon/small"], 3)
    return [Item("basket/low"), *(Item(str(kind), (k - 1) * 0.075, _around(rng, 0.02)) for k, kind in enumerate(kinds))]


def bread_board(rng: np.random.Generator) -> Group:
    """A cutting board with a loaf and a knife, or with fruit."""
    knife = Item("knife/kitchen", 0.125, -0.01, _around(rng, 0.1))
    if rng.random() < 0.5:
        return [Item("cutting_board/oak"), Item("bread/loaf", -0.0, 0.035, _around(rng, 0.2)), knife]
    lemon = Item("lemon/small", 0.03, -0.05, _around(rng, 3), LAID)
    return [Item("cutting_board/oak"), Item("apple/red", -0.02, 0.03), lemon, knife]


def tea_tray(rng: np.random.Generator) -> Group:
    """A tray with a mug, a small plate and a fruit on it."""
    mug = Item(("mug/tall", "mug/wide")[rng.integers(2)], 0.12, 0.04, _around(rng, 0.5))
    plate = Item("plate/side", -0.08, -0.005, _around(rng, 3))
    on_plate = Item(("apple/red", "orange/ripe", "banana/ripe")[rng.integers(3)], -0.08, -0.005, _around(rng, 3), scale=0.95)
    return [Item("tray/serving"), plate, on_plate, mug]


def writing_things(rng: np.random.Generator) -> Group:
    """A notebook with a pen across it, a pencil beside it."""
    pen = Item("pen/ball", _around(rng, 0.015), _around(rng, 0.02), rng.uniform(0.3, 1.1), LAID)
    return [Item("notebook/a5"), pen, Item("pencil/hexagonal", 0.1, 0.0, _around(rng, 0.12), LAID)]


def soap_dish(rng: np.random.Generator) -> Group:
    """A bar of soap on a small plate."""
    return [Item("plate/side", scale=0.72), Item("soap/bar", yaw=_around(rng, 3), scale=0.9)]


def jars_on_box(rng: np.random.Generator) -> Group:
    """A storage box with a jar of cream and a perfume on its lid."""
    return [
        Item("box/storage", scale=0.95),
        Item("jar/cream", -0.045, _around(rng, 0.01)),
        Item("perfume/square", 0.045, 0.0, _around(rng, 0.3)),
    ]


def _ring_of(keys: Sequence[str], radius: float, rng: np.random.Generator) -> Group:
    """Things around a centre, turned by chance."""
    first = rng.uniform(0, 2 * math.pi)
    group = []
    for k, key in enumerate(keys):
        angle = first + 2 * math.pi * k / len(keys)
        group.append(Item(key, radius * math.cos(angle), radius * math.sin(angle), _around(rng, 3), scale=_scale(rng)))
    return group


def _cup(cup: str, keys: Sequence[str], radius: float, rng: np.random.Generator) -> Group:
    """Long things that lean in a cup, each outwards to its own side."""
    group, first = [Item(cup)], rng.uniform(0, 2 * math.pi)
    for k, key in enumerate(keys):
        lean, heading = math.radians(rng.uniform(9, 12)), first + 2 * math.pi * k / len(keys)
        tilt = (math.sin(lean / 2), 0.0, 0.0, math.cos(lean / 2))  # its top towards -y of its own yaw frame
        x, y = radius * math.sin(heading), -radius * math.cos(heading)
        group.append(Item(key, x, y, heading, tilt))
    return group


def _around(rng: np.random.Generator, most: float) -> float:
    return float(rng.uniform(-most, most))


def _scale(rng: np.random.Generator) -> float:
    return round(float(rng.uniform(0.94, 1.06)), 3)
