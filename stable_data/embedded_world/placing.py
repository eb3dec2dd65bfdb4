"""Puts groups on a table: a free place for each, and each thing lowered onto what lies under it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import fcl
import numpy as np
import shapely
from scipy.spatial.transform import Rotation

from stable_data.embedded_world.families.catalogue import EmbeddedAsset, asset
from stable_data.embedded_world.groups.arrangement import Group, GroupItem, GroupSampler
from stable_data.embedded_world.plans import Slot, TablePlan
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.scene import QuatXyzw, Tabletop, Vec3
from stable_data.simulation.settling import RigidBody

_MARGIN = 0.008  # between groups, metres
_EDGE = 0.012  # between a group and the edge of the table, metres
_TRIES = 40
_STEP = 0.004  # how far a thing is lowered before the next look, metres; thinner than what it could pass through
_CLEARANCE = 5e-5  # what is left under it, metres
_TALL = 0.24  # metres; what is taller than this stands at the back, where it hides nothing


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """A thing at its place, in its yaw frame.

    Attributes:
        item: The thing.
        z: Height of its box's centre, metres.
        group: Number of its group in the scene.
    """

    item: GroupItem
    z: float = 0.0
    group: int = 0

    @cached_property
    def asset(self) -> EmbeddedAsset:
        """Its asset."""
        return asset(self.item.key)

    @cached_property
    def shape(self) -> Shape:
        """Its mesh in the yaw frame, centred on its box, metres."""
        return Shape.from_mesh(self.asset.mesh, self.item.scale, self.item.tilt_quat_xyzw)

    @cached_property
    def mass(self) -> float:
        """Kilograms, at its scale."""
        return self.asset.mass * float(np.prod(self.item.scale))

    def body(self, name: str) -> RigidBody:
        """What the engine is given."""
        parts = yaw_frame_parts(self.asset, self.item.scale, self.item.tilt_quat_xyzw)
        return RigidBody(name, parts, self.mass, (self.item.x, self.item.y, self.z), self.item.yaw)


def yaw_frame_parts(source: EmbeddedAsset, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> tuple[Mesh, ...]:
    """The convex parts of a scaled and tilted asset, metres, yaw frame, centred on the box of its mesh there."""
    turn = (Rotation.from_quat(tilt_quat_xyzw).as_matrix() * scale).T
    tilted = source.mesh.vertices @ turn
    centre = (tilted.min(axis=0) + tilted.max(axis=0)) / 2
    return tuple(Mesh(part.vertices @ turn - centre, part.faces) for part in source.parts)


def compose(plan: TablePlan, table: Tabletop, kit: GroupSampler, target: int, most: int) -> list[PlacedObject]:
    """Lays a table: what it is about, then other groups, each once, until it is as full as wanted.

    Args:
        plan: Its kind.
        table: The table; its restricted zone stays free.
        kit: Draws.
        target: How many things are wanted.
        most: How many things may be on it.

    Returns:
        Every thing, clear of every other by at least 0.05 mm.
    """
    theme = plan.themes[kit.rng.integers(len(plan.themes))]
    ground = TableOccupancy(table)
    placed: list[PlacedObject] = []
    done = set()
    for spot in theme(kit, table):
        done.add(spot.arrange)
        placed += ground.placed(spot.arrange(kit), spot, kit, most - len(placed))
    others = [arrange for arrange in plan.others if arrange not in done]
    for k in kit.rng.permutation(len(others)):
        if len(placed) >= target:
            break
        placed += ground.placed(others[k](kit), Slot(others[k]), kit, most - len(placed))
    return placed


class TableOccupancy:
    """A table top and what of it is taken.

    Args:
        table: The table.
    """

    def __init__(self, table: Tabletop) -> None:
        self._table = table
        width, depth = table.size_xy
        self._allowed = shapely.box(_EDGE, _EDGE, width - _EDGE, depth - _EDGE)
        self._taken: list[shapely.Geometry] = []
        self._num_groups = 0
        if table.restricted_zone is not None:
            x_min, x_max, y_min, y_max = table.restricted_zone
            self._taken.append(shapely.box(x_min, y_min, x_max, y_max))

    def take(self, outline: shapely.Geometry) -> None:
        """Keeps an area free."""
        self._taken.append(outline)

    def allows(self, outline: shapely.Geometry) -> bool:
        """Whether an area is on the table, clear of its edges."""
        return bool(self._allowed.contains(outline))

    def is_free(self, outline: shapely.Geometry) -> bool:
        """Whether an area is on the table and nothing taken is near it."""
        return self.allows(outline) and not shapely.dwithin(outline, self._taken, _MARGIN).any()

    def placed(self, group: Group, spot: Slot, kit: GroupSampler, most: int) -> list[PlacedObject]:
        """The things of a group at a free place within its spot, lowered; nothing where there is no room, or for so many."""
        if not group or len(group) > most:
            return []
        width, depth = self._table.size_xy
        outline = shapely.union_all([item.outline() for item in group])
        (x_low, x_high), (y_low, y_high) = spot.x, spot.y
        if y_low < 0.6 and y_high > 0.85 and max(item.size[2] for item in group) > _TALL:
            y_low = 0.6
        for attempt in range(_TRIES):
            slack = 0.5 * max(0, attempt - _TRIES // 3) / _TRIES  # look farther around before giving up
            x = width * kit.between(x_low - slack, x_high + slack)
            y = depth * kit.between(y_low - slack, y_high + slack)
            there = shapely.affinity.translate(shapely.affinity.rotate(outline, spot.yaw, (0, 0), use_radians=True), x, y)
            if self.is_free(there):
                self._taken.append(there)
                self._num_groups += 1
                return lower_group([item.moved(x, y, spot.yaw) for item in group], self._num_groups)
        return []


def lower_group(group: Group, number: int = 0) -> list[PlacedObject]:
    """The things of a group, each lowered until it is just clear of what is under it."""
    placed: list[PlacedObject] = []
    for item in group:
        thing, outline = PlacedObject(item, 0.0, number), item.outline()
        below = [other for other in placed if outline.intersects(other.item.outline())]
        floor = float(thing.shape.size[2]) / 2 + _CLEARANCE
        z = floor if not below else max(floor, _lowest(thing, below, floor) + _CLEARANCE)
        placed.append(PlacedObject(item, z, number))
    return placed


def _lowest(thing: PlacedObject, below: Sequence[PlacedObject], floor: float) -> float:
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


def _collider(thing: PlacedObject) -> fcl.CollisionObject:
    tree = fcl.BVHModel()
    tree.beginModel(len(thing.shape.vertices), len(thing.shape.faces))
    tree.addSubModel(thing.shape.vertices, thing.shape.faces)
    tree.endModel()
    c, s = np.cos(thing.item.yaw), np.sin(thing.item.yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return fcl.CollisionObject(tree, fcl.Transform(turn, np.array([thing.item.x, thing.item.y, thing.z])))
