"""Brings what is in or on another thing to rest there, exactly: where it is, else as near by as something can be found."""

from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from shapely.ops import nearest_points

from models.physics_corrector.certify.carriers import Carried, beyond
from models.physics_corrector.certify.contact import Meshes
from stable_data.metrics.collision import TOLERANCE
from stable_data.relations import INSIDE_SLACK
from stable_data.scene import FloatArray

_RIM = 4e-3  # the bottom of what is in a container has to be this much below the rim, metres
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
_TOPPLES, _STEADY = 100.0, 2e-3  # how much a centre of mass beyond what carries it counts, and from where, metres
_ENOUGH = 16  # among so many
_MOST = 60  # places that are tried at each turn


def is_at_rest(meshes: Meshes, poses: FloatArray, k: int, pose: FloatArray, others: Sequence[int]) -> bool:
    """Is an object at a pose (4,) free of others, and does one of them or the table carry it?"""
    near = meshes.near(k, pose, others, poses, TOLERANCE)
    if any(meshes.penetrates(k, pose, j, poses[j]) for j in near):
        return False
    low = float(pose[2] - meshes.shapes[k].size[2] / 2)
    if low < -TOLERANCE:
        return False
    return low <= TOLERANCE or bool(meshes.rests(k, pose, near, poses))


def resting_pose(
    meshes: Meshes, poses: FloatArray, k: int, carried: Carried, done: Sequence[int], waiting: Sequence[int] = ()
) -> FloatArray | None:
    """A pose at which an object rests in or on what carries it, near to where it is.

    Args:
        meshes: The objects.
        poses: Where they are, (N, 4).
        k: The object.
        carried: What carries it.
        done: Objects of the same carrier tree that are at rest, its carrier among them.
        waiting: Objects of it that are not, but that it may lean on where it is.

    Returns:
        The pose, (4,), or None where none was found.
    """
    if _is_carried(meshes, poses, k, poses[k], carried) and is_at_rest(meshes, poses, k, poses[k], [*done, *waiting]):
        return np.array(poses[k])
    best: FloatArray | None = None
    least = np.inf
    for number, there in enumerate(_candidates(meshes, poses, k, carried)):
        if best is not None and number > _ENOUGH:
            break
        there[2] = meshes.lowered(k, there, done, poses)
        if not _is_carried(meshes, poses, k, there, carried):
            continue
        # What would topple or roll costs so much that any place at which it stays is better.
        cost = float(np.linalg.norm(there[:2] - poses[k, :2]) + max(0.0, there[2] - poses[k, 2]))
        cost += _TOPPLES * min(1.0, max(0.0, meshes.beyond_support(k, there, done, poses) - _STEADY))
        if cost >= least:
            continue
        if not carried.is_in and carried.parent not in meshes.rests(k, there, [carried.parent], poses):
            continue
        if is_at_rest(meshes, poses, k, there, done):
            best, least = there, cost
            if cost < _TOPPLES * _STEADY and there[2] <= poses[k, 2] + _LIFT:
                break
    return best


def _is_carried(meshes: Meshes, poses: FloatArray, k: int, pose: FloatArray, carried: Carried) -> bool:
    """By outline and height: is an object in its container, or over what carries it?"""
    p = carried.parent
    low, high = meshes.box(p, poses[p])
    bottom = float(pose[2] - meshes.shapes[k].size[2] / 2)
    if bottom < low[2] - TOLERANCE:
        return False
    outside = beyond(pose[:2], meshes.shapes[p].posed_footprint(poses[p]))
    if carried.is_in:
        return outside <= INSIDE_SLACK and bottom < high[2] - _RIM
    return outside <= 0.0


def _candidates(meshes: Meshes, poses: FloatArray, k: int, carried: Carried) -> Iterator[FloatArray]:
    """Poses from which an object is lowered, those that turn and move it least first."""
    p, pose = carried.parent, poses[k].copy()
    outline = shapely.Polygon(meshes.shapes[p].posed_footprint(poses[p]))
    inner = (outline.buffer(-inset) for inset in _INSETS)
    region = next(r for r in (*inner, outline.envelope) if not r.is_empty)
    start = pose[:2].copy()
    if not shapely.contains_xy(region, *start):
        start = shapely.get_coordinates(nearest_points(region, shapely.Point(start))[0])[0]
    middle = np.array([region.centroid.x, region.centroid.y])
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
