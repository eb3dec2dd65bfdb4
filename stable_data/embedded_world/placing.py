"""Places groups on a table: finds a free place for each group and lowers each object onto its support."""

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

_MARGIN = 0.008  # distance between groups, metres
_EDGE = 0.012  # distance of a group from the edge of the table, metres
_TRIES = 40
_STEP = 0.004  # lowering step between two contact checks, metres; smaller than the thinnest part, so that none is skipped
_CLEARANCE = 5e-5  # gap that remains below a lowered object, metres
_TALL = 0.24  # metres; a taller object stands at the back, where it hides no other


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """An item at its place on the table.

    Attributes:
        item: The item, in the world frame.
        z: Height of the centre of its box, metres.
        group: Number of its group in the scene.
    """

    item: GroupItem
    z: float = 0.0
    group: int = 0

    @cached_property
    def asset(self) -> EmbeddedAsset:
        """The asset of the item."""
        return asset(self.item.key)

    @cached_property
    def shape(self) -> Shape:
        """The mesh in the yaw frame, centred on its box, metres."""
        return Shape.from_mesh(self.asset.mesh, self.item.scale, self.item.tilt_quat_xyzw)

    @cached_property
    def mass(self) -> float:
        """The mass at the scale of the item, kilograms."""
        return self.asset.mass * float(np.prod(self.item.scale))

    def body(self, name: str) -> RigidBody:
        """Converts the object into a rigid body of the physics engine."""
        parts = yaw_frame_parts(self.asset, self.item.scale, self.item.tilt_quat_xyzw)
        return RigidBody(name, parts, self.mass, (self.item.x, self.item.y, self.z), self.item.yaw)


def yaw_frame_parts(source: EmbeddedAsset, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> tuple[Mesh, ...]:
    """The convex parts of a scaled and tilted asset, metres, yaw frame, centred on the box of its mesh."""
    turn = (Rotation.from_quat(tilt_quat_xyzw).as_matrix() * scale).T
    tilted = source.mesh.vertices @ turn
    centre = (tilted.min(axis=0) + tilted.max(axis=0)) / 2
    return tuple(Mesh(part.vertices @ turn - centre, part.faces) for part in source.parts)


def compose(plan: TablePlan, table: Tabletop, kit: GroupSampler, target: int, most: int) -> list[PlacedObject]:
    """Composes a table: first the groups of one theme, then other groups, each at most once, up to a target number of objects.

    Args:
        plan: The plan of the kind of table.
        table: The table; its restricted zone stays free.
        kit: The random choices.
        target: Number of objects from which no other group is added.
        most: Largest number of objects.

    Returns:
        The objects, at least 0.05 mm apart.
    """
    theme = plan.themes[kit.rng.integers(len(plan.themes))]
    occupancy = TableOccupancy(table)
    placed: list[PlacedObject] = []
    # A group of the theme is not added again.
    done = set()
    for slot in theme(kit, table):
        done.add(slot.arrange)
        placed += occupancy.place_group(slot.arrange(kit), slot, kit, most - len(placed))
    others = [arrange for arrange in plan.others if arrange not in done]
    for k in kit.rng.permutation(len(others)):
        if len(placed) >= target:
            break
        placed += occupancy.place_group(others[k](kit), Slot(others[k]), kit, most - len(placed))
    return placed


class TableOccupancy:
    """A table top and its occupied areas.

    Args:
        table: The table.
    """

    def __init__(self, table: Tabletop) -> None:
        self._table = table
        width, depth = table.size_xy
        self._allowed = shapely.box(_EDGE, _EDGE, width - _EDGE, depth - _EDGE)
        self._occupied: list[shapely.Geometry] = []
        self._num_groups = 0
        if table.restricted_zone is not None:
            x_min, x_max, y_min, y_max = table.restricted_zone
            self._occupied.append(shapely.box(x_min, y_min, x_max, y_max))

    def reserve(self, outline: shapely.Geometry) -> None:
        """Marks an area as occupied."""
        self._occupied.append(outline)

    def allows(self, outline: shapely.Geometry) -> bool:
        """Whether an area lies on the table at a distance from its edges."""
        return bool(self._allowed.contains(outline))

    def is_free(self, outline: shapely.Geometry) -> bool:
        """Whether an area lies on the table at a distance from its edges and from all occupied areas."""
        return self.allows(outline) and not shapely.dwithin(outline, self._occupied, _MARGIN).any()

    def place_group(self, group: Group, slot: Slot, kit: GroupSampler, most: int) -> list[PlacedObject]:
        """Places a group within its slot and lowers it; returns no objects if there is no room or the group exceeds ``most``."""
        if not group or len(group) > most:
            return []
        width, depth = self._table.size_xy
        outline = shapely.union_all([item.outline() for item in group])
        (x_low, x_high), (y_low, y_high) = slot.x, slot.y
        # Only a slot that reaches the back can be restricted to it.
        if y_low < 0.6 and y_high > 0.85 and max(item.size[2] for item in group) > _TALL:
            y_low = 0.6
        for attempt in range(_TRIES):
            slack = 0.5 * max(0, attempt - _TRIES // 3) / _TRIES  # later attempts search a wider area
            x = width * kit.between(x_low - slack, x_high + slack)
            y = depth * kit.between(y_low - slack, y_high + slack)
            candidate = shapely.affinity.translate(shapely.affinity.rotate(outline, slot.yaw, (0, 0), use_radians=True), x, y)
            if self.is_free(candidate):
                self._occupied.append(candidate)
                self._num_groups += 1
                return lower_group([item.moved(x, y, slot.yaw) for item in group], self._num_groups)
        return []


def lower_group(group: Group, number: int = 0) -> list[PlacedObject]:
    """Lowers each item of a group until it almost touches what is below it."""
    placed: list[PlacedObject] = []
    for item in group:
        obj, outline = PlacedObject(item, 0.0, number), item.outline()
        below = [other for other in placed if outline.intersects(other.item.outline())]
        floor = float(obj.shape.size[2]) / 2 + _CLEARANCE
        z = floor if not below else max(floor, _lowest_height(obj, below, floor) + _CLEARANCE)
        placed.append(PlacedObject(item, z, number))
    return placed


def _lowest_height(obj: PlacedObject, below: Sequence[PlacedObject], floor: float) -> float:
    """The lowest height that an object reaches from above without contact, metres, to within 0.01 mm."""
    others = [_collider(other) for other in below]
    moving = _collider(obj)

    def touches(z: float) -> bool:
        moving.setTranslation(np.array([obj.item.x, obj.item.y, z]))
        return any(fcl.collide(moving, other, fcl.CollisionRequest(), fcl.CollisionResult()) > 0 for other in others)

    # Coarse steps down from above all supports, then a bisection of the last step.
    high = max(other.z + float(other.shape.size[2]) / 2 for other in below) + floor + _STEP
    while high > floor and not touches(high - _STEP):
        high -= _STEP
    low = high - _STEP
    while high - low > 1e-5:  # bisection between the last free and the first touching height
        middle = (low + high) / 2
        low, high = (middle, high) if touches(middle) else (low, middle)
    return high


def _collider(obj: PlacedObject) -> fcl.CollisionObject:
    tree = fcl.BVHModel()
    tree.beginModel(len(obj.shape.vertices), len(obj.shape.faces))
    tree.addSubModel(obj.shape.vertices, obj.shape.faces)
    tree.endModel()
    c, s = np.cos(obj.item.yaw), np.sin(obj.item.yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return fcl.CollisionObject(tree, fcl.Transform(turn, np.array([obj.item.x, obj.item.y, obj.z])))
