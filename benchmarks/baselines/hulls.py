"""Signed distances between convex bodies that are shifted and never turned, by MuJoCo's narrow phase (GJK and EPA).

The signed distance of two convex bodies is a convex function of their relative shift: it is the distance of a point to the
convex set that their Minkowski difference is. ``projection`` rests on that.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from stable_data.errors import MeshError
from stable_data.scene import FloatArray, IntArray, Tabletop
from stable_data.simulation.mujoco_import import mujoco

_HALF_SHEET = 2.5e-4  # half the thickness that a flat body is given, metres
_FLATTEST = 1e-6  # bodies thinner than this are flat, metres
_TABLE_THICKNESS = 0.1  # metres
_MANY_ITERATIONS = 200


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """Pairs of convex parts that are near each other, E of them, by body.

    Attributes:
        first: Body of the one part, (E,) int64.
        second: Body of the other, (E,) int64.
        distance: Signed distance, (E,) float64, metres, negative where they overlap.
        normal: Derivative of the distance with respect to the first body's position, (E, 3) float64, unit; with respect to the
            second's it is the negative. NaN where the parts touch and witness points do not tell.
    """

    first: IntArray
    second: IntArray
    distance: FloatArray
    normal: FloatArray

    def take(self, rows: npt.NDArray[np.integer] | npt.NDArray[np.bool_]) -> "Distances":
        """Some of the pairs, by index or mask."""
        return Distances(self.first[rows], self.second[rows], self.distance[rows], self.normal[rows])

    def deepest(self, per_pair: int) -> "Distances":
        """At most so many of each pair of bodies, the deepest first."""
        order = np.lexsort((self.distance, self.second, self.first))
        first, second = self.first[order], self.second[order]
        starts = np.flatnonzero(np.r_[True, (np.diff(first) != 0) | (np.diff(second) != 0)]) if len(order) else order
        rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
        return self.take(order[rank < per_pair])


class ConvexBodies:
    """Bodies of one or more convex parts each.

    Args:
        bodies: Of each body its parts, each the points (V, 3) whose hull it is, metres, turned as in the world, around the
            body's position.

    Raises:
        MeshError: A body has no part, or the engine refuses one (code ``no_hull``).
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
        """All pairs of parts whose boxes are not farther apart than a reach, and that are not themselves.

        Args:
            positions: Of the bodies, (N, 3) float64, metres.
            reach: Metres, positive.
            among: Bodies to look at, (K,) int64; all where None.

        Returns:
            The pairs, in the order of the parts.
        """
        self._data.mocap_pos[:] = positions
        mujoco.mj_kinematics(self._model, self._data)
        low, high = self._low + positions[self.body_of], self._high + positions[self.body_of]
        one, other = self._one, self._other
        is_near = (np.maximum(low[one] - high[other], low[other] - high[one]) <= reach).all(axis=1)
        if among is not None:
            looked_at = np.isin(self.body_of, among)
            is_near &= looked_at[one] & looked_at[other]
        one, other = one[is_near], other[is_near]
        distance, witness = np.empty(len(one)), np.empty((len(one), 6))
        for k, (i, j) in enumerate(zip(one.tolist(), other.tolist(), strict=True)):
            distance[k] = mujoco.mj_geomDistance(self._model, self._data, i, j, 2 * reach, witness[k])
        is_near = distance <= reach
        apart = witness[:, :3] - witness[:, 3:]
        length = np.linalg.norm(apart, axis=1)
        is_told = (length > 0) & (np.abs(length - np.abs(distance)) <= 1e-3 * length)  # else the bodies touch, or nearly so
        normal = np.full((len(one), 3), np.nan)
        normal[is_told] = (np.sign(distance) / np.maximum(length, 1e-300))[is_told, None] * apart[is_told]
        found = Distances(self.body_of[one], self.body_of[other], distance, normal)
        return found.take(is_near)


def solid_hull(points: FloatArray) -> FloatArray:
    """Corners (K, 3) of the convex hull of points (V, 3), metres; what is flat is made half a millimetre thick.

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
    """A box below the table top, as the corners (8, 3) of a part around its middle, and the middle (3,), metres."""
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
        raise MeshError(f"the engine refuses a hull: {' '.join(str(error).split())}; repair its mesh", "no_hull") from error
