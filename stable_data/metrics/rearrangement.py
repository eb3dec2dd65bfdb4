"""Distances of a rearrangement: the distance moved, and the earth mover's distance to the ground truth.

After the paper's appendix, "Details of Rearrangement". Both match objects first, because it does not matter which of two identical
cups is at which place. Identical objects have the same asset at the same scale and tilt. The paper matches objects of the same
category instead, which lets a mug replace a tall glass.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from stable_data.errors import SceneError
from stable_data.rotations import YAW_ARM, wrap_angle
from stable_data.scene import FloatArray, Scene, SceneObject

Matching: TypeAlias = Literal["identical", "category"]
"""Which objects may take each other's places: identical ones, or those of the same category."""

_SAME_SIZE = 1e-3  # metres
_SAME_TILT = np.cos(np.radians(1.0) / 2)  # dot product of two quaternions that are 1 degree apart
_FORBIDDEN = 1e9  # cost of a pair that may not be matched, metres


@dataclass(frozen=True, slots=True)
class TransportCost:
    """The cost to move the objects of one scene to their places in another: means over the objects.

    Attributes:
        cost: Earth mover's distance: sqrt(|Δt|² + (0.1 m/rad · Δr)²), metres.
        distance: |Δt| of the same matching, metres.
        turn: |Δr| of the same matching, radians, at most π.
        matches: Instance -> the instance whose place it takes.
    """

    cost: float
    distance: float
    turn: float
    matches: dict[str, str]


def emd_to_truth(scene: Scene, truth: Scene, matching: Matching = "identical") -> TransportCost:
    """Computes the earth mover's distance of a scene to its ground truth; objects are matched at the least total cost.

    Args:
        scene: The rearranged scene.
        truth: The ground truth, with the same objects in any order.
        matching: Which objects may be matched.

    Raises:
        SceneError: Objects are missing, additional or different (code ``objects_differ``), or there are none (``empty_scene``).
    """
    return _transport(scene, truth, matching, lambda shift, turn: np.hypot(shift, YAW_ARM * turn))


def distance_moved(start: Scene, result: Scene, matching: Matching = "identical") -> float:
    """Computes the mean distance that a method moved the objects, metres; they are matched at the least total distance.

    Args:
        start: The input scene.
        result: The scene after the method.
        matching: Which objects may be matched.

    Raises:
        SceneError: As for :func:`emd_to_truth`.
    """
    return _transport(result, start, matching, lambda shift, _: shift).distance


def _transport(
    scene: Scene, other: Scene, matching: Matching, cost_of: Callable[[FloatArray, FloatArray], FloatArray]
) -> TransportCost:
    names = [o.instance for o in scene.objects]
    _check_same_objects(scene, other)
    targets = [other[name] for name in names]
    poses, places = scene.poses(), np.array([(*o.position, o.yaw) for o in targets])
    shift = np.linalg.norm(poses[:, None, :3] - places[None, :, :3], axis=2)
    turn = np.abs(wrap_angle(poses[:, None, 3] - places[None, :, 3]))
    is_like = _is_identical if matching == "identical" else _has_same_category
    may_match = np.array([[o.instance == t.instance or is_like(o, t) for t in targets] for o in scene.objects])
    cost = cost_of(shift, turn)
    chosen = linear_sum_assignment(np.where(may_match, cost, _FORBIDDEN))  # feasible: each object may take its own place
    matches = {names[i]: names[j] for i, j in zip(*(index.tolist() for index in chosen), strict=True)}
    return TransportCost(float(cost[chosen].mean()), float(shift[chosen].mean()), float(turn[chosen].mean()), matches)


def _check_same_objects(scene: Scene, other: Scene) -> None:
    names, wanted = ({o.instance for o in s.objects} for s in (scene, other))
    if names != wanted:
        found = f"lacks {sorted(wanted - names)}, with the additional objects {sorted(names - wanted)}"
        raise SceneError(f"{scene.scene_id}: {found}, expected the objects of the scene it is compared with", "objects_differ")
    if not names:
        raise SceneError(f"{scene.scene_id}: no objects, expected at least one to compare", "empty_scene")
    for o in scene.objects:
        if o.asset_id != other[o.instance].asset_id:
            message = f"{scene.scene_id}: object {o.instance} is asset {o.asset_id}, expected {other[o.instance].asset_id}"
            raise SceneError(f"{message} as in the scene it is compared with", "objects_differ")


def _has_same_category(o: SceneObject, other: SceneObject) -> bool:
    return o.category == other.category


def _is_identical(o: SceneObject, other: SceneObject) -> bool:
    if o.asset_id is None or o.asset_id != other.asset_id:
        return False
    has_same_tilt = abs(np.dot(o.tilt_quat_xyzw, other.tilt_quat_xyzw)) >= _SAME_TILT
    return bool(has_same_tilt and np.abs(np.subtract(o.size, other.size)).max() <= _SAME_SIZE)
