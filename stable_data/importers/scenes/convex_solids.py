"""Convex solids as meshes: the primitives of scene files, and convex hulls. Metres, z up, faces wound outwards."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from stable_data.errors import SceneError
from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray

_SIDES = 64
"""Corners of a round cross-section: at a radius of 5 cm, the polygon stays 0.06 mm inside of the circle."""

_FARTHEST = 1e6  # metres; LAPACK never ends with numbers that are not finite

_THINNEST = 1e-4  # metres: flatter points are given this thickness


def hull_of(points: FloatArray) -> Mesh | None:
    """Returns the convex hull of points (P, 3); flat points become a thin plate. None if they lie on a line.

    Args:
        points: Metres.

    Raises:
        SceneError: A point is beyond all measure, or not finite (``size_invalid``).
    """
    if not (np.abs(points) < _FARTHEST).all():
        farthest = float(np.abs(points).max(initial=0.0))
        raise SceneError(f"a shape has a corner {farthest:g} m away, expected usual lengths; correct it", "size_invalid")
    points = np.unique(np.asarray(points, np.float64), axis=0)
    if len(points) < 3:
        return None
    centred = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    if spread[1] <= 1e-9:
        return None
    thickness = np.ptp(centred @ axes[2]) if len(axes) > 2 else 0.0
    if thickness < _THINNEST:
        normal = axes[2] if len(axes) > 2 else np.cross(axes[0], axes[1])
        points = np.concatenate([points - _THINNEST / 2 * normal, points + _THINNEST / 2 * normal])
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    faces = hull.simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(points[used], index.reshape(-1, 3))


def box(half: FloatArray) -> Mesh:
    """Returns a box from its half extents (3,)."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    return _solid(signs * half)


def ellipsoid(radii: FloatArray) -> Mesh:
    """Returns an ellipsoid from its radii (3,)."""
    return _solid(_sphere_points() * radii)


def capsule(radius: float, half_length: float) -> Mesh:
    """Returns a capsule along z: a cylinder of a half length with half spheres on its ends."""
    points = radius * _sphere_points()
    shift = np.array([0.0, 0.0, half_length])
    return _solid(np.concatenate([points[points[:, 2] >= -1e-9] + shift, points[points[:, 2] <= 1e-9] - shift]))


def cylinder(radius: float, half_length: float) -> Mesh:
    """Returns a cylinder along z."""
    ring = _ring() * radius
    ends = [np.column_stack([ring, np.full(len(ring), z)]) for z in (-half_length, half_length)]
    return _solid(np.concatenate(ends))


def _solid(points: FloatArray) -> Mesh:
    """The hull of the points of a solid.

    Raises:
        SceneError: It has none, because a length is beyond all measure (``size_invalid``).
    """
    found = hull_of(points)
    if found is None:
        sides = " x ".join(f"{side:.3g}" for side in np.ptp(points, axis=0))
        raise SceneError(
            f"a shape of {sides} m has no volume that can be computed, expected usual lengths; correct it", "size_invalid"
        )
    return found


def _ring() -> FloatArray:
    angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _sphere_points() -> FloatArray:
    """Points on the unit sphere: rings of latitude with both poles, (P, 3)."""
    ring = _ring()
    angles = np.pi * (np.arange(_SIDES // 2 + 1) / (_SIDES // 2) - 0.5)
    return np.concatenate([np.column_stack([np.cos(t) * ring, np.full(len(ring), np.sin(t))]) for t in angles])
