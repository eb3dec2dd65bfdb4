"""Groups of objects that belong together: items in the frame of their group, before settling.

A group lists a carrier before the items that it supports. Heights are found later, when each item is lowered onto its support.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from typing import TypeAlias

import numpy as np
import shapely
import shapely.affinity
from scipy.spatial.transform import Rotation

from stable_data.embedded_world.families.catalogue import NUM_VARIANTS, asset
from stable_data.embedded_world.modelling.family import SupportArea
from stable_data.geometry.leaning import FOOT_SHARE_DRAWN, LEAN_SHARE, LEAST_ROOM, PROTRUSION_DRAWN, feet_radius, leaning_tilt
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Vec3

_TRIES = 40
_UNEVEN = 0.12  # share of upright single items that are stretched, as in MesaTask-10K
_STRETCH = 0.15  # largest relative stretch along an axis


@dataclass(frozen=True, slots=True)
class GroupItem:
    """One item of a group.

    Attributes:
        key: Key of the asset.
        x: Centre of its box, metres, group frame.
        y: Centre of its box, metres, group frame.
        yaw: Radians, group frame.
        tilt_quat_xyzw: Its tilt.
        scale: Factors on its size, along the axes of its mesh.
    """

    key: str
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    tilt_quat_xyzw: QuatXyzw = UPRIGHT
    scale: Vec3 = (1.0, 1.0, 1.0)

    def moved(self, x: float, y: float, yaw: float = 0.0) -> "GroupItem":
        """The item in a group that is rotated by ``yaw`` and then translated."""
        c, s = math.cos(yaw), math.sin(yaw)
        return replace(self, x=x + c * self.x - s * self.y, y=y + s * self.x + c * self.y, yaw=self.yaw + yaw)

    @property
    def size(self) -> Vec3:
        """Its box in its yaw frame, metres."""
        x, y, z = _extents(self.key, self.tilt_quat_xyzw)
        if self.scale == (1.0, 1.0, 1.0):
            return x, y, z
        # A stretched item stands upright, so that the axes of its mesh are those of its box; the scale of other items is uniform.
        return x * self.scale[0], y * self.scale[1], z * self.scale[2]

    def outline(self, margin: float = 0.0) -> shapely.Polygon:
        """Its box on the table, metres, group frame, enlarged by ``margin`` on each side."""
        width, depth, _ = self.size
        x, y = width / 2 + margin, depth / 2 + margin
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        corners = ((x, -y), (x, y), (-x, y), (-x, -y))
        return shapely.Polygon([(self.x + c * u - s * v, self.y + s * u + c * v) for u, v in corners])


@lru_cache(maxsize=4096)
def _extents(key: str, tilt_quat_xyzw: QuatXyzw) -> Vec3:
    turned = Rotation.from_quat(tilt_quat_xyzw).apply(asset(key).mesh.vertices)
    x, y, z = (turned.max(axis=0) - turned.min(axis=0)).tolist()
    return (x, y, z)


Group: TypeAlias = list[GroupItem]


@dataclass(eq=False)
class GroupSampler:
    """The random choices of one scene; some choices are made once per scene, so that for example its cups are alike.

    Attributes:
        rng: The random generator.
    """

    rng: np.random.Generator
    _owned: dict[str, int] = field(default_factory=dict)
    _decided: dict[str, bool] = field(default_factory=dict)

    def chance(self, probability: float) -> bool:
        """Draws a yes or no."""
        return bool(self.rng.random() < probability)

    def decided(self, what: str, probability: float) -> bool:
        """Draws a yes or no once per scene for each ``what``."""
        if what not in self._decided:
            self._decided[what] = self.chance(probability)
        return self._decided[what]

    def between(self, low: float, high: float) -> float:
        """Draws a number between two bounds."""
        return float(self.rng.uniform(low, high))

    def around(self, most: float) -> float:
        """Draws a number between ``-most`` and ``most``."""
        return self.between(-most, most)

    def count(self, low: int, high: int) -> int:
        """Draws a whole number from ``low`` to ``high``, both included."""
        return int(self.rng.integers(low, high + 1))

    def pick(self, *options: str) -> str:
        """Picks one of several options."""
        return options[self.rng.integers(len(options))]

    def some(self, count: int, *options: str) -> list[str]:
        """Picks several different options."""
        return [options[k] for k in self.rng.permutation(len(options))[:count]]

    def key(self, *categories: str) -> str:
        """Draws an asset of one of some categories."""
        return f"{self.pick(*categories)}/{self.rng.integers(NUM_VARIANTS)}"

    def own(self, *categories: str) -> str:
        """Draws an asset of one of some categories; all draws of a category in this scene give the same variant."""
        category = self.pick(*categories)
        variant = self._owned.setdefault(category, int(self.rng.integers(NUM_VARIANTS)))
        return f"{category}/{variant}"

    def item(self, key: str, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, *, wobble: float = 0.0) -> GroupItem:
        """Makes an item in its most usual resting tilt, slightly scaled, its yaw varied by up to ``wobble``."""
        return GroupItem(key, x, y, yaw + self.around(wobble), asset(key).tilts[0], self.scale())

    def items(self, low: int, high: int, *categories: str, wobble: float = 0.0) -> Group:
        """Draws ``low`` to ``high`` items of some categories."""
        return [self.item(self.key(*categories), wobble=wobble) for _ in range(self.count(low, high))]

    def loose_item(self, *categories: str) -> GroupItem:
        """Draws an item of one of some categories, at any yaw."""
        return self.item(self.key(*categories), yaw=self.around(3))

    def loose_items(self, low: int, high: int, *categories: str) -> Group:
        """Draws ``low`` to ``high`` items of some categories, each at any yaw."""
        return [self.loose_item(*categories) for _ in range(self.count(low, high))]

    def single(self, *categories: str, wobble: float = 0.3) -> GroupItem:
        """Draws an item in one of its usual resting tilts, sometimes stretched along some axes."""
        key = self.key(*categories)
        tilts = asset(key).tilts
        tilt = tilts[0] if self.chance(0.7) else tilts[self.rng.integers(len(tilts))]
        scale = self.scale()
        if tilt == UPRIGHT and self.chance(_UNEVEN):
            # Each axis draws its own index: none, one or several axes are stretched.
            x, y, z = (s * (1 + self.around(_STRETCH) * (k == self.rng.integers(3))) for k, s in enumerate(scale))
            scale = (round(x, 3), round(y, 3), round(z, 3))
        return GroupItem(key, 0.0, 0.0, self.around(wobble), tilt, scale)

    def scale(self, spread: float = 0.06) -> Vec3:
        """Draws a uniform scale near 1."""
        factor = round(self.between(1 - spread, 1 + spread), 3)
        return (factor, factor, factor)


Arrange: TypeAlias = Callable[[GroupSampler], Group]
"""Draws a group."""


def row(items: Sequence[GroupItem], gap: float) -> Group:
    """Places items side by side along x, ``gap`` metres apart, around the origin; each retains its y and yaw."""
    widths = [np.ptp(item.outline().bounds[0::2]) for item in items]
    start = -(sum(widths) + gap * (len(items) - 1)) / 2
    placed = []
    for item, width in zip(items, widths, strict=True):
        placed.append(replace(item, x=start + float(width) / 2))
        start += float(width) + gap
    return placed


def stack(items: Sequence[GroupItem], kit: GroupSampler, *, shift: float = 0.006, turn: float = 0.15) -> Group:
    """Stacks items, the first at the bottom, each slightly displaced and rotated."""
    first, *rest = items
    return [first, *(replace(o, x=first.x + kit.around(shift), y=first.y + kit.around(shift), yaw=o.yaw + kit.around(turn))
                     for o in rest)]  # fmt: skip


def floor_of(item: GroupItem, space: SupportArea, margin: float = 0.0) -> shapely.Polygon:
    """The top or the hollow of an upright item as a polygon, metres, group frame, reduced by ``margin`` on each side."""
    # The lower bound keeps the polygon valid if the margin exceeds the area.
    x, y = (max(side / 2 * s - margin, 1e-4) for side, s in zip((space.width, space.depth), item.scale, strict=False))
    if space.is_round:
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        corners: FloatArray = np.stack([x * np.cos(angle), y * np.sin(angle)], axis=1)
    else:
        corners = np.array([(x, -y), (x, y), (-x, y), (-x, -y)], np.float64)
    corners += (space.x * item.scale[0], space.y * item.scale[1])
    c, s = math.cos(item.yaw), math.sin(item.yaw)
    return shapely.Polygon(corners @ np.array([[c, s], [-s, c]]) + (item.x, item.y))


def scatter(
    area: shapely.Polygon, items: Sequence[GroupItem], kit: GroupSampler, *, gap: float = 0.004, overhang: float = 0.0
) -> Group:
    """Places items side by side in an area, at random positions; an item without a free position is left out.

    Args:
        area: The area, metres, group frame.
        items: The items.
        kit: The random choices.
        gap: Distance between two items, metres.
        overhang: Share of the sides of an item that may extend beyond the area.
    """
    x_min, y_min, x_max, y_max = area.bounds
    outlines: list[shapely.Polygon] = []
    placed: Group = []
    for item in items:
        for _ in range(_TRIES):
            candidate = replace(item, x=kit.between(x_min, x_max), y=kit.between(y_min, y_max))
            outline = candidate.outline(gap / 2)
            inner = shapely.affinity.scale(outline, 1 - overhang, 1 - overhang) if overhang else outline
            if area.contains(inner) and not any(outline.intersects(other) for other in outlines):
                outlines.append(outline)
                placed.append(candidate)
                break
    return placed


def fill_container(container: GroupItem, contents: Sequence[GroupItem], kit: GroupSampler, *, gap: float = 0.004) -> Group:
    """Places items side by side in a container; an item without a free position is left out."""
    hollow = asset(container.key).hollow
    if hollow is None:
        return [container]
    return [container, *scatter(floor_of(container, hollow, 0.002), contents, kit, gap=gap)]


def place_on_carrier(
    carrier: GroupItem, items: Sequence[GroupItem], kit: GroupSampler, *, gap: float = 0.008, overhang: float = 0.0
) -> Group:
    """Places items on the top of a carrier or, if it has none, in it; an item without a free position is left out."""
    top = asset(carrier.key).top
    if top is None:
        return fill_container(carrier, items, kit, gap=gap)
    return [carrier, *scatter(floor_of(carrier, top), items, kit, gap=gap, overhang=overhang)]


def heap_in_bowl(bowl: GroupItem, items: Sequence[GroupItem], kit: GroupSampler) -> Group:
    """Places as many round items as fit side by side in a ring in a bowl; they roll together while settling."""
    width, depth, _ = bowl.size
    widest = max((max(o.size[:2]) for o in items), default=0.0)
    reach = 0.43 * min(width, depth) - widest / 2
    count = len(items)
    # Neighbours on the ring need a distance of their width plus 6 %.
    while count > 1 and 2 * reach * math.sin(math.pi / count) < 1.06 * widest:
        count -= 1
    # There is no item, or not even one fits.
    if not items or reach < -0.1 * widest:
        return [bowl]
    first, radius = kit.between(0, 2 * math.pi), 0.0 if count == 1 else max(reach, 0.0)
    angles = [first + 2 * math.pi * k / count for k in range(count)]
    ring = [
        replace(o, x=bowl.x + radius * math.cos(a), y=bowl.y + radius * math.sin(a), yaw=kit.around(3))
        for o, a in zip(items, angles, strict=False)
    ]
    return [bowl, *ring]


def lean_in_cup(cup: GroupItem, keys: Sequence[str], kit: GroupSampler) -> Group:
    """Leans long items in a cup, each outwards in its own direction, its foot near the middle."""
    hollow = asset(cup.key).hollow
    if hollow is None:
        return [cup]
    group, first = [cup], kit.between(0, 2 * math.pi)
    radius, height = min(hollow.width, hollow.depth) / 2 * cup.scale[0], hollow.height * cup.scale[2]
    # A shorter item would not protrude from the cup.
    fitting = [key for key in keys if _extents(key, UPRIGHT)[2] > PROTRUSION_DRAWN * height]
    for k, key in enumerate(fitting):
        centre, half = _foot(key)
        foot = 0.0 if len(fitting) == 1 else feet_radius(half, len(fitting))
        room = radius - half - foot
        if room <= LEAST_ROOM:
            break
        lean = LEAN_SHARE * math.atan(room / height)
        # The items lean in evenly distributed directions.
        heading = first + 2 * math.pi * k / len(fitting)
        tilt = leaning_tilt(lean)
        x, y = _below(key, tilt, centre)
        c, s = math.cos(heading), math.sin(heading)
        there = (cup.x + foot * s - (c * x - s * y), cup.y - foot * c - (s * x + c * y))
        group.append(GroupItem(key, *there, heading, tilt))
    return group


@cache
def _foot(key: str) -> tuple[Vec3, float]:
    """The middle of the lower end of a long item, in the frame of its mesh, and the radius there, metres."""
    vertices = asset(key).mesh.vertices
    low = vertices[:, 2].min()
    end = vertices[vertices[:, 2] < low + FOOT_SHARE_DRAWN * np.ptp(vertices[:, 2])]
    middle = (end.min(axis=0) + end.max(axis=0)) / 2
    x, y = middle[:2].tolist()
    return (x, y, float(low)), float(np.linalg.norm(end[:, :2] - middle[:2], axis=1).max())


def _below(key: str, tilt_quat_xyzw: QuatXyzw, point: Vec3) -> tuple[float, float]:
    """The position of a point of a mesh after a tilt, from the middle of the box in the yaw frame, metres."""
    rotation = Rotation.from_quat(tilt_quat_xyzw)
    tilted = rotation.apply(asset(key).mesh.vertices)
    x, y, _ = (rotation.apply(point) - (tilted.min(axis=0) + tilted.max(axis=0)) / 2).tolist()
    return x, y
