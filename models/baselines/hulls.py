"""Signed distances between convex bodies that are shifted and never turned, by MuJoCo's narrow phase (GJK and EPA).

The signed distance of two convex bodies is a convex function of their relative shift: it is the distance of a point to their
convex Minkowski difference. ``projection`` relies on this.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from stable_data.errors import MeshError
from stable_data.scene import FloatArray, IntArray, Tabletop
from stable_data.simulation.mujoco_import import mujoco

_HALF_SHEET = 2.5e-4  # half the thickness given to a flat body, metres
_FLATTEST = 1e-6  # a body thinner than this counts as flat, metres
_TABLE_THICKNESS = 0.1  # metres
_MANY_ITERATIONS = 200


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """E pairs of convex parts that are near each other.

    Attributes:
        first: Body of the first part, (E,) int64.
        second: Body of the second part, (E,) int64.
        distance: Signed distance, (E,) float64, metres, negative if they overlap.
        normal: Derivative of the distance with respect to the first body's position, (E, 3) float64, unit; for the second body it
            is the negative. NaN if the parts touch, so that the witness points do not define it.
    """

    first: IntArray
    second: IntArray
    distance: FloatArray
    normal: FloatArray

    def take(self, rows: npt.NDArray[np.integer] | npt.NDArray[np.bool_]) -> "Distances":
        """Returns some of the pairs, by index or mask."""
        return Distances(self.first[rows], self.second[rows], self.distance[rows], self.normal[rows])

    def deepest(self, per_pair: int) -> "Distances":
        """Returns at most ``per_pair`` pairs of parts of each pair of bodies, the deepest ones."""
        order = np.lexsort((self.distance, self.second, self.first))
        first, second = self.first[order], self.second[order]
        starts = np.flatnonzero(np.r_[True, (np.diff(first) != 0) | (np.diff(second) != 0)]) if len(order) else order
        rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
        return self.take(order[rank < per_pair])


class ConvexBodies:
    """Bodies of one or more convex parts each.

    Args:
        bodies: The parts of each body. A part is given by points (V, 3) of which it is the hull, metres, relative to the body's
            position, with the rotation of the world frame.

    Raises:
        MeshError: A body has no part, or MuJoCo refuses one (code ``no_hull``).
    """

    def __init__(self, bodies: Sequence[Sequence[FloatArray]]) -> None:
        hulls = [[solid_hull(points) for points in body] for body in bodies]
        if not all(hulls):
            raise MeshError(
                f"body {[bool(h) for h in hulls].index(False)} has no convex part, expected at least one", "no_hull"
            )
        self.body_of = np.repeat(np.arange(len(hulls)), [len(parts) for parts in hulls])
        flat = [points for parts in hulls for points in parts]
        self._low = np.array([points.min(axis=0) for points in flat]).reshape(-1, 3)
        self._high = np.array([points.max(axis=0) for points in flat]).reshape(-1, 3)
        one, other = np.triu_indices(len(flat), 1)
        is_apart = self.body_of[one] != self.body_of[other]
        self._one, self._other = one[is_apart], other[is_apart]
        self._model = _compiled(hulls)
        self._data = mujoco.MjData(self._model)

    def __len__(self) -> int:
        """Number of bodies."""
        return int(self._model.nmocap)

    def distances(self, positions: FloatArray, reach: float, among: IntArray | None = None) -> Distances:
        """Computes the distances of all pairs of parts that are not farther apart than a reach.

        Args:
            positions: Positions of the bodies, (N, 3) float64, metres.
            reach: Largest distance, metres, positive.
            among: Bodies to consider, (K,) int64; None: all.

        Returns:
            The pairs, in the order of the parts.
        """
        self._data.mocap_pos[:] = positions
        mujoco.mj_kinematics(self._model, self._data)
        low, high = self._low + positions[self.body_of], self._high + positions[self.body_of]
        one, other = self._one, self._other
        is_near = (np.maximum(low[one] - high[other], low[other] - high[one]) <= reach).all(axis=1)
        if among is not None:
            is_considered = np.isin(self.body_of, among)
            is_near &= is_considered[one] & is_considered[other]
        one, other = one[is_near], other[is_near]
        distance, witness = np.empty(len(one)), np.empty((len(one), 6))
        for k, (i, j) in enumerate(zip(one.tolist(), other.tolist(), strict=True)):
            distance[k] = mujoco.mj_geomDistance(self._model, self._data, i, j, 2 * reach, witness[k])
        is_near = distance <= reach
        apart = witness[:, :3] - witness[:, 3:]
        length = np.linalg.norm(apart, axis=1)
        is_defined = (length > 0) & (np.abs(length - np.abs(distance)) <= 1e-3 * length)  # else the bodies touch, or nearly so
        normal = np.full((len(one), 3), np.nan)
        normal[is_defined] = (np.sign(distance) / np.maximum(length, 1e-300))[is_defined, None] * apart[is_defined]
        found = Distances(self.body_of[one], self.body_of[other], distance, normal)
        return found.take(is_near)


def solid_hull(points: FloatArray) -> FloatArray:
    """Computes the corners (K, 3) of the convex hull of points (V, 3), metres; a flat hull is made 0.5 mm thick.

    Raises:
        MeshError: The points are a line, a point, or not finite (code ``no_hull``).
    """
    middle = points.mean(axis=0)
    if len(points) >= 3 and np.isfinite(points).all():
        _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
        if spread[2] < _FLATTEST < spread[1]:
            points = np.concatenate([points + _HALF_SHEET * axes[2], points - _HALF_SHEET * axes[2]])
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise MeshError(f"{len(points)} points around {middle} have no convex hull, expected a surface", "no_hull") from error


def table_box(table: Tabletop) -> tuple[FloatArray, FloatArray]:
    """Returns a box below the table top: its corners (8, 3) relative to its centre, and the centre (3,), metres."""
    half = np.array([*table.size_xy, _TABLE_THICKNESS]) / 2
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return signs * half, half * (1, 1, -1)


def _compiled(hulls: Sequence[Sequence[FloatArray]]) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.option.ccd_iterations = _MANY_ITERATIONS
    for n, parts in enumerate(hulls):
        body = spec.worldbody.add_body(mocap=True)
        for k, points in enumerate(parts):
            name = f"part_{n}_{k}"
            spec.add_mesh(name=name, uservert=points.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0)
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise MeshError(f"MuJoCo refuses a hull: {' '.join(str(error).split())}; repair its mesh", "no_hull") from error
