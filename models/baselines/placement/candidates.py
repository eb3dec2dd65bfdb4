"""Candidate poses of a box, which of them are free, and how well each meets the relations to the boxes that are placed.

Boxes turn in steps of 90 degrees, so they stay parallel to the table's edges.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from models.baselines.placement.problem import DIRECTIONS, Constraint, PlacementProblem, PlacementRelation
from stable_data.scene import FloatArray, SceneObject, Tabletop
from stable_data.scene_graph.relations import cell_of, facing_of, yawed_rectangle

YAWS = np.array([0.0, math.pi / 2, math.pi, -math.pi / 2])
"""The yaws of candidates, radians."""

_FLOOR = 5e-3  # thickness of the floor of a container of which only the box is known, metres,
_THIN = 0.1  # but at most this share of its height
_WALLS = 0.9  # share of a container's width and depth that its content may take
_SMALLEST_BASE = 0.25  # least area of a carrier, as a share of that of what stands on it
_GAP_ON_TABLE, _GAP_CARRIED = 1e-2, 2e-3  # least horizontal distance of boxes, metres
_TOUCH = 1e-6  # boxes that overlap less than this along z only touch, metres
_NEAR, _FAR = 0.10, 0.40  # "near" holds up to the first distance of boxes, and counts for nothing from the second on, metres
_LINE, _OFF_LINE = 0.013, 0.06  # the same for the offset of centres that are "aligned", metres
_WRONG_SECTOR = 0.3  # degree of a direction that is right along its axis, but beyond 45 degrees
_DIRECTION_OF = {facing_of(math.radians(45 * k)): math.radians(45 * k) for k in range(8)}


@dataclass(frozen=True, slots=True, eq=False)
class PlaceCandidates:
    """C poses of one box.

    Attributes:
        centre: Centres, (C, 3) float64, metres.
        half: Half extents along the axes of the table, (C, 3) float64, metres.
        yaw: Yaws, (C,) float64, radians.
    """

    centre: FloatArray
    half: FloatArray
    yaw: FloatArray

    @classmethod
    def of(cls, size: Sequence[float], points: FloatArray, bottom: float) -> "PlaceCandidates":
        """Returns the poses of a box of a size at points (P, 2), metres, at all yaws, with its underside at a height."""
        width, depth, height = (s / 2 for s in size)
        turned = np.array([[width, depth, height], [depth, width, height]])
        half = np.tile(turned[[0, 1, 0, 1]], (len(points), 1))
        centre = np.column_stack([np.repeat(points, len(YAWS), axis=0), np.full(len(half), bottom + height)])
        return cls(centre, half, np.tile(YAWS, len(points)))

    @classmethod
    def at(cls, o: SceneObject) -> "PlaceCandidates":
        """Returns the one pose of an object that is placed; if it is turned otherwise, the box around it."""
        corners = yawed_rectangle(o)
        low, high = corners.min(axis=0), corners.max(axis=0)
        centre = np.array([[*(low + high) / 2, o.position[2]]])
        return cls(centre, np.array([[*(high - low) / 2, o.size[2] / 2]]), np.array([o.yaw]))

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.yaw)

    def take(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> "PlaceCandidates":
        """Returns some of the poses, by mask or index."""
        return PlaceCandidates(self.centre[rows], self.half[rows], self.yaw[rows])

    def placed(self, k: int, o: SceneObject, support: str) -> SceneObject:
        """Returns an object at one of the poses."""
        x, y, z = self.centre[k].tolist()
        return replace(o.moved((x, y, z), float(self.yaw[k])), support=support)


def candidates_of(
    o: SceneObject, problem: PlacementProblem, placed: Mapping[str, SceneObject], points: FloatArray, shares: FloatArray
) -> PlaceCandidates:
    """Returns the free poses of an object: on the table, or on or in the object that carries it.

    Args:
        o: The object.
        problem: The problem.
        placed: The objects that have a place, by instance; the carrier of ``o`` among them.
        points: Points of the table, (P, 2), metres.
        shares: Points of a carrier, (P, 2), from -1 to 1 across the room that the object has on it.
    """
    link = problem.carriers.get(o.instance)
    if link is None:
        found = _on_table(PlaceCandidates.of(o.size, points, 0.0), problem.table)
        return found.take(is_free(found, [*problem.obstacles, *placed.values()], _GAP_ON_TABLE))
    carrier = placed[link.target]
    found = _carried(o, carrier, shares, is_inside=link.kind is PlacementRelation.IN)
    found = _on_table(found, problem.table)
    below = problem.below(o.instance)  # the boxes of containers contain that of the object
    others = [other for other in placed.values() if other.instance not in below]
    return found.take(is_free(found, [*problem.obstacles, *others], _GAP_CARRIED))


def floor_of(container: SceneObject) -> float:
    """Returns the height on which the content of a container stands, metres, of which only the box is known."""
    return container.bottom + min(_FLOOR, _THIN * container.size[2])


def is_free(candidates: PlaceCandidates, others: Sequence[SceneObject], gap: float) -> npt.NDArray[np.bool_]:
    """Returns which poses keep a gap, metres, from the boxes of other objects, (C,) bool; boxes above one another may touch."""
    free = np.ones(len(candidates), np.bool_)
    for other in others:
        box = PlaceCandidates.at(other)
        apart = np.abs(candidates.centre - box.centre) - candidates.half - box.half
        free &= (apart[:, :2] >= gap - _TOUCH).any(axis=1) | (apart[:, 2] >= -_TOUCH)
    return free


def _on_table(candidates: PlaceCandidates, table: Tabletop) -> PlaceCandidates:
    """The poses whose box is over the table, outside the restricted zone, and below what is above the table."""
    low, high = candidates.centre - candidates.half, candidates.centre + candidates.half
    inside = [low[:, :2].min(axis=1) >= -_TOUCH, (high[:, :2] - np.array(table.size_xy)).max(axis=1) <= _TOUCH]
    if table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = table.restricted_zone
        inside.append((high[:, 0] <= x_min) | (low[:, 0] >= x_max) | (high[:, 1] <= y_min) | (low[:, 1] >= y_max))
    if table.clearance is not None:
        inside.append(high[:, 2] <= table.clearance)
    return candidates.take(np.logical_and.reduce(inside))


def _carried(o: SceneObject, carrier: SceneObject, shares: FloatArray, *, is_inside: bool) -> PlaceCandidates:
    """The poses of an object on or in another one; none if it is too large for that."""
    base = PlaceCandidates.at(carrier)
    bottom = floor_of(carrier) if is_inside else carrier.top
    found = PlaceCandidates.of(o.size, shares, bottom)
    room = (_WALLS if is_inside else 1.0) * base.half[:, :2] - found.half[:, :2]
    found.centre[:, :2] = base.centre[:, :2] + found.centre[:, :2] * np.maximum(room, 0.0)
    if is_inside:
        return found.take(room.min(axis=1) >= 0)
    # What is larger than its base stands in its middle.
    return found.take(base.half[:, :2].prod() >= _SMALLEST_BASE * found.half[:, :2].prod(axis=1))


def degrees(
    name: str, candidates: PlaceCandidates, problem: PlacementProblem, placed: Mapping[str, SceneObject]
) -> list[tuple[Constraint, FloatArray]]:
    """Returns how well poses of an object meet each of its relations to what is placed.

    Args:
        name: The object.
        candidates: Its poses.
        problem: The problem.
        placed: The objects that have a place, by instance.

    Returns:
        Each relation except ``on`` and ``in``, which all poses meet, with its degrees, (C,) float64, from 0 to 1; it holds at 1.
    """
    found = []
    for c in problem.constraints:
        if name not in c.members or c.kind in (PlacementRelation.ON, PlacementRelation.IN):
            continue
        if c.kind is PlacementRelation.FACE_TO:
            found.append((c, _degree_of_angle(candidates.yaw - _DIRECTION_OF[c.target])))
        elif c.kind is PlacementRelation.IS_AT:
            found.append((c, _degree_of_cell(candidates, c.target, problem.table)))
        elif c.target in placed or c.subject in placed:
            subject = candidates if c.subject == name else PlaceCandidates.at(placed[c.subject])
            target = candidates if c.target == name else PlaceCandidates.at(placed[c.target])
            found.append((c, np.broadcast_to(_degree(c.kind, subject, target), len(candidates))))
    return found


def broken_constraints(problem: PlacementProblem, placed: Mapping[str, SceneObject]) -> tuple[Constraint, ...]:
    """Returns the relations between placed objects that do not hold."""
    broken = []
    for name, o in placed.items():
        of_subject = [c for c in problem.constraints if c.subject == name and set(c.members) <= placed.keys()]
        own = replace(problem, constraints=tuple(of_subject))
        broken += [c for c, degree in degrees(name, PlaceCandidates.at(o), own, placed) if not holds(degree)[0]]
    return tuple(c for c in problem.constraints if c in broken)


def holds(degree: FloatArray) -> npt.NDArray[np.bool_]:
    """Returns where a relation of these degrees holds."""
    return degree >= 1.0 - 1e-9


def _degree(kind: PlacementRelation, subject: PlaceCandidates, target: PlaceCandidates) -> FloatArray:
    apart = subject.centre[:, :2] - target.centre[:, :2]
    if kind in DIRECTIONS:
        axis, sign = DIRECTIONS[kind]
        is_on_side = sign * apart[:, axis] > 0
        is_in_sector = np.abs(apart[:, axis]) > np.abs(apart[:, 1 - axis])
        return np.where(is_on_side, np.where(is_in_sector, 1.0, _WRONG_SECTOR), 0.0)
    if kind is PlacementRelation.NEAR:
        gap = (np.abs(apart) - subject.half[:, :2] - target.half[:, :2]).max(axis=1)
        return _falling(gap, _NEAR, _FAR)
    if kind is PlacementRelation.ALIGNED_WITH:
        return _falling(np.abs(apart).min(axis=1), _LINE, _OFF_LINE)
    assert kind is PlacementRelation.FACING
    return _degree_of_angle(subject.yaw - np.arctan2(-apart[:, 0], apart[:, 1]))  # an object at yaw t faces (sin t, -cos t)


def _falling(value: FloatArray, full: float, none: float) -> FloatArray:
    """1 up to a value, 0 from another one on, linear between them."""
    return np.clip((none - value) / (none - full), 0.0, 1.0)


def _degree_of_angle(difference: FloatArray) -> FloatArray:
    """1 up to 45 degrees, 0 from 135 degrees on."""
    angle = np.abs(np.remainder(difference + math.pi, math.tau) - math.pi)
    return _falling(angle, math.pi / 4 + 1e-6, 0.75 * math.pi)


def _degree_of_cell(candidates: PlaceCandidates, cell: str, table: Tabletop) -> FloatArray:
    """A half for the row of the cell, and a half for its column."""
    row, column = cell.split("_")
    cells = [cell_of(tuple(xy), table.size_xy).split("_") for xy in candidates.centre[:, :2].tolist()]
    return np.array([0.5 * (own_row == row) + 0.5 * (own_column == column) for own_row, own_column in cells])


def why_dropped(name: str, problem: PlacementProblem, placed: Mapping[str, SceneObject]) -> str:
    """Returns why an object has no place, one line."""
    link = problem.carriers.get(name)
    if link is None:
        return "there is no free place on the table"
    return f"there is no room {link.kind} {link.target}" if link.target in placed else f"{link.target} has no place"
