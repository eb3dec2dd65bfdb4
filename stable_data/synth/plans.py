"""What is on each of the six kinds of table: plans of groups, each with the part of the table that it may stand in."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from stable_data.synth import arrangement as a
from stable_data.synth.arrangement import Arrange


@dataclass(frozen=True, slots=True)
class Spot:
    """A group and where it may stand.

    Attributes:
        arrange: Draws the group.
        x: Lowest and highest place of its origin, shares of the table's width.
        y: The same along the table's depth.
        yaw: Which way it looks, radians.
        may_miss: Leave it out where it does not fit.
    """

    arrange: Arrange
    x: tuple[float, float]
    y: tuple[float, float]
    yaw: float = 0.0
    may_miss: bool = True


@dataclass(frozen=True, slots=True)
class TablePlan:
    """A kind of table.

    Attributes:
        width: Lowest and highest, metres.
        depth: Likewise.
        plans: What may be on it; scenes take them in turn.
        has_sink: Whether a rectangle in its middle is kept free.
    """

    width: tuple[float, float]
    depth: tuple[float, float]
    plans: tuple[tuple[Spot, ...], ...]
    has_sink: bool = False


_BACK = (0.7, 0.95)
_MIDDLE = (0.35, 0.65)
_FRONT = (0.05, 0.35)
_LEFT = (0.05, 0.3)
_CENTRE = (0.35, 0.65)
_RIGHT = (0.7, 0.95)
_ANY = (0.05, 0.95)

_WORK_FRONT = Spot(a.writing_things, (0.15, 0.9), (0.1, 0.45))
_LAPTOP = Spot(a.one("laptop/open", wobble=0.12), (0.4, 0.6), (0.3, 0.6))
_LAMP_LEFT = Spot(a.one("lamp/desk"), (0.08, 0.2), (0.7, 0.9))
_LAMP_RIGHT = Spot(a.one("lamp/desk"), (0.8, 0.92), (0.7, 0.9))
_MUG = Spot(a.one("mug/tall", wobble=0.9), _ANY, (0.1, 0.8))

OFFICE = TablePlan(
    (1.05, 1.25),
    (0.58, 0.68),
    (
        (_LAPTOP, Spot(a.cup_of_pens, _RIGHT, _BACK), Spot(a.books, _LEFT, (0.3, 0.75)), _WORK_FRONT, _MUG),
        (
            Spot(a.books, _RIGHT, _MIDDLE),
            _LAMP_LEFT,
            _LAPTOP,
            Spot(a.one("stapler/long"), _LEFT, _FRONT),
            _MUG,
            Spot(a.laid("pen/ball"), _RIGHT, _FRONT),
        ),
        (
            _WORK_FRONT,
            Spot(a.boxes, _RIGHT, _BACK),
            _LAMP_LEFT,
            Spot(a.cup_of_pens, _CENTRE, _BACK),
            Spot(a.one("stapler/long"), _ANY, _FRONT),
        ),
        (
            _LAMP_RIGHT,
            Spot(a.books, _LEFT, _BACK),
            Spot(a.books, _CENTRE, _MIDDLE),
            Spot(a.cup_of_pens, _LEFT, _FRONT),
            Spot(a.laid("bottle/sauce"), _RIGHT, _FRONT),
        ),
    ),
)

_NEAR = Spot(a.place_setting, (0.2, 0.4), (0.2, 0.25))
_NEAR_RIGHT = Spot(a.place_setting, (0.65, 0.8), (0.2, 0.25))
_FAR = Spot(a.place_setting, (0.55, 0.8), (0.75, 0.8), math.pi)

DINING = TablePlan(
    (1.15, 1.35),
    (0.78, 0.9),
    (
        (_NEAR, _FAR, Spot(a.fruit_bowl, (0.4, 0.6), (0.45, 0.55))),
        (_NEAR, _NEAR_RIGHT, Spot(a.row("candle/pillar", "vase/slender", "candle/pillar", step=0.14), (0.4, 0.6), (0.6, 0.75))),
        (_NEAR, _FAR, Spot(a.laid("bottle/wine"), _CENTRE, _MIDDLE), Spot(a.plates, _LEFT, _BACK)),
        (
            Spot(a.tea_tray, (0.4, 0.6), (0.3, 0.5)),
            Spot(a.fruit_bowl, _RIGHT, _BACK),
            Spot(a.one("bottle/wine"), _LEFT, _BACK),
            Spot(a.plates, _LEFT, _FRONT),
        ),
    ),
)

COFFEE = TablePlan(
    (0.85, 1.0),
    (0.52, 0.62),
    (
        (
            Spot(a.tea_tray, (0.55, 0.7), (0.3, 0.5)),
            Spot(a.books, _LEFT, (0.4, 0.7)),
            Spot(a.one("candle/pillar"), _ANY, _BACK),
        ),
        (
            Spot(a.fruit_bowl, (0.2, 0.4), (0.4, 0.7)),
            Spot(a.books, (0.7, 0.85), _MIDDLE),
            Spot(a.one("mug/wide", wobble=0.9), _CENTRE, _FRONT),
        ),
        (
            Spot(a.books, (0.2, 0.4), _MIDDLE),
            Spot(a.one("vase/slender"), (0.5, 0.7), _BACK),
            Spot(a.basket_of_fruit, (0.6, 0.8), (0.2, 0.5)),
        ),
        (
            Spot(a.row("mug/wide", "bowl/deep", "mug/tall", step=0.2), (0.35, 0.5), (0.2, 0.4)),
            Spot(a.laid("bottle/wine"), _CENTRE, _BACK),
            Spot(a.one("book/novel"), _RIGHT, (0.1, 0.9)),
        ),
    ),
)

KITCHEN = TablePlan(
    (1.05, 1.25),
    (0.56, 0.66),
    (
        (
            Spot(a.crate_with_bowl, (0.2, 0.3), (0.55, 0.7)),
            Spot(a.bread_board, (0.55, 0.7), (0.2, 0.35)),
            Spot(a.row("bottle/sauce", "bottle/sauce", "bottle/sauce", step=0.1), (0.6, 0.8), _BACK),
        ),
        (
            Spot(a.bread_board, (0.4, 0.6), (0.2, 0.35)),
            Spot(a.one("saucepan/small", wobble=0.6), (0.6, 0.75), (0.65, 0.8)),
            Spot(a.plates, (0.15, 0.25), (0.6, 0.75)),
            Spot(a.one("can/soup"), _ANY, _ANY),
        ),
        (
            Spot(a.crate_of_jars, (0.65, 0.8), (0.55, 0.75)),
            Spot(a.fruit_bowl, (0.2, 0.35), (0.3, 0.6)),
            Spot(a.laid("bottle/wine"), (0.4, 0.6), _FRONT),
            Spot(a.one("banana/ripe"), _RIGHT, _FRONT),
        ),
        (
            Spot(a.row("jar/jam", "can/soup", "jar/jam", "can/soup", step=0.11), (0.3, 0.5), (0.75, 0.85)),
            Spot(a.one("saucepan/small", wobble=0.6), (0.15, 0.4), (0.2, 0.4)),
            Spot(a.one("box/cereal"), _RIGHT, _BACK),
            Spot(a.basket_of_fruit, (0.6, 0.8), _FRONT),
        ),
    ),
)

_CREAMS = Spot(a.row("jar/cream", "jar/cream", "jar/cream", step=0.095), (0.2, 0.8), (0.3, 0.6))
_MIRROR = Spot(a.one("mirror/round", wobble=0.1), (0.4, 0.6), (0.75, 0.85))

DRESSING = TablePlan(
    (0.9, 1.1),
    (0.44, 0.5),
    (
        (
            _MIRROR,
            _CREAMS,
            Spot(a.jars_on_box, _LEFT, (0.5, 0.8)),
            Spot(a.one("perfume/square"), _RIGHT, _ANY),
            Spot(a.one("vase/slender"), _RIGHT, _BACK),
        ),
        (
            _MIRROR,
            Spot(a.row("perfume/square", "perfume/square", "perfume/square", step=0.11), _LEFT, (0.3, 0.6)),
            Spot(a.boxes, _RIGHT, (0.5, 0.7)),
            Spot(a.one("jar/cream"), _CENTRE, _FRONT),
        ),
        (
            _LAMP_LEFT,
            _MIRROR,
            Spot(a.soap_dish, _CENTRE, _FRONT),
            Spot(a.jars_on_box, _RIGHT, (0.4, 0.7)),
            Spot(a.one("candle/pillar"), _ANY, _ANY),
        ),
        (
            _MIRROR,
            Spot(a.books, (0.15, 0.25), (0.4, 0.7)),
            _CREAMS,
            Spot(a.laid("toothbrush/soft"), _CENTRE, _FRONT),
            Spot(a.one("candle/pillar"), _RIGHT, _BACK),
        ),
    ),
)

_SIDE_LEFT, _SIDE_RIGHT = (0.05, 0.22), (0.78, 0.95)

VANITY = TablePlan(
    (1.1, 1.3),
    (0.5, 0.58),
    (
        (
            Spot(a.cup_of_brushes, _SIDE_RIGHT, (0.5, 0.8)),
            Spot(a.soap_dish, _SIDE_RIGHT, _FRONT),
            Spot(a.one("soap_dispenser/pump"), _SIDE_LEFT, _MIDDLE),
            Spot(a.one("jar/cream"), _SIDE_LEFT, _FRONT),
        ),
        (
            Spot(a.one("mirror/round"), _SIDE_LEFT, _BACK),
            Spot(a.cup_of_brushes, _SIDE_RIGHT, _BACK),
            Spot(a.row("jar/cream", "jar/cream", step=0.1), _SIDE_LEFT, _FRONT),
            Spot(a.one("soap_dispenser/pump"), _SIDE_RIGHT, _FRONT),
        ),
        (
            Spot(a.jars_on_box, _SIDE_LEFT, _MIDDLE),
            Spot(a.soap_dish, _SIDE_RIGHT, _FRONT),
            Spot(a.cup_of_brushes, _SIDE_RIGHT, _BACK),
            Spot(a.laid("toothbrush/soft"), _SIDE_LEFT, _FRONT),
        ),
        (
            Spot(a.one("vase/slender"), _SIDE_LEFT, _BACK),
            Spot(a.cup_of_brushes, _SIDE_LEFT, _FRONT),
            Spot(a.one("candle/pillar"), _SIDE_RIGHT, _BACK),
            Spot(a.soap_dish, _SIDE_RIGHT, _FRONT),
        ),
    ),
    has_sink=True,
)

TABLES: Mapping[str, TablePlan] = MappingProxyType(
    {
        "bathroom_vanity": VANITY,
        "coffee_table": COFFEE,
        "dining_table": DINING,
        "dressing_table": DRESSING,
        "kitchen_counter": KITCHEN,
        "office_table": OFFICE,
    }
)
"""Every kind of table, by the format's name."""
