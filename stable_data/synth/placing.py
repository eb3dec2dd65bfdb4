"""Puts groups on a table: a free place for each, and each thing lowered onto what lies under it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import fcl
import numpy as np
import shapely
from scipy.spatial.transform import Rotation

from stable_data.mesh import Mesh
from stable_data.physics import Body
from stable_data.scene import FloatArray, QuatXyzw, Tabletop
from stable_data.shape import Shape
from stable_data.synth.arrangement import Group, Item
from stable_data.synth.assets import Asset, asset
from stable_data.synth.plans import Spot

_MARGIN = 0.008  # between groups, metres
_EDGE = 0.012  # between a group and the edge of the table, metres
_TRIES = 60
_STEP = 0.004  # how far a thing is lowered before the next look, metres; thinner than what it could pass through
_CLEARANCE = 5e-5  # what is left under it, metres


@dataclass(frozen=True, eq=False)
class Placed:
    """A thing at its place, in its yaw frame.

    Attributes:
        item: The thing.
        z: Height of its box's centre, metres.
    """

    item: Item
    z: float = 0.0

    @cached_property
    def asset(self) -> Asset:
        """Its asset."""
        return asset(self.item.key)

    @cached_property
    def shape(self) -> Shape:
        """Its mesh in the yaw frame, centred on its box, metres."""
        return Shape.from_mesh(self.asset.mesh, (self.item.scale,) * 3, self.item.tilt_quat_xyzw)

    @cached_property
    def pose(self) -> FloatArray:
        """x, y, z, yaw, (4,) float64."""
        return np.array([self.item.x, self.item.y, self.z, self.item.yaw])

    @cached_property
    def outline(self) -> shapely.Polygon:
        """Its footprint on the table."""
        return shapely.Polygon(self.shape.posed_footprint(self.pose))

    @cached_property
    def mass(self) -> float:
        """Kilograms, at its scale."""
        return self.asset.mass * self.item.scale**3

    def at(self, z: float) -> "Placed":
        """The same thing at another height."""
        return Placed(self.item, z)

    def body(self, name: str) -> Body:
        """What the engine is given."""
        parts = yaw_frame_parts(self.asset, self.item.scale, self.item.tilt_quat_xyzw)
        return Body(name, parts, self.mass, (self.item.x, self.item.y, self.z), self.item.yaw)


def yaw_frame_parts(source: Asset, scale: float, tilt_quat_xyzw: QuatXyzw) -> tuple[Mesh, ...]:
    """The convex parts of a scaled and tilted asset, metres, yaw frame, centred on the box of its mesh there."""
    rotation = Rotation.from_quat(tilt_quat_xyzw).as_matrix().T * scale
    tilted = source.mesh.vertices @ rotation
    centre = (tilted.min(axis=0) + tilted.max(axis=0)) / 2
    return tuple(Mesh(part.vertices @ rotation - centre, part.faces) for part in source.parts)


def place(spots: Sequence[Spot], table: Tabletop, rng: np.random.Generator) -> list[Placed] | None:
    """Puts groups on a table.

    Args:
        spots: The groups, the most important first.
        table: The table; its restricted zone stays free.
        rng: Draws.

    Returns:
        Every thing, clear of every other by at least 0.05 mm; None where a group that must be there found no place.
    """
    taken = [] if table.restricted_zone is None else [_rectangle(*table.restricted_zone)]
    placed: list[Placed] = []
    for spot in spots:
        found = _free_place(spot, table, taken, rng)
        if found is None:
            if spot.may_miss:
                continue
            return None
        group, outline = found
        taken.append(outline)
        placed += _lowered(group)
    return placed


def _free_place(
    spot: Spot, table: Tabletop, taken: Sequence[shapely.Polygon], rng: np.random.Generator
) -> tuple[Group, shapely.Polygon] | None:
    width, depth = table.size_xy
    allowed = _rectangle(_EDGE, width - _EDGE, _EDGE, depth - _EDGE)
    group = spot.arrange(rng)
    for attempt in range(_TRIES):
        slack = 0.3 * max(0, attempt - _TRIES // 2) / _TRIES  # look farther around before giving up
        x = width * rng.uniform(spot.x[0] - slack, spot.x[1] + slack)
        y = depth * rng.uniform(spot.y[0] - slack, spot.y[1] + slack)
        there = [item.placed(x, y, spot.yaw) for item in group]
        outline = shapely.union_all([Placed(item).outline for item in there])
        wide = outline.buffer(_MARGIN)
        if allowed.contains(outline) and not any(wide.intersects(other) for other in taken):
            return there, outline
    return None


def _rectangle(x_min: float, x_max: float, y_min: float, y_max: float) -> shapely.Polygon:
    return shapely.box(x_min, y_min, x_max, y_max)


def _lowered(group: Group) -> list[Placed]:
    """The things of a group, each lowered until it is just clear of what is under it."""
    placed: list[Placed] = []
    for item in group:
        thing = Placed(item)
        below = [other for other in placed if thing.outline.intersects(other.outline)]
        floor = float(thing.shape.size[2]) / 2 + _CLEARANCE
        if not below:
            placed.append(thing.at(floor))
            continue
        placed.append(thing.at(max(floor, _lowest(thing, below, floor) + _CLEARANCE)))
    return placed


def _lowest(thing: Placed, below: Sequence[Placed], floor: float) -> float:
    """The lowest height that a thing reaches from above without touching, metres, to within 0.01 mm."""
    others = [_collider(other) for other in below]
    moving = _collider(thing)

    def touches(z: float) -> bool:
        moving.setTranslation(np.array([thing.item.x, thing.item.y, z]))
        return any(fcl.collide(moving, other, fcl.CollisionRequest(), fcl.CollisionResult()) > 0 for other in others)

    high = max(other.z + float(other.shape.size[2]) / 2 for other in below) + floor + _STEP
    while high > floor and not touches(high - _STEP):
        high -= _STEP
    low = high - _STEP
    while high - low > 1e-5:
        middle = (low + high) / 2
        low, high = (middle, high) if touches(middle) else (low, middle)
    return high


def _collider(thing: Placed) -> fcl.CollisionObject:
    tree = fcl.BVHModel()
    tree.beginModel(len(thing.shape.vertices), len(thing.shape.faces))
    tree.addSubModel(thing.shape.vertices, thing.shape.faces)
    tree.endModel()
    c, s = np.cos(thing.item.yaw), np.sin(thing.item.yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return fcl.CollisionObject(tree, fcl.Transform(turn, thing.pose[:3]))
