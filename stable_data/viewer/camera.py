"""Where a camera stands so that it shows a scene."""

import math
from dataclasses import dataclass

import numpy as np

from stable_data.scene import Vec3
from stable_data.simulation.scene_geometry import SceneGeometry

_HALF_FIELD = 0.31  # tangent of half the field of view along the shorter side of the picture, with a margin
_LEGS = 0.05  # how much of what is below the table top counts, metres: the rest may leave the picture
_POLAR, _POLAR_UNDER = 58.0, 78.0  # degrees; the second looks below a ceiling, such as the next board of a shelf
_AZIMUTH = -18.0  # degrees from the front, to the left


@dataclass(frozen=True, slots=True)
class ViewPoint:
    """What a camera looks at and from where: objects and table top fill the picture.

    Attributes:
        target: The point that it looks at, metres, frame of the scene.
        distance: Its distance from there, metres.
        azimuth: Its direction from there about +z, from the front, degrees; positive to the right.
        polar: The angle between that direction and +z, degrees.
    """

    target: Vec3
    distance: float
    azimuth: float
    polar: float

    @property
    def eye(self) -> Vec3:
        """Where the camera stands, metres, frame of the scene."""
        x, y, z = self.target
        azimuth, polar = math.radians(self.azimuth), math.radians(self.polar)
        flat = self.distance * math.sin(polar)
        return x + flat * math.sin(azimuth), y - flat * math.cos(azimuth), z + self.distance * math.cos(polar)


def view_point(geometry: SceneGeometry) -> ViewPoint:
    """Returns where a camera stands that shows a scene from the front."""
    low, high = (corner.copy() for corner in geometry.seen_bounds)
    low[2] = max(low[2], -_LEGS)
    x, y, z = ((low + high) / 2).tolist()
    polar = _POLAR if geometry.scene.table.clearance is None else _POLAR_UNDER
    return ViewPoint((x, y, z), float(np.linalg.norm(high - low)) / 2 / _HALF_FIELD, _AZIMUTH, polar)
