"""Finds poses where a step of a goal can put an object down, best first: free spots that fulfil the conditions of the step."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely

from stable_data.condition import GROUP_KINDS, SIDE_KINDS, ConditionKind, GoalCondition
from stable_data.errors import GoalError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.surface_sampling import sample_surface
from stable_data.rotations import heading, quat_product, rotation_matrix, tilt_angle, yaw_quat
from stable_data.scene import TABLE, FloatArray, QuatXyzw, Vec3
from stable_data.scene_graph.support_tree import ancestors
from stable_data.tasks.checking import (
    APART,
    BESIDE,
    LEAST_MOVE,
    LIFT,
    SIDE_NAMES,
    ConditionPredicates,
    SceneState,
    StateView,
    yaw_facing,
)
from stable_data.tasks.geometry import TaskGeometry, outline_of
from stable_data.tasks.goal import Step, StepAction
from stable_data.tasks.regions import DIRECTIONS, EDGES, REGIONS, region_bounds

K = ConditionKind

CLEARANCE = 0.015
"""Least distance of a placed object to the others, metres."""

ROOMY = 0.05
"""Distance to the others up to which more is better: fingers open there, metres."""

RELEASE = 0.01
"""Height above the place of rest at which an object is released, metres; in a container, above the rim."""

_STEP = 0.02  # of the grid on the table, metres
_FINE_STEP = 0.01  # of the grid on an object, metres
_CARRIED = 0.10  # height of the lowest point of a carried object above the table, metres
_CARRY_STEP = 0.08  # of the grid over which objects are carried, metres
_SIDE_GAP = 0.03  # preferred distance to an object beside which another one is put, metres
_MOST_TRIED = 200  # poses that are checked exactly
_ROW_GAP = 0.04  # metres between members of a row
_SHIFTED = 0.05  # an object that is nearer to its place at the start was not put elsewhere, metres
_OVERHANG = 0.15  # largest share of the outline of an object that may reach over the outline of its container
_SURFACE_POINTS = 20_000
_SHEET = 5e-4  # metres above a surface: contact within rounding


@dataclass(frozen=True, slots=True)
class TargetPose:
    """A pose for an object that is put down.

    Attributes:
        position: The point of the body that was the centre of its box at the start, at rest, metres, world frame.
        quat_xyzw: Rotation of the body from its yaw frame at yaw 0.
        yaw: Heading of that rotation, radians.
        release_height: z of ``position`` at which the object is let go, metres: a little above its place; in a container, with its
            lowest point above the rim.
        support: What it rests on: an instance or ``table``; None: it stays in the hand, in the air.
    """

    position: Vec3
    quat_xyzw: QuatXyzw
    yaw: float
    release_height: float
    support: str | None


def target_poses(step: Step, geometry: TaskGeometry, state: SceneState, count: int = 8) -> tuple[TargetPose, ...]:
    """Finds poses for the object of a step, best first; each fulfils the conditions of the step when the object rests or is held there.

    Args:
        step: The step; one without conditions asks for a free spot on the table.
        geometry: The scene at the start and its geometry.
        state: The state from which the object is moved. It may be held.
        count: Most poses.

    Returns:
        At least one pose. Rest heights come from the surfaces below; an object may settle otherwise, above all in a container.

    Raises:
        GoalError: No free place fulfils the conditions (``no_free_place``).
    """
    search = _Search(step, geometry, state)
    found: list[TargetPose] = []
    for tried, pose in enumerate(search.candidates()):
        if tried >= _MOST_TRIED or len(found) >= count:
            break
        if search.is_right(pose):
            found.append(pose)
    if not found:
        words = "; ".join(map(str, step.conditions)) or "a free spot on the table"
        raise GoalError(
            f"{geometry.scene.scene_id}: no free place for {step.subject} with {words!r}, expected one; leave the task out",
            "no_free_place",
        )
    return tuple(found)


def placed_state(geometry: TaskGeometry, state: SceneState, subject: str, pose: TargetPose) -> SceneState:
    """Returns the state after an object, with all that it carries, was put down at a pose and released, or is held there.

    Args:
        geometry: The scene at the start and its geometry.
        state: The state before.
        subject: The object.
        pose: Its pose.
    """
    rows = geometry.rows
    row = rows[subject]
    positions, quats = state.positions.copy(), state.quats_xyzw.copy()
    x, y, z, w = quats[row].tolist()
    turn = quat_product(pose.quat_xyzw, (-x, -y, -z, w))
    matrix, pivot = rotation_matrix(turn), state.positions[row]
    for name in carried_by(state, subject):
        k = rows[name]
        positions[k] = matrix @ (positions[k] - pivot) + np.array(pose.position)
        i, j, l, m = quats[k].tolist()  # noqa: E741
        quats[k] = quat_product(turn, (i, j, l, m))
    positions[row], quats[row] = pose.position, pose.quat_xyzw
    touching = {**state.touching, subject: () if pose.support is None else (pose.support,)}
    moved = frozenset({subject})
    return replace(
        state,
        positions=positions,
        quats_xyzw=quats,
        touching=touching,
        held=state.held | moved if pose.support is None else state.held - moved,
        grasped=state.grasped - moved,
    )


def carried_by(state: SceneState, name: str) -> list[str]:
    """The objects that rest on or in an object, directly or through others."""
    first = {child: (below[0] if below else None) for child, below in state.touching.items()}
    return [child for child in first if child != name and name in ancestors({**first, name: None}, child)]


class _Search:
    """The search for poses of one step."""

    def __init__(self, step: Step, geometry: TaskGeometry, state: SceneState) -> None:
        self.step, self.geometry, self.name = step, geometry, step.subject
        self.row = geometry.rows[step.subject]
        self.carried = carried_by(state, step.subject)
        released = frozenset({step.subject})
        self.state = replace(state, held=state.held - released, grasped=state.grasped - released)
        self.predicates = ConditionPredicates(geometry)
        self.view = StateView(geometry, self.state)
        self.wanted = [c for c in step.conditions if not c.is_negated]
        self.size = geometry.scene.table.size_xy
        self.quats = self._rotations()
        self.base = self._base()

    def is_right(self, pose: TargetPose) -> bool:
        """Whether the conditions of the step hold at a pose; of groups, only what one object can fulfil."""
        after = StateView(self.geometry, placed_state(self.geometry, self.state, self.name, pose))
        return all(self.predicates.holds(c, after) for c in self.step.conditions if c.kind not in GROUP_KINDS)

    def candidates(self) -> Iterator[TargetPose]:
        """Poses that are free, best first."""
        for quat in self.quats:
            posed = self.geometry.posed(self.row, np.zeros(3), quat)
            outline = posed.points
            spots, cost = self._spots(outline, quat)
            if not len(spots):
                continue
            for k in np.argsort(cost, kind="stable")[:_MOST_TRIED]:
                yield self._pose(spots[k], quat, outline, posed.item.bottom)

    # --- rotations ---

    def _rotations(self) -> list[QuatXyzw]:
        """Rotations to try, the best first; an object that lies stays as it lies, unless it shall stand upright."""
        x, y, z, w = self.view.state.quats_xyzw[self.row].tolist()
        current: QuatXyzw = (x, y, z, w)
        if any(c.kind is K.UPRIGHT for c in self.wanted):
            yaw, _ = heading(current)
            return [self.geometry.upright_quat(self.row, yaw + turn) for turn in (0.0, math.pi / 2)]
        if tilt_angle(current) < math.radians(10):  # a held object may hang a little aslant; put down, it stands as it stood
            current = yaw_quat(heading(current)[0])
        facing = next((c for c in self.wanted if c.kind is K.FACING), None)
        if facing is not None:
            yaw, _ = heading(current)
            return [quat_product(yaw_quat(self._yaw_for(facing) - yaw), current)]
        around = [current, quat_product(yaw_quat(math.pi / 2), current)]
        if any(c.kind in GROUP_KINDS for c in self.wanted):  # an arrangement has room for the members as they stood
            first, _ = heading(tuple(self.predicates.start.quats_xyzw[self.row].tolist()))
            around.insert(0, quat_product(yaw_quat(first - heading(current)[0]), current))
        return [*around, self._on_end(current)] if any(c.kind is K.IN for c in self.wanted) else around

    def _on_end(self, quat: QuatXyzw) -> QuatXyzw:
        """A rotation that stands a long object on its end, as a pen in a pen holder."""
        yaw, _ = heading(quat)
        length, width, _ = self.geometry.posed(self.row, np.zeros(3), quat).item.size
        half = math.sqrt(0.5)
        lift: QuatXyzw = (0.0, half, 0.0, half) if length >= width else (half, 0.0, 0.0, half)
        return quat_product(yaw_quat(yaw), quat_product(lift, quat_product(yaw_quat(-yaw), quat)))

    def _yaw_for(self, facing: GoalCondition) -> float:
        if facing.target in self.geometry.rows:
            step = np.subtract(self.view.item(facing.target).position, self.view.item(self.name).position)
            return math.atan2(step[1], step[0]) + math.pi / 2
        return yaw_facing(facing.target)

    def _base(self) -> str:
        """What the object is put on or in: an instance or ``table``."""
        return next((c.target for c in self.wanted if c.kind in (K.ON, K.IN)), TABLE)

    # --- spots ---

    def _spots(self, outline: FloatArray, quat: QuatXyzw) -> tuple[FloatArray, FloatArray]:
        """Positions of the body on the plane that are free, (M, 2), and their costs, (M,), metres."""
        group = next((c for c in self.wanted if c.kind in GROUP_KINDS), None)
        if group is not None:
            spots = self._spots_of_group(group, outline)
        elif self.base != TABLE:
            spots = self._spots_on_object(outline)
        elif self._is_carried:
            # In the air, a few spots far from each other offer more than many near each other.
            low, high = -outline.min(axis=0), np.array(self.size) - outline.max(axis=0)
            spots = _grid(np.array([low, high]), _CARRY_STEP)
        elif self._stays():
            here = self.view.state.positions[self.row, :2]
            offsets = _grid(np.array([[-0.1, -0.1], [0.1, 0.1]]), _STEP)
            spots = here + np.concatenate([np.zeros((1, 2)), offsets])
        else:
            low, high = -outline.min(axis=0), np.array(self.size) - outline.max(axis=0)
            if (high < low).any():
                return np.zeros((0, 2)), np.zeros(0)
            spots = np.concatenate([self._preferred(outline), _grid(np.array([low, high]), _STEP)])
            spots = spots[((spots >= low) & (spots <= high)).all(axis=1)]
        clearance = self._clearance(spots, outline)
        is_free = clearance >= (CLEARANCE if self.base == TABLE else 0.0)
        if self.base == TABLE and (
            self._stays() or any(c.kind is K.MOVED or c.target in self.geometry.rows for c in self.wanted)
        ):
            # On the spot, along a stated way, or at a stated object, there may be no more room than is needed.
            is_free = clearance > 0
        spots, clearance = spots[is_free], clearance[is_free]
        cost = self._cost(spots, outline) + 2 * np.maximum(0.0, ROOMY - clearance)
        return spots, cost

    def _stays(self) -> bool:
        """Whether the object stays where it is: it is only turned or set upright."""
        return bool(self.wanted) and all(c.kind in (K.FACING, K.UPRIGHT) for c in self.wanted)

    def _preferred(self, outline: FloatArray) -> FloatArray:
        """Spots off the grid: close beside an object, in the middle between two, where another one was, a stated distance away."""
        found = []
        half = np.ptp(outline, axis=0) / 2
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        for c in self.wanted:
            if c.kind is K.AT and c.target in self.geometry.rows:
                found.append(np.array(self.predicates.first.item(c.target).position[:2]))
            elif c.kind is K.MOVED:
                axis, sign = DIRECTIONS[c.target]
                spot = self.predicates.start.positions[self.row, :2].copy()
                spot[axis] += sign * (c.distance or 2 * LEAST_MOVE)
                found.append(spot)
            elif c.kind is K.BETWEEN:
                found.append(np.mean([self.view.item(name).position[:2] for name in c.targets], axis=0) - middle)
            elif c.kind in SIDE_KINDS or c.kind is K.BESIDE:
                points = self.view.posed(c.target).points
                centre = (points.max(axis=0) + points.min(axis=0)) / 2
                for direction in (SIDE_NAMES[c.kind],) if c.kind in SIDE_KINDS else DIRECTIONS:
                    axis, sign = DIRECTIONS[direction]
                    spot = centre.copy()
                    spot[axis] += sign * (np.ptp(points, axis=0)[axis] / 2 + half[axis] + _SIDE_GAP)
                    found.append(spot - middle)
        return np.array(found).reshape(-1, 2)

    def _spots_on_object(self, outline: FloatArray) -> FloatArray:
        points = self.view.posed(self.base).points
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        centre = np.array(self.view.item(self.base).position[:2])
        area = np.array([points.min(axis=0), points.max(axis=0)])
        spots = np.concatenate([centre[None], _grid(area, _FINE_STEP)])
        is_inside = shapely.contains_xy(self.view.outline(self.base), spots[:, 0], spots[:, 1])
        return np.asarray(spots[is_inside] - middle)

    def _clearance(self, spots: FloatArray, outline: FloatArray) -> FloatArray:
        """Distance of the object at each spot to the nearest obstacle, (M,), metres; below 0 where it has no place."""
        placed = _placed(outline, spots)
        low, high = spots + outline.min(axis=0), spots + outline.max(axis=0)
        nearest = np.full(len(spots), np.inf)
        for obstacle in self._obstacles():
            x_min, y_min, x_max, y_max = shapely.bounds(obstacle)
            apart = np.maximum(np.maximum((x_min, y_min) - high, low - (x_max, y_max)), 0.0)
            is_near = np.hypot(*apart.T) < ROOMY  # farther away, more distance is no better
            nearest[is_near] = np.minimum(nearest[is_near], shapely.distance(placed[is_near], obstacle))
        zone = self.geometry.scene.table.restricted_zone
        if self.base == TABLE:
            if zone is not None:
                nearest = np.minimum(nearest, shapely.distance(placed, shapely.box(zone[0], zone[2], zone[1], zone[3])))
            outside = (low < -1e-9).any(axis=1) | (high > np.array(self.size) + 1e-9).any(axis=1)
            nearest[outside] = -1.0
        elif self._is_into():
            # The object goes through the opening: its outline should lie within that of the container.
            around = self.view.outline(self.base)
            over = shapely.area(shapely.difference(placed, around)) / np.maximum(shapely.area(placed), 1e-12)
            nearest = np.where(over > _OVERHANG, -1.0, nearest)
        else:
            nearest[nearest <= 1e-9] = -1.0  # the place on the object is taken
        return nearest

    @property
    def _is_carried(self) -> bool:
        """Whether the object stays in the hand."""
        return self.step.action is StepAction.CARRY

    def _is_into(self) -> bool:
        """Whether the object goes into a container."""
        return any(c.kind is K.IN for c in self.wanted) or (
            self.base != TABLE and self.geometry.containers.get(self.base) is True
        )

    def _obstacles(self) -> list[shapely.Geometry]:
        """Outlines of the objects that are in the way of what is put down."""
        skipped = {self.name, *self.carried}
        if self.base != TABLE:
            first = {child: (below[0] if below else None) for child, below in self.state.touching.items()}
            skipped |= {self.base, *ancestors(first, self.base)}
            low = self.view.item(self.base).top - 0.01
            if self._is_into():  # contents may touch
                skipped.update(carried_by(self.state, self.base))
        else:
            low = self._carry_height - CLEARANCE if self._is_carried else 0.0
        others = (name for name in self.geometry.rows if name not in skipped)
        found = [
            self.view.outline(name) for name in others if not self.view.has_fallen(name) and self.view.item(name).top > low
        ]
        if not self.step.conditions:  # a spot for a while, away from the place that another object will take
            found.append(shapely.buffer(self.predicates.first.outline(self.name), 2 * ROOMY))
        return found

    def _cost(self, spots: FloatArray, outline: FloatArray) -> FloatArray:
        """How much worse than the best a spot is, (M,), metres."""
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        centres = spots + middle
        if self.base != TABLE:
            own = np.linalg.norm(centres - self.view.item(self.base).position[:2], axis=1)
            return np.asarray(own + self._crowding(centres))
        cost = np.zeros(len(spots))
        for c in self.wanted:
            cost += self._cost_of(c, spots, centres, outline)
        # The shortest way decides between equals; what shall leave a region or make room has a short way too.
        way = np.linalg.norm(centres - self.view.item(self.name).position[:2], axis=1)
        is_asked = any(c.kind is not K.ON for c in self.wanted)
        return np.asarray(cost + (0.02 if is_asked else 0.2) * way + self._leaving(centres))

    def _crowding(self, centres: FloatArray) -> FloatArray:
        """Cost of spots over the contents of the container."""
        cost = np.zeros(len(centres))
        for name in carried_by(self.state, self.base):
            if name != self.name and name not in self.carried:
                item = self.view.item(name)
                near = np.linalg.norm(centres - item.position[:2], axis=1)
                cost += np.maximum(0.0, max(item.size[:2]) - near)
        return cost

    def _leaving(self, centres: FloatArray) -> FloatArray:
        """Cost of spots in a region that the object shall leave."""
        cost = np.zeros(len(centres))
        for c in self.step.conditions:
            if c.is_negated and c.kind is K.AT and c.target in REGIONS and c.target not in EDGES:
                low, high = region_bounds(c.target, self.size)
                cost += 10.0 * ((centres >= low) & (centres < high)).all(axis=1)
        return cost

    def _cost_of(self, c: GoalCondition, spots: FloatArray, centres: FloatArray, outline: FloatArray) -> FloatArray:
        zeros = np.zeros(len(spots))
        if c.kind in (K.AT, K.HELD) and c.target in EDGES:
            axis, sign = DIRECTIONS[c.target.removesuffix("_edge")]
            margin = (
                spots[:, axis] + outline[:, axis].min()
                if sign < 0
                else self.size[axis] - spots[:, axis] - outline[:, axis].max()
            )
            return np.asarray(np.abs(margin - 0.05))
        if c.kind in (K.AT, K.HELD) and c.target in REGIONS:
            low, high = region_bounds(c.target, self.size)
            outside = np.maximum(0.0, np.maximum(low + _STEP - centres, centres - high + _STEP))
            return np.asarray(5.0 * np.hypot(*outside.T) + 0.1 * np.linalg.norm(centres - (low + high) / 2, axis=1))
        if c.kind is K.AT:
            return np.asarray(5.0 * np.linalg.norm(centres - self.predicates.first.item(c.target).position[:2], axis=1))
        if c.kind in SIDE_KINDS:
            axis, sign = DIRECTIONS[SIDE_NAMES[c.kind]]
            step = centres - self.view.item(c.target).position[:2]
            along, across = sign * step[:, axis], np.abs(step[:, 1 - axis])
            return np.asarray(10.0 * (along <= across) + across + 0.5 * np.maximum(0.0, self._gaps(c.target, spots, outline)))
        if c.kind is K.BESIDE:
            gap = self._gaps(c.target, spots, outline)
            return np.asarray(np.abs(gap - _SIDE_GAP) + 10.0 * (gap > 0.8 * BESIDE))
        if c.kind is K.BETWEEN:
            middle = np.mean([self.view.item(name).position[:2] for name in c.targets], axis=0)
            return np.asarray(np.linalg.norm(centres - middle, axis=1))
        if c.kind is K.APART and c.target in EDGES:
            axis, sign = DIRECTIONS[c.target.removesuffix("_edge")]
            margin = (
                spots[:, axis] + outline[:, axis].min()
                if sign < 0
                else self.size[axis] - spots[:, axis] - outline[:, axis].max()
            )
            return np.asarray(10.0 * np.maximum(0.0, 1.2 * (c.distance or APART) - margin))
        if c.kind is K.APART:
            return np.asarray(10.0 * np.maximum(0.0, 1.2 * (c.distance or APART) - self._gaps(c.target, spots, outline)))
        if c.kind is K.MOVED:
            axis, sign = DIRECTIONS[c.target]
            step = spots - self.predicates.start.positions[self.row, :2]
            off = np.abs(sign * step[:, axis] - (c.distance or 2 * LEAST_MOVE)) + np.abs(step[:, 1 - axis])
            return np.asarray(5.0 * off)
        return zeros

    def _gaps(self, name: str, spots: FloatArray, outline: FloatArray) -> FloatArray:
        return np.asarray(shapely.distance(_placed(outline, spots), self.view.outline(name)))

    # --- groups ---

    def _spots_of_group(self, c: GoalCondition, outline: FloatArray) -> FloatArray:
        """Spots for one member of a group, the best first, as part of an arrangement of all that depends on the start alone."""
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        if c.kind is K.EVEN:
            names = sorted(c.subjects, key=lambda n: self.predicates.first.item(n).position[0])
            low, high = (self.predicates.first.item(names[k]).position[0] for k in (0, -1))
            x = low + (high - low) * names.index(self.name) / (len(names) - 1)
            y = self.predicates.first.item(self.name).position[1]
            return np.asarray(np.array([(x, y + dy) for dy in (0.0, *_around(0.3))]) - middle)
        if c.kind is K.TOGETHER:
            return self._spots_together(c, outline)
        return np.asarray(self._spots_in_row(c) - middle)

    def _spots_together(self, c: GoalCondition, outline: FloatArray) -> FloatArray:
        """Spots close to the members that are together already; the first member stays where it is."""
        here = self.view.state.positions[self.row, :2]
        before = c.subjects[: c.subjects.index(self.name)]
        if not before:
            return here[None]
        low, high = -outline.min(axis=0), np.array(self.size) - outline.max(axis=0)
        spots = _grid(np.array([low, high]), _STEP)
        gaps = np.min([self._gaps(name, spots, outline) for name in before], axis=0)
        spots, gaps = spots[(gaps > CLEARANCE) & (gaps <= 0.045)], gaps[(gaps > CLEARANCE) & (gaps <= 0.045)]
        return np.asarray(spots[np.argsort(gaps, kind="stable")])

    def _spots_in_row(self, c: GoalCondition) -> FloatArray:
        """The centre of one member in a row that is free of all other objects, (M, 2); empty if there is no such row.

        A row along x is preferred to one along y, which has no order from left to right.
        """
        order = next((other.subjects for other in self.wanted if other.kind is K.ORDERED), None)
        for axis in (0, 1) if order is None else (0,):
            found = self._row_along(axis, order or c.subjects)
            if len(found):
                return found
        return np.zeros((0, 2))

    def _row_along(self, axis: int, ordered: Sequence[str]) -> FloatArray:
        first = self.predicates.first
        sizes = np.array([np.ptp(first.posed(n).points, axis=0) for n in ordered])
        starts = np.cumsum([0.0, *(sizes[:, axis] + _ROW_GAP)])
        centres = starts[:-1] + sizes[:, axis] / 2
        length, half = float(starts[-1] - _ROW_GAP), float(sizes[:, 1 - axis].max()) / 2
        # Other objects are where they were, unless they were put elsewhere, so that a second row leaves out the first one: what the
        # hand only shifts a little does not move the row.
        others = [
            (self.view if self._was_put_elsewhere(n) else first).outline(n) for n in self.geometry.rows if n not in ordered
        ]
        zone = self.geometry.scene.table.restricted_zone
        others += [] if zone is None else [shapely.box(zone[0], zone[2], zone[1], zone[3])]
        high = np.array(self.size) - CLEARANCE  # from the edge, because a member may be turned a little
        high[axis] -= length
        high[1 - axis] -= half
        low = np.full(2, CLEARANCE)
        low[1 - axis] += half
        corners = _grid(np.array([low, high]), _STEP)
        if not len(corners):
            return corners
        reach = np.full(2, half)
        reach[axis] = 0.0
        far = reach.copy()
        far[axis] = length
        rows = shapely.box(*(corners - reach).T, *(corners + far).T)
        nearest = np.full(len(rows), np.inf)
        for obstacle in others:
            nearest = np.minimum(nearest, shapely.distance(rows, obstacle))
        # Rows over places where members stand come last: these could have to be moved twice.
        taken = np.zeros(len(rows))
        for n in ordered:
            taken += shapely.distance(rows, first.outline(n)) < CLEARANCE
        cost = 10.0 * taken + corners[:, 1] - 10.0 * np.minimum(nearest, ROOMY) + np.where(nearest >= CLEARANCE, 0.0, np.inf)
        if not np.isfinite(cost.min()):
            return np.zeros((0, 2))
        spot = corners[int(cost.argmin())]
        spot[axis] += centres[list(ordered).index(self.name)]
        return np.asarray(spot[None])

    def _was_put_elsewhere(self, name: str) -> bool:
        row = self.geometry.rows[name]
        return bool(np.linalg.norm(self.state.positions[row] - self.predicates.start.positions[row]) > _SHIFTED)

    # --- heights ---

    def _pose(self, spot: FloatArray, quat: QuatXyzw, outline: FloatArray, bottom: float) -> TargetPose:
        """The pose at a spot: the lowest point rests on the surface below it; that of a carried object is in the air."""
        yaw, _ = heading(quat)
        if self._is_carried:
            z = self._carry_height - bottom
            return TargetPose((float(spot[0]), float(spot[1]), z), quat, yaw, z, None)
        height = 0.0 if self.base == TABLE else self._surface_height(spot, outline)
        z = height - bottom
        over = z + RELEASE
        if self._is_into():
            over = max(over, self.view.item(self.base).top + RELEASE - bottom)
        return TargetPose((float(spot[0]), float(spot[1]), z), quat, yaw, over, self.base)

    @property
    def _carry_height(self) -> float:
        """Height of the lowest point of a carried object, at which it counts as lifted, metres."""
        return max(_CARRIED, self.predicates.first.item(self.name).bottom + 2 * LIFT)

    def _surface_height(self, spot: FloatArray, outline: FloatArray) -> float:
        """The highest point of the base below an object at a spot, metres; of a container, within reach of its opening."""
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        share = 0.7 if self._is_into() else 0.95  # what is farther out may lean on a wall
        below = outline_of(spot + middle + share * (outline - middle))
        points, top = self._surface, self.view.item(self.base).top
        low, high = shapely.bounds(below).reshape(2, 2)
        points = points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]
        heights = points[shapely.contains_xy(below, points[:, 0], points[:, 1]), 2]
        if self._is_into():
            # Points of the wall and rim are where the object leans, not what carries it.
            floor = heights[heights < top - 0.2 * (top - self.view.item(self.base).bottom)]
            heights = floor if len(floor) else heights
        return float(heights.max()) + _SHEET if len(heights) else top

    @cached_property
    def _surface(self) -> FloatArray:
        """Points on the surface of the base, (P, 3) float64, metres, world frame."""
        row = self.geometry.rows[self.base]
        x, y, z, w = self.state.quats_xyzw[row].tolist()
        shape = self.geometry.shapes[row]
        points = sample_surface(Mesh(shape.vertices, shape.faces), _SURFACE_POINTS)
        return np.asarray(points @ rotation_matrix((x, y, z, w)).T + self.state.positions[row])


def _placed(outline: FloatArray, spots: FloatArray) -> FloatArray:
    """The convex outline of points (P, 2) moved to each spot (M, 2), as (M,) polygons."""
    hull = shapely.get_coordinates(outline_of(outline))
    return np.asarray(shapely.polygons(hull[None] + spots[:, None]) if len(hull) >= 4 else shapely.points(spots))


def _grid(area: FloatArray, step: float) -> FloatArray:
    """Points of a grid within an area (low, high), (M, 2) float64, metres."""
    x, y = (np.arange(area[0, k], area[1, k] + 1e-9, step) for k in (0, 1))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _around(most: float) -> Sequence[float]:
    """Distances of both signs, small ones first, metres."""
    steps = np.arange(_STEP, most, _STEP)
    return [float(v) for pair in zip(steps, -steps, strict=True) for v in pair]
