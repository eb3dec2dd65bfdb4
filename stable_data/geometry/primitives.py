"""Closed meshes of simple shapes, centred on the origin, z up.

Round shapes have a corner on each axis, so that their boxes are exact.
"""

import numpy as np

from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray, IntArray

_AROUND = 32  # corners of a circle, a multiple of four
_BOX_FACES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))


def box_mesh(size: tuple[float, float, float] | FloatArray) -> Mesh:
    """A box.

    Args:
        size: Its sides.
    """
    corners = np.array([(x, y, z) for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)]) * np.asarray(size)
    faces = [triangle for a, b, c, d in _BOX_FACES for triangle in ((a, b, c), (a, c, d))]
    return Mesh(corners, np.array(faces))


def cylinder_mesh(radius: float, height: float) -> Mesh:
    """A cylinder along z."""
    return _turned([(radius, -height / 2), (radius, height / 2)])


def cone_mesh(radius: float, height: float) -> Mesh:
    """A cone along z with its tip up, its height centred on the origin."""
    return _turned([(radius, -height / 2)], top=height / 2)


def sphere_mesh(radius: float) -> Mesh:
    """A sphere, its corners on the sphere."""
    return capsule_mesh(radius, 0.0)


def ellipsoid_mesh(radii: tuple[float, float, float] | FloatArray) -> Mesh:
    """An ellipsoid with these radii along the axes."""
    unit = sphere_mesh(1.0)
    return Mesh(unit.vertices * np.asarray(radii), unit.faces)


def capsule_mesh(radius: float, height: float) -> Mesh:
    """A capsule along z.

    Args:
        radius: Of the cylinder and its two ends.
        height: Of the cylinder, without its ends; 0 makes a sphere.
    """
    angles = np.arange(-_AROUND // 4 + 1, _AROUND // 4) * 2 * np.pi / _AROUND
    below = [(radius * np.cos(a), radius * np.sin(a) - height / 2) for a in angles if a <= 0]
    above = [(radius * np.cos(a), radius * np.sin(a) + height / 2) for a in angles if a >= 0]
    profile = below + (above if height > 0 else above[1:])
    return _turned(profile, bottom=-height / 2 - radius, top=height / 2 + radius)


def _turned(profile: list[tuple[float, float]], *, bottom: float | None = None, top: float | None = None) -> Mesh:
    """A solid of revolution about z.

    Args:
        profile: Radius and height of each ring, from below.
        bottom: Height of its lowest point; None for a flat end at the first ring.
        top: Height of its highest point; None for a flat end at the last ring.
    """
    angle = np.arange(_AROUND) * 2 * np.pi / _AROUND
    # Sines and cosines are exact on the axes.
    circle = np.round(np.stack([np.cos(angle), np.sin(angle)], axis=1), 15)
    rings = [np.column_stack([circle * radius, np.full(_AROUND, z)]) for radius, z in profile]
    ends = [(0.0, 0.0, profile[0][1] if bottom is None else bottom), (0.0, 0.0, profile[-1][1] if top is None else top)]
    here = np.arange(_AROUND)
    there = np.roll(here, -1)
    num, faces = len(profile) * _AROUND, list[IntArray]()
    faces.append(np.stack([np.full(_AROUND, num), there, here], axis=1))
    for ring in range(len(profile) - 1):
        low, high = ring * _AROUND, (ring + 1) * _AROUND
        faces += [
            np.stack([low + here, low + there, high + there], axis=1),
            np.stack([low + here, high + there, high + here], axis=1),
        ]
    last = num - _AROUND
    faces.append(np.stack([last + here, last + there, np.full(_AROUND, num + 1)], axis=1))
    return Mesh(np.concatenate([*rings, np.array(ends)]), np.concatenate(faces))
