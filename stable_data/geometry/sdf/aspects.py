"""Aspects of scales, rounded: a mesh has one grid for all scales with the same steps. Needs only the standard library."""

import math

from stable_data.scene import Vec3

ASPECT_STEP = math.log(1.05)
"""Aspects are rounded to powers of 1.05, so that assets with similar scales share a grid."""


def aspect_steps(scale: Vec3) -> tuple[int, int, int]:
    """Returns the aspect of a scale, rounded to 5 %: the number of factors 1.05 between each axis and the largest one."""
    largest = max(scale)
    x, y, z = (round(math.log(largest / s) / ASPECT_STEP) for s in scale)
    return x, y, z


def aspect_of(steps: tuple[int, int, int]) -> Vec3:
    """Returns the aspect of the steps of :func:`aspect_steps`, (3,), with 1 as its largest component."""
    x, y, z = (math.exp(-ASPECT_STEP * k) for k in steps)
    return x, y, z
