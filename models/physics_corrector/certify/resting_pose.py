"""Finds an exact resting pose of an object in or on its carrier: the present one, else the nearest one that is found."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.ops import nearest_points

from models.physics_corrector.certify import constants
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.static_stability import centre_of_mass, stands_alone, steadiness
from models.physics_corrector.certify.support_inference import SupportEdge, distance_outside
from stable_data.geometry.leaning import RIM_MARGIN
from stable_data.metrics.verdicts import TOLERANCE
from stable_data.scene import FloatArray
from stable_data.scene_graph.relations import INSIDE_SLACK

_ANGLES = 2 * np.pi * np.arange(constants.SLIDE_DIRECTIONS) / constants.SLIDE_DIRECTIONS
_WAYS = np.array([[np.cos(a), np.sin(a)] for a in _ANGLES])


def is_at_rest(meshes: MeshQueries, poses: FloatArray, k: int, pose: FloatArray, others: Sequence[int]) -> bool:
    """Whether an object at a pose (4,) penetrates no other object, and another object or the table carries it."""
    near = meshes.near(k, pose, others, poses, TOLERANCE)
    if any(meshes.penetrates(k, pose, j, poses[j]) for j in near):
        return False
    low = float(pose[2] - meshes.shapes[k].size[2] / 2)
    if low < -TOLERANCE:
        return False
    return low <= TOLERANCE or bool(meshes.carriers_of(k, pose, near, poses))


@dataclass(frozen=True, slots=True)
class RestingPose:
    """A pose at which an object rests.

    Attributes:
        pose: (4,).
        is_steady: Whether the object stays there, by statics.
    """

    pose: FloatArray
    is_steady: bool


def _anywhere(pose: FloatArray) -> bool:
    return True


def resting_pose(
    meshes: MeshQueries,
    poses: FloatArray,
    k: int,
    carried: SupportEdge,
    done: Sequence[int],
    waiting: Sequence[int] = (),
    allowed: Callable[[FloatArray], bool] = _anywhere,
) -> RestingPose | None:
    """Finds a pose near the present one at which an object rests and stays on or in its carrier.

    Args:
        meshes: The objects.
        poses: Their poses, (N, 4).
        k: The object.
        carried: Its support.
        done: Objects of the same support tree that are at rest, its carrier among them.
        waiting: Objects of the tree that are not yet at rest; at its present pose the object may lean on them.
        allowed: Whether the object may be at a pose (4,).

    Returns:
        The pose, or None if none was found.
    """
    everyone = [*done, *waiting]
    is_resting = (
        allowed(poses[k])
        and _is_carried(meshes, poses, k, poses[k], carried)
        and is_at_rest(meshes, poses, k, poses[k], everyone)
    )
    if is_resting and steadiness(meshes, k, poses[k], everyone, poses) >= constants.STEADY:
        return RestingPose(np.array(poses[k]), True)
    best, cost = _cheapest_pose(meshes, poses, k, carried, done, allowed)
    if best is None:
        return None
    if cost >= 2 * constants.UNSTEADY_COST and stands_alone(meshes.shapes[k]):
        # It is better on the table. But an object deep in a container may roll there and still stay in it.
        top = meshes.box(carried.parent, poses[carried.parent])[1][2]
        if not (carried.is_in and best[2] < top):
            return None
    return RestingPose(best, cost < constants.UNSTEADY_COST)


def straight_down(
    meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge, done: Sequence[int]
) -> RestingPose | None:
    """Finds where an object rests if it moves only up or down; it need not stay there. Arguments as for :func:`resting_pose`."""
    if _is_carried(meshes, poses, k, poses[k], carried) and is_at_rest(meshes, poses, k, poses[k], done):
        return RestingPose(np.array(poses[k]), True)
    pose = np.array([*poses[k, :2], meshes.resting_height(k, poses[k], done, poses), poses[k, 3]])
    if pose[2] > poses[k, 2] + constants.WEDGED_RISE or not _is_carried(meshes, poses, k, pose, carried):
        return None
    return RestingPose(pose, True) if is_at_rest(meshes, poses, k, pose, done) else None


def _cheapest_pose(
    meshes: MeshQueries,
    poses: FloatArray,
    k: int,
    carried: SupportEdge,
    done: Sequence[int],
    allowed: Callable[[FloatArray], bool],
) -> tuple[FloatArray | None, float]:
    """Returns the resting pose of least cost, (4,), and the cost, metres; None if there is none."""
    best: FloatArray | None = None
    least = np.inf
    for number, there in enumerate(filter(allowed, _lowered_poses(meshes, poses, k, carried, done, allowed))):
        if number > constants.MAX_CANDIDATES[int(min(least, 3 * constants.UNSTEADY_COST) // constants.UNSTEADY_COST)]:
            break
        if not _is_carried(meshes, poses, k, there, carried):
            continue
        rise = max(0.0, float(there[2] - poses[k, 2]))
        cost = float(np.linalg.norm(there[:2] - poses[k, :2])) + constants.RISE_COST * rise
        if cost >= least:
            continue
        # A pose at which the object tips or rolls costs so much that any steady pose is better.
        steady = steadiness(meshes, k, there, done, poses)
        cost += constants.UNSTEADY_COST * ((steady < constants.STEADY) + (steady < constants.FALLS))
        if cost >= least:
            continue
        if not carried.is_in and carried.parent not in meshes.carriers_of(k, there, [carried.parent], poses):
            continue
        if is_at_rest(meshes, poses, k, there, done):
            best, least = there, cost
            if cost < constants.UNSTEADY_COST and rise <= constants.WEDGED_RISE:
                break
    return best, least


def _lowered_poses(
    meshes: MeshQueries,
    poses: FloatArray,
    k: int,
    carried: SupportEdge,
    done: Sequence[int],
    allowed: Callable[[FloatArray], bool],
) -> Iterator[FloatArray]:
    """Yields lowered poses of an object, with the least turn and move first; some of them may not be allowed."""
    if not stands_alone(meshes.shapes[k]):
        yield from _leaning_poses(meshes, poses, k, carried, done)

    def down(pose: FloatArray) -> FloatArray:
        return np.array([pose[0], pose[1], meshes.resting_height(k, pose, done, poses), pose[3]])

    start, middle = _start_and_middle(meshes, poses, k, carried)
    first = down(np.array([*start, *poses[k, 2:]]))
    yield first
    # Then lower places near by, to which it would slide by itself.
    turns = (0.0, *_aligning_turns(poses[k, 3] - poses[carried.parent, 3]))
    for turn in turns:
        yield _slid_down(meshes, poses, k, np.array([*first[:3], first[3] + turn]), done)
    for turn in turns:
        yield _slid_down(meshes, poses, k, np.array([*middle, poses[k, 2], poses[k, 3] + turn]), done)
    yield from map(down, filter(allowed, _candidates(meshes, poses, k, carried)))


def _aligning_turns(yaw: float) -> Sequence[float]:
    """Returns the least turn that makes two objects, whose yaws differ by ``yaw``, parallel or perpendicular; empty if they are."""
    turn = -float((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    return (turn,) if abs(turn) > 1e-3 else ()


def _slid_down(meshes: MeshQueries, poses: FloatArray, k: int, pose: FloatArray, done: Sequence[int]) -> FloatArray:
    """Returns the pose to which an object slides down from a pose without turning, on slopes too steep for friction."""
    there = np.array([pose[0], pose[1], meshes.resting_height(k, pose, done, poses), pose[3]])
    floor = float(meshes.shapes[k].size[2]) / 2
    for step in constants.SLIDE_STEPS:
        fall = constants.SLIDE_SLOPE * step
        for _ in range(constants.SLIDE_STEPS_EACH):
            moved = there + np.column_stack([step * _WAYS, np.full(len(_WAYS), -fall), np.zeros(len(_WAYS))])
            free = [m for m in moved if m[2] > floor and meshes.is_free(k, m, done, poses)]
            lower = [np.array([m[0], m[1], meshes.resting_height(k, m, done, poses), m[3]]) for m in free]
            lower = [m for m in lower if m[2] < there[2] - fall]  # the others were lowered onto a rim
            if not lower:
                break
            there = min(lower, key=lambda m: float(m[2]))
    return there


def _leaning_poses(
    meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge, done: Sequence[int]
) -> Iterator[FloatArray]:
    """Yields poses of an object that leans: lowered into its carrier, then slid in the direction in which it tips, until contact."""
    start, middle = _start_and_middle(meshes, poses, k, carried)
    width = float(np.ptp(meshes.shapes[carried.parent].footprint, axis=0).min())
    shape = meshes.shapes[k]
    foot = shape.vertices[shape.vertices[:, 2] <= -shape.size[2] / 2 + constants.LEAN_FOOT_HEIGHT, :2].mean(axis=0)
    tips = centre_of_mass(shape)[:2] - foot
    tips /= max(1e-9, float(np.linalg.norm(tips)))
    aside = np.array([-tips[1], tips[0]])
    for turn in constants.LEAN_TURNS:
        yaw = float(poses[k, 3]) + turn
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = np.array([[c, -s], [s, c]])
        way, across = rotation @ tips, rotation @ aside
        # The foot is behind the middle, as seen in the direction of the tip, or beside it if that place is occupied.
        bases = [start] if not turn else []
        bases += [
            middle - rotation @ foot - b * width * way + a * width * across
            for b in constants.FOOT_SETBACKS
            for a in constants.FOOT_OFFSETS
        ]
        for base in bases:
            pose = np.array([*base, poses[k, 2], yaw])
            pose[2] = meshes.resting_height(k, pose, done, poses)
            if pose[2] > poses[k, 2] + constants.LEAN_MAX_RISE:
                continue
            for _ in range(2):
                pose = meshes.slide(k, pose, way, done, poses, width)
                pose[2] = meshes.resting_height(k, pose, done, poses)
            yield pose


def _is_carried(meshes: MeshQueries, poses: FloatArray, k: int, pose: FloatArray, carried: SupportEdge) -> bool:
    """Whether an object is in its container or over its carrier, by outline and height."""
    p = carried.parent
    low, high = meshes.box(p, poses[p])
    bottom = float(pose[2] - meshes.shapes[k].size[2] / 2)
    if bottom < low[2] - TOLERANCE:
        return False
    outside = distance_outside(pose[:2], meshes.shapes[p].posed_footprint(poses[p]))
    if carried.is_in:
        return outside <= INSIDE_SLACK and bottom < high[2] - RIM_MARGIN
    return outside <= 0.0


def _region(meshes: MeshQueries, poses: FloatArray, p: int) -> shapely.Polygon:
    """Returns the region over a carrier in which the centre of a carried object should be."""
    outline = shapely.Polygon(meshes.shapes[p].posed_footprint(poses[p]))
    inner = (outline.buffer(-inset) for inset in constants.CENTRE_INSETS)
    return next(r for r in (*inner, outline.envelope) if not r.is_empty)


def _start_and_middle(meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge) -> tuple[FloatArray, FloatArray]:
    """Returns the place over its carrier that is nearest to an object, and the carrier's middle, two (2,), metres."""
    region, start = _region(meshes, poses, carried.parent), poses[k, :2].copy()
    if not shapely.contains_xy(region, *start):
        start = shapely.get_coordinates(nearest_points(region, shapely.Point(start))[0])[0]
    return start, np.array([region.centroid.x, region.centroid.y])


def _candidates(meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge) -> Iterator[FloatArray]:
    """Yields poses from which an object is lowered, with the least turn and move first."""
    pose, region = poses[k].copy(), _region(meshes, poses, carried.parent)
    start, middle = _start_and_middle(meshes, poses, k, carried)
    angles = 2 * np.pi * np.arange(constants.RING_DIRECTIONS) / constants.RING_DIRECTIONS
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = np.concatenate(
        [
            start[None],
            *(start + r * ring for r in constants.RING_RADII),
            start + np.array(constants.MIDDLE_SHARES)[:, None] * (middle - start),
        ]
    )
    places = places[shapely.intersects_xy(region, places[:, 0], places[:, 1])]
    places = places[np.argsort(np.linalg.norm(places - start, axis=1), kind="stable")][: constants.PLACES_PER_TURN]
    for turn in constants.CANDIDATE_TURNS:
        for place in places:
            yield np.array([*place, pose[2], pose[3] + turn])
