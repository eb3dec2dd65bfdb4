"""Boxes, spheres, cylinders and capsules as triangles, as simulators describe them."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from stable_data.scene import FloatArray

_SEGMENTS = 48  # around a round form; a multiple of 4, so that its box along the axes is exact; the volume is 0.3 % too small


def box_triangles() -> FloatArray:
    """Returns the cube of side 1 about the origin, (12, 3, 3), counter-clockwise seen from outside."""
    triangles = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            corners = np.full((4, 3), sign)
            corners[:, (axis + 1) % 3] = (-0.5, 0.5, 0.5, -0.5)
            corners[:, (axis + 2) % 3] = (-0.5, -0.5, 0.5, 0.5)
            triangles += [corners[[0, 1, 2][:: 1 if sign > 0 else -1]], corners[[0, 2, 3][:: 1 if sign > 0 else -1]]]
    return np.array(triangles)


def sphere_triangles() -> FloatArray:
    """Returns the sphere of radius 1 about the origin, (F, 3, 3)."""
    return _revolved(_arc(-0.5, 0.5))


def cylinder_triangles(radius: float, length: float) -> FloatArray:
    """Returns a cylinder about the origin along z, (F, 3, 3)."""
    half = length / 2
    return _revolved([(0.0, -half), (radius, -half), (radius, half), (0.0, half)])


def capsule_triangles(radius: float, length: float) -> FloatArray:
    """Returns a cylinder of that length along z with half a sphere on each end, (F, 3, 3)."""
    end = [(radius * r, radius * z - length / 2) for r, z in _arc(-0.5, 0.0)]
    return _revolved(end + [(r, -z) for r, z in reversed(end)])


def _arc(start: float, end: float) -> list[tuple[float, float]]:
    """Points (radius, height) of the circle of radius 1 between two angles above the horizon, shares of pi."""
    num = round(_SEGMENTS / 2 * (end - start))
    angles = [math.pi * (start + (end - start) * k / num) for k in range(num + 1)]
    return [(0.0 if abs(angle) > math.pi / 2 - 1e-9 else math.cos(angle), math.sin(angle)) for angle in angles]


def _revolved(profile: Sequence[tuple[float, float]]) -> FloatArray:
    """Turns a profile from the lower pole to the upper one about z, (F, 3, 3), counter-clockwise seen from outside."""
    angles = 2 * math.pi * np.arange(_SEGMENTS) / _SEGMENTS
    around = np.round([np.cos(angles), np.sin(angles), np.zeros(_SEGMENTS)], 15).T  # the zeros of the cosine are exact
    triangles: list[FloatArray] = []
    for (r0, z0), (r1, z1) in itertools.pairwise(profile):
        low, high = around * r0 + (0.0, 0.0, z0), around * r1 + (0.0, 0.0, z1)
        next_low, next_high = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
        if r0 > 0:
            triangles.append(np.stack([low, next_low, next_high if r1 > 0 else high], axis=1))
        if r1 > 0:
            triangles.append(np.stack([low, next_high, high], axis=1))
    return np.concatenate(triangles)
