"""Support of an object: exact contact when it is lowered a little, and the paper's gap."""

import igl
import numpy as np

from stable_data.metrics.collision import DIRECTIONS
from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles, near_triangles, posed_triangles
from stable_data.scene import FloatArray

_UPWARD = 0.01
"""Least vertical component of a contact normal that supports: half a degree from a vertical wall."""

_ASIDE: FloatArray = DIRECTIONS[DIRECTIONS[:, 2] == 0]
_PROBES = 128  # corners that bound a distance from above before it is computed


def carries(pair: MeshPair, gap: float, upper_is_first: bool = True) -> bool:
    """Returns whether one object of a pair rests on the other: whether it meets the other from above when it is lowered.

    It does if a touched face of the lower object faces up. A touched face of the upper object that faces down shows it too (a
    plate on a narrow post meets only the sides of the post), unless the object merely scratches a wall: then a sideways step
    frees it and lifting does not. An object that lifting frees was supported, whichever way the faces of an open sheet are
    oriented. Two vertical walls that touch never support each other.

    Args:
        pair: The two meshes, with a margin of at least the gap.
        gap: Distance of the lowering, the lifting and the sideways step, metres.
        upper_is_first: Whether the first mesh of the pair is the one that is lowered.
    """
    up = np.array([0.0, 0.0, 1.0 if upper_is_first else -1.0])  # only the first mesh moves: the upper up, or the lower down
    for lowered in (gap, 0.0):
        touching = _contact_slopes(pair, -lowered * up, upper_is_first)
        if touching is None:
            continue
        upper, lower = touching
        if lower.max() > _UPWARD:
            return True
        is_slanted = max(np.abs(lower).max(), np.abs(upper).max()) > _UPWARD
        if is_slanted and not pair.cross(gap * up):
            return True
        if upper.min() < -_UPWARD and all(pair.cross(gap * aside - lowered * up) for aside in _ASIDE):
            return True
    return False


def _contact_slopes(pair: MeshPair, shift: FloatArray, upper_is_first: bool) -> tuple[FloatArray, FloatArray] | None:
    """Vertical components of the normals of the touching faces, (C,) of the upper and (C,) of the lower; None without contact."""
    # A few hundred contacts usually show an upward face; all contacts are listed only if they do not.
    for every in (False, True):
        contact = pair.contact(shift, every=every)
        if contact is None:
            return None
        of_a, of_b = contact.normals_a[:, 2], contact.normals_b[:, 2]
        upper, lower = (of_a, of_b) if upper_is_first else (of_b, of_a)
        if lower.max() > _UPWARD or not contact.is_cut_short:
            break
    return upper, lower


def distance_to_surface(points: FloatArray, triangles: FloatArray | PosedTriangles, at_most: float) -> float:
    """Computes the smallest unsigned distance of points to a mesh, or ``at_most`` if all are farther.

    Args:
        points: (P, 3) float64, metres, world frame.
        triangles: (F, 3, 3) float64, metres, world frame.
        at_most: Bound beyond which the distance does not matter, metres.
    """
    surface = posed_triangles(triangles)
    corners = surface.triangles[:: max(1, len(surface.triangles) // _PROBES), 0]
    probe = np.linalg.norm(points[:, None] - corners[None], axis=2).min(initial=at_most)
    at_most = min(at_most, float(probe))  # a corner is this near, so the surface is too
    # Points are triangles without extent, so that near_triangles drops pairs that are farther apart than the bound.
    degenerate = np.repeat(points[:, None], 3, axis=1)
    near_points, near = near_triangles(degenerate, surface, at_most)
    if not len(near):
        return at_most
    soup = surface.triangles[near].reshape(-1, 3)
    squared = igl.point_mesh_squared_distance(points[near_points], soup, np.arange(len(soup)).reshape(-1, 3))[0]
    return float(min(at_most, np.sqrt(squared.min())))
