"""Brings what is in or on another thing to rest there, exactly: where it is, else as near by as something can be found."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.ops import nearest_points

from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.certify.static_stability import FALLS, STEADY, centre_of_mass, stands_alone, steadiness
from models.physics_corrector.certify.support_inference import SupportEdge, distance_outside
from stable_data.geometry.leaning import RIM_MARGIN
from stable_data.metrics.collision import TOLERANCE
from stable_data.scene import FloatArray
from stable_data.scene_graph.relations import INSIDE_SLACK

_INSETS = (
    0.02,
    0.01,
    0.005,
    0.0,
)  # how far inside its carrier's outline a centre is wanted, metres; the first that leaves room
_RINGS = (0.004, 0.008, 0.014, 0.022, 0.032, 0.045, 0.06, 0.08, 0.11, 0.15)  # how far from where it is a place is looked for
_AROUND = 8
_SHARES = (0.25, 0.5, 0.75, 1.0)  # and so far towards the carrier's middle
_TURNS = (0.0, np.pi / 2, np.pi / 4, -np.pi / 4)  # besides, turned
_LIFT = 4e-3  # what comes to rest this much higher than it was may be wedged: a better place is looked for, metres
_TOPPLES = 100.0  # what it costs that a thing may not stay, metres
_CLIMB = 3.0  # how much rising counts beside moving aside
# Among so many places: where it stays in one of them, where that is not sure, where it falls, where it rests in none.
_TRIES = (12, 24, 40, 80)
_STEPS, _MOST_STEPS, _SLOPE = (
    (8e-3, 3e-3, 1e-3),
    6,
    0.2,
)  # of what slides down, metres; so many of each; and how steep it is then
_WAYS = np.array([[np.cos(a), np.sin(a)] for a in 2 * np.pi * np.arange(6) / 6])
_LEANS = tuple(np.radians((0, 20, -20, 45, -45, 90, -90, 135, -135, 180)))  # turns of what leans
_BACK, _BESIDE = (0.2, 0.0), (0.0, 0.15, -0.15)  # where its foot is put, shares of its carrier's width
_FOOT, _HIGHER = 1e-3, 0.03  # height of its foot; and how much higher than it was it may come down, metres
_MOST = 60  # places that are tried at each turn


def is_at_rest(meshes: MeshQueries, poses: FloatArray, k: int, pose: FloatArray, others: Sequence[int]) -> bool:
    """Is an object at a pose (4,) free of others, and does one of them or the table carry it?"""
    near = meshes.near(k, pose, others, poses, TOLERANCE)
    if any(meshes.penetrates(k, pose, j, poses[j]) for j in near):
        return False
    low = float(pose[2] - meshes.shapes[k].size[2] / 2)
    if low < -TOLERANCE:
        return False
    return low <= TOLERANCE or bool(meshes.rests(k, pose, near, poses))


@dataclass(frozen=True, slots=True)
class RestingPose:
    """Where something rests.

    Attributes:
        pose: (4,).
        is_steady: Whether it stays there, by its statics.
    """

    pose: FloatArray
    is_steady: bool


def resting_pose(
    meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge, done: Sequence[int], waiting: Sequence[int] = ()
) -> RestingPose | None:
    """A pose at which an object rests in or on what carries it and stays there, near to where it is.

    Args:
        meshes: The objects.
        poses: Where they are, (N, 4).
        k: The object.
        carried: What carries it.
        done: Objects of the same carrier tree that are at rest, its carrier among them.
        waiting: Objects of it that are not, but that it may lean on where it is.

    Returns:
        The pose, or None where none was found.
    """
    everyone = [*done, *waiting]
    is_well = _is_carried(meshes, poses, k, poses[k], carried) and is_at_rest(meshes, poses, k, poses[k], everyone)
    if is_well and steadiness(meshes, k, poses[k], everyone, poses) >= STEADY:
        return RestingPose(np.array(poses[k]), True)
    best, cost = _cheapest(meshes, poses, k, carried, done)
    if best is None:
        return None
    if cost >= 2 * _TOPPLES and stands_alone(meshes.shapes[k]):
        # It stands better on the table, but what is deep in a container may roll there and yet stays in it.
        top = meshes.box(carried.parent, poses[carried.parent])[1][2]
        if not (carried.is_in and best[2] < top):
            return None
    return RestingPose(best, cost < _TOPPLES)


def _cheapest(
    meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge, done: Sequence[int]
) -> tuple[FloatArray | None, float]:
    """The pose at which an object rests that costs least to take, (4,), and what it costs, metres; None where there is none."""
    best: FloatArray | None = None
    least = np.inf
    for number, there in enumerate(_lowered(meshes, poses, k, carried, done)):
        if number > _TRIES[int(min(least, 3 * _TOPPLES) // _TOPPLES)]:
            break
        if not _is_carried(meshes, poses, k, there, carried):
            continue
        rise = max(0.0, float(there[2] - poses[k, 2]))
        cost = float(np.linalg.norm(there[:2] - poses[k, :2])) + _CLIMB * rise
        if cost >= least:
            continue
        # What would topple or roll costs so much that any place at which it stays is better.
        steady = steadiness(meshes, k, there, done, poses)
        cost += _TOPPLES * ((steady < STEADY) + (steady < FALLS))
        if cost >= least:
            continue
        if not carried.is_in and carried.parent not in meshes.rests(k, there, [carried.parent], poses):
            continue
        if is_at_rest(meshes, poses, k, there, done):
            best, least = there, cost
            if cost < _TOPPLES and rise <= _LIFT:
                break
    return best, least


def _lowered(meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge, done: Sequence[int]) -> Iterator[FloatArray]:
    """Poses to which an object comes down, those that turn and move it least first."""
    if not stands_alone(meshes.shapes[k]):
        yield from _leaning(meshes, poses, k, carried, done)

    def down(pose: FloatArray) -> FloatArray:
        return np.array([pose[0], pose[1], meshes.lowered(k, pose, done, poses), pose[3]])

    start, middle = _start_and_middle(meshes, poses, k, carried)
    first = down(np.array([*start, *poses[k, 2:]]))
    yield first
    # It slides to where it lies lower, as it would by itself.
    turns = (0.0, *_aligning(poses[k, 3] - poses[carried.parent, 3]))
    for turn in turns:
        yield _sunk(meshes, poses, k, np.array([*first[:3], first[3] + turn]), done)
    for turn in turns:
        yield _sunk(meshes, poses, k, np.array([*middle, poses[k, 2], poses[k, 3] + turn]), done)
    for there in _candidates(meshes, poses, k, carried):
        yield down(there)


def _aligning(yaw: float) -> Sequence[float]:
    """The least turn after which two things whose yaws differ by so much are parallel or at right angles, where they are not."""
    turn = -float((yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    return (turn,) if abs(turn) > 1e-3 else ()


def _sunk(meshes: MeshQueries, poses: FloatArray, k: int, pose: FloatArray, done: Sequence[int]) -> FloatArray:
    """Where an object slides to from a pose without turning, steeper than friction would hold it."""
    there = np.array([pose[0], pose[1], meshes.lowered(k, pose, done, poses), pose[3]])
    floor = float(meshes.shapes[k].size[2]) / 2
    for step in _STEPS:
        for _ in range(_MOST_STEPS):
            moved = there + np.column_stack([step * _WAYS, np.full(len(_WAYS), -_SLOPE * step), np.zeros(len(_WAYS))])
            free = [m for m in moved if m[2] > floor and meshes.is_free(k, m, done, poses)]
            lower = [np.array([m[0], m[1], meshes.lowered(k, m, done, poses), m[3]]) for m in free]
            lower = [m for m in lower if m[2] < there[2] - _SLOPE * step]  # others come from above onto a rim
            if not lower:
                break
            there = min(lower, key=lambda m: float(m[2]))
    return there


def _leaning(meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge, done: Sequence[int]) -> Iterator[FloatArray]:
    """Poses at which what cannot stand leans: put down in its carrier, then slid the way it would tip, until it meets something."""
    start, middle = _start_and_middle(meshes, poses, k, carried)
    width = float(np.ptp(meshes.shapes[carried.parent].footprint, axis=0).min())
    shape = meshes.shapes[k]
    foot = shape.vertices[shape.vertices[:, 2] <= -shape.size[2] / 2 + _FOOT, :2].mean(axis=0)
    tips = centre_of_mass(shape)[:2] - foot
    tips /= max(1e-9, float(np.linalg.norm(tips)))
    aside = np.array([-tips[1], tips[0]])
    for turn in _LEANS:
        yaw = float(poses[k, 3]) + turn
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = np.array([[c, -s], [s, c]])
        way, across = rotation @ tips, rotation @ aside
        # Its foot on the far side of the middle, a little beside it where that is taken.
        bases = [start] if not turn else []
        bases += [middle - rotation @ foot - b * width * way + a * width * across for b in _BACK for a in _BESIDE]
        for base in bases:
            pose = np.array([*base, poses[k, 2], yaw])
            pose[2] = meshes.lowered(k, pose, done, poses)
            if pose[2] > poses[k, 2] + _HIGHER:
                continue
            for _ in range(2):
                pose = meshes.slid(k, pose, way, done, poses, width)
                pose[2] = meshes.lowered(k, pose, done, poses)
            yield pose


def _is_carried(meshes: MeshQueries, poses: FloatArray, k: int, pose: FloatArray, carried: SupportEdge) -> bool:
    """By outline and height: is an object in its container, or over what carries it?"""
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
    """Where over a carrier the centre of what it carries is wanted."""
    outline = shapely.Polygon(meshes.shapes[p].posed_footprint(poses[p]))
    inner = (outline.buffer(-inset) for inset in _INSETS)
    return next(r for r in (*inner, outline.envelope) if not r.is_empty)


def _start_and_middle(meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge) -> tuple[FloatArray, FloatArray]:
    """The place over its carrier that is nearest to an object, and the carrier's middle, two (2,), metres."""
    region, start = _region(meshes, poses, carried.parent), poses[k, :2].copy()
    if not shapely.contains_xy(region, *start):
        start = shapely.get_coordinates(nearest_points(region, shapely.Point(start))[0])[0]
    return start, np.array([region.centroid.x, region.centroid.y])


def _candidates(meshes: MeshQueries, poses: FloatArray, k: int, carried: SupportEdge) -> Iterator[FloatArray]:
    """Poses from which an object is lowered, those that turn and move it least first."""
    pose, region = poses[k].copy(), _region(meshes, poses, carried.parent)
    start, middle = _start_and_middle(meshes, poses, k, carried)
    angles = 2 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    places = np.concatenate(
        [start[None], *(start + r * ring for r in _RINGS), start + np.array(_SHARES)[:, None] * (middle - start)]
    )
    places = places[shapely.intersects_xy(region, places[:, 0], places[:, 1])]
    places = places[np.argsort(np.linalg.norm(places - start, axis=1), kind="stable")][:_MOST]
    for turn in _TURNS:
        for place in places:
            yield np.array([*place, pose[2], pose[3] + turn])
