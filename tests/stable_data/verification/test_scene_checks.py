"""The size of a tilted object has bounds that follow from the box of its mesh."""

import math

import numpy as np
import pytest

from stable_data.scene import SceneObject, Vec3
from stable_data.verification.scene_checks import _size_faults

BOX = np.array([0.1, 0.2, 0.3])
ON_ITS_SIDE = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
LEANING = (math.sin(0.25), 0.0, 0.0, math.cos(0.25))


@pytest.mark.parametrize(
    ("tilt", "size", "is_possible"),
    [
        (ON_ITS_SIDE, (0.1, 0.3, 0.2), True),
        (ON_ITS_SIDE, (0.1, 0.2, 0.3), False),  # as if it stood
        (ON_ITS_SIDE, (0.3, 0.9, 0.6), False),
        (LEANING, (0.1, 0.30, 0.34), True),
        (LEANING, (0.1, 0.2, 0.3), True),  # a round object does not grow
        (LEANING, (0.03, 0.1, 0.1), False),
        (LEANING, (0.1, 0.30, 0.5), False),
    ],
)
def test_a_size_follows_from_the_box_and_the_tilt(
    tilt: tuple[float, float, float, float], size: Vec3, is_possible: bool
) -> None:
    o = SceneObject("box_0", "box", (0.0, 0.0, 0.1), 0.0, size, asset_id="box", scale=(1.0, 1.0, 1.0), tilt_quat_xyzw=tilt)
    assert (list(_size_faults(o, BOX)) == []) is is_possible
