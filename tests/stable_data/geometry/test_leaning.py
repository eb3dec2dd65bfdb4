"""Objects that lean in containers."""

import math

import numpy as np
import pytest

from stable_data.geometry.leaning import FOOT_CLEARANCE, feet_radius, leaning_tilt
from stable_data.rotations import rotation_matrix


@pytest.mark.parametrize("degrees", [0.0, 20.0, 75.0])
def test_an_upright_object_leans_by_the_angle_towards_the_viewer(degrees: float) -> None:
    angle = math.radians(degrees)
    top = rotation_matrix(leaning_tilt(angle)) @ (0.0, 0.0, 1.0)
    assert top == pytest.approx([0.0, -math.sin(angle), math.cos(angle)])


@pytest.mark.parametrize("count", [2, 3, 7])
def test_feet_stand_side_by_side(count: int) -> None:
    angles = 2 * np.pi * np.arange(2) / count
    first, second = feet_radius(0.004, count) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert math.dist(first, second) == pytest.approx(2 * (0.004 + FOOT_CLEARANCE))
