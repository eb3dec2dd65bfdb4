"""What has fallen over, and how it is put upright."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stable_data.importers.scenes import convex_solids
from stable_data.importers.scenes.standing import resting_faces, uprighting
from stable_data.rotations import quat_of
from stable_data.scene import FloatArray, QuatXyzw

BOTTLE = convex_solids.cylinder(0.03, 0.1).vertices
CARTON = convex_solids.box(np.array([0.03, 0.08, 0.12])).vertices
MIDDLE = np.zeros(3)


def turned(degrees: float) -> QuatXyzw:
    return quat_of(Rotation.from_euler("x", degrees, degrees=True))


def up_after(vertices: FloatArray, degrees: float, **options: object) -> float | None:
    """The angle of the body's z axis from the vertical after the turn, degrees; None if nothing is turned."""
    found = uprighting(vertices, MIDDLE, turned(degrees), **options)  # type: ignore[arg-type]
    if found is None:
        return None
    axis = (found.rotation * Rotation.from_quat(turned(degrees))).apply([0.0, 0.0, 1.0])
    return math.degrees(math.acos(np.clip(axis[2], -1, 1)))


def test_resting_faces_of_a_box_have_their_tipping_angles() -> None:
    faces = resting_faces(CARTON, MIDDLE)
    assert len(faces) == 6
    angles = {tuple(np.abs(face.normal).round(6)): face.tipping for face in faces}
    assert angles[0, 0, 1] == pytest.approx(math.atan2(0.03, 0.12))
    assert angles[1, 0, 0] == pytest.approx(math.atan2(0.08, 0.03))


def test_a_face_with_the_centre_of_mass_beside_it_is_no_rest() -> None:
    normals = [face.normal.round(6).tolist() for face in resting_faces(BOTTLE, np.array([0.04, 0.0, 0.0]))]
    assert [0, 0, -1] not in normals


def test_a_bottle_that_lies_is_put_upright() -> None:
    for degrees in (40, 90, 100):
        assert up_after(BOTTLE, degrees) == pytest.approx(0, abs=0.1)


def test_what_stands_stays_and_what_leans_is_levelled() -> None:
    assert up_after(BOTTLE, 0) is None
    assert up_after(BOTTLE, 6) == pytest.approx(0, abs=0.1)
    assert up_after(BOTTLE, 6, is_at_rest=True) is None


def test_a_carton_may_lie_but_a_bottle_may_not() -> None:
    assert up_after(CARTON, 90) is None
    assert up_after(CARTON, 90, stands_on_end=True) == pytest.approx(0, abs=0.1)
    assert up_after(CARTON, 90, mode="body") == pytest.approx(0, abs=0.1)
    assert up_after(CARTON, 90, stands_on_end=True, mode="keep") is None


def test_hollow_things_open_upwards() -> None:
    def opens_up(down: FloatArray) -> bool:
        return bool(down[2] < -0.9)

    assert up_after(CARTON, 90, opens_up=opens_up) == pytest.approx(0, abs=0.1)
    assert up_after(CARTON, 180, opens_up=opens_up) is None  # upside down may be meant


def test_another_pose_of_the_file_tells_how_it_stands() -> None:
    wide = convex_solids.cylinder(0.06, 0.05).vertices
    assert up_after(wide, 90, known_quats=(turned(0),)) == pytest.approx(0, abs=0.1)


def test_a_ball_stays() -> None:
    ball = convex_solids.ellipsoid(np.full(3, 0.03)).vertices
    assert up_after(ball, 40) is None
