"""Where a camera stands so that it shows a scene."""

import numpy as np

from stable_data.scene import Vec3
from stable_data.simulation.scene_geometry import SceneGeometry

_HALF_FIELD = 0.31  # tangent of half the field of view along the shorter side of the picture, with a margin
_LEGS = 0.05  # how much of what is below the table top counts, metres: the rest may leave the picture


def looked_at(geometry: SceneGeometry) -> tuple[Vec3, float]:
    """Returns the point that a camera looks at and its distance from there, metres: objects and table top fill the picture."""
    low, high = (corner.copy() for corner in geometry.seen_bounds)
    low[2] = max(low[2], -_LEGS)
    x, y, z = ((low + high) / 2).tolist()
    return (x, y, z), float(np.linalg.norm(high - low)) / 2 / _HALF_FIELD
