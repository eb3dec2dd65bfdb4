"""What an object rests on: exact contact when it is lowered a little, and the paper's own gap."""

import igl
import numpy as np

from stable_data.metrics.crossing import MeshPair, Surface, near_triangles
from stable_data.scene import FloatArray

_UPWARD = 0.01
"""Least vertical part of a contact normal that carries: half a degree from a vertical wall."""


_PROBES = 128  # corners that bound a distance from above before it is computed


def carries(pair: MeshPair, gap: float, upper_is_first: bool = True) -> bool:
    """Does one object of a pair meet the other one with an upward normal when lowered?

    A contact carries when the lower face looks up or the upper face looks down; two vertical walls that touch do not.

    Args:
        pair: The two meshes, with a margin of at least the gap.
        gap: How far it is lowered, metres.
        upper_is_first: Whether the first of the pair is the one that is lowered.
    """
    for lowered in (gap, 0.0):
        # Lifting the lower one is the same as lowering the upper one.
        shift = (0.0, 0.0, -lowered if upper_is_first else lowered)
        for every in (False, True):
            contact = pair.contact(shift, every=every)
            if contact is None:
                break
            upper, lower = (contact.normals_a, contact.normals_b) if upper_is_first else (contact.normals_b, contact.normals_a)
            if ((lower[:, 2] > _UPWARD) | (upper[:, 2] < -_UPWARD)).any():
                return True
            if not contact.is_cut_short:
                break
    return False


def distance_to_surface(points: FloatArray, triangles: FloatArray | Surface, at_most: float) -> float:
    """Smallest unsigned distance of points to a mesh, or ``at_most`` where all are farther.

    Args:
        points: (P, 3) float64, metres, world frame.
        triangles: (F, 3, 3) float64, metres, world frame.
        at_most: Bound beyond which the distance does not matter, metres.
    """
    surface = triangles if isinstance(triangles, Surface) else Surface(triangles)
    corners = surface.triangles[:: max(1, len(surface.triangles) // _PROBES), 0]
    probe = np.linalg.norm(points[:, None] - corners[None], axis=2).min(initial=at_most)
    at_most = min(at_most, float(probe))  # some corner is this near, so the surface is
    degenerate = np.repeat(points[:, None], 3, axis=1)
    near_points, near = near_triangles(degenerate, surface, at_most)
    if not len(near):
        return at_most
    soup = surface.triangles[near].reshape(-1, 3)
    squared = igl.point_mesh_squared_distance(points[near_points], soup, np.arange(len(soup)).reshape(-1, 3))[0]
    return float(min(at_most, np.sqrt(squared.min())))
