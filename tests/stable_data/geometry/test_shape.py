"""A shape is the mesh at its scale and tilt, centred on its box in the yaw frame."""

import igl
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape, winding_number
from stable_data.scene import UPRIGHT
from tests.scenes import ball, bowl, box, sheet, tilted, triangles

angles = st.floats(-3.1, 3.1)
lengths = st.floats(0.01, 2.0)


@settings(deadline=None)
@given(scale=st.tuples(lengths, lengths, lengths), angle=angles)
def test_a_scaled_and_tilted_mesh_is_centred_on_its_box(scale: tuple[float, float, float], angle: float) -> None:
    quat = (np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2))
    corner = Mesh(box(1, 1, 1).vertices + np.array([3.0, -2.0, 1.0]), box(1, 1, 1).faces)
    shape = Shape.from_mesh(corner, scale, quat)
    assert shape.vertices.min(axis=0) == pytest.approx(-shape.vertices.max(axis=0), abs=1e-12)
    x, y, z = scale
    c, s = abs(np.cos(angle)), abs(np.sin(angle))
    assert shape.size == pytest.approx([x, c * y + s * z, s * y + c * z])


def test_tilt_comes_after_scale() -> None:
    shape = Shape.from_mesh(
        Mesh(box(1, 1, 1).vertices, box(1, 1, 1).faces), (0.1, 0.2, 0.3), (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    )
    assert shape.size == pytest.approx([0.1, 0.3, 0.2])


@settings(deadline=None)
@given(x=st.floats(-2, 2), z=st.floats(-1, 1), yaw=angles)
def test_posing_turns_about_z_and_moves(x: float, z: float, yaw: float) -> None:
    shape = ball(0.1, 1)
    c, s = np.cos(yaw), np.sin(yaw)
    expected = shape.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + np.array([x, -x, z])
    assert shape.posed((x, -x, z, yaw)) == pytest.approx(expected, abs=1e-12)


def test_an_object_at_yaw_0_faces_the_viewer_and_turns_counter_clockwise() -> None:
    front = Shape(np.array([[0, -1, 0], [0, 1, 0], [0, 0, 1]], float), np.array([[0, 1, 2]]))
    assert front.posed((0, 0, 0, np.pi / 2))[0] == pytest.approx([1, 0, 0])


def test_the_footprint_is_the_counter_clockwise_outline_from_above() -> None:
    footprint = tilted(box(0.2, 0.1, 0.1), 45).footprint
    x, y = footprint.T
    area = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    assert area == pytest.approx(0.2 * 0.1 * np.sqrt(2))
    assert not np.array_equal(footprint[0], footprint[-1])


@given(yaw=angles)
def test_the_posed_footprint_surrounds_the_posed_vertices(yaw: float) -> None:
    shape, pose = bowl(0.1, 0.01), (0.3, -0.2, 0.5, yaw)
    outline = shape.posed_footprint(pose)
    points = shape.posed(pose)[:, :2]
    assert outline.min(axis=0) == pytest.approx(points.min(axis=0))
    assert outline.max(axis=0) == pytest.approx(points.max(axis=0))


def test_a_sheet_on_its_edge_keeps_a_hairs_breadth() -> None:
    footprint = tilted(sheet(0.2, 0.1), 90).footprint
    assert len(footprint) >= 4
    assert np.ptp(footprint, axis=0) == pytest.approx([0.2, 0.0], abs=3e-5)


def test_a_stand_in_is_a_box_that_knows_it_is_not_exact() -> None:
    stand_in = Shape.box((0.1, 0.2, 0.3))
    assert not stand_in.is_exact
    assert Shape.from_mesh(Mesh(stand_in.vertices, stand_in.faces), (1, 1, 1), UPRIGHT).is_exact
    assert stand_in.size == pytest.approx([0.1, 0.2, 0.3])
    volume = np.linalg.det(triangles(stand_in)).sum() / 6
    assert volume == pytest.approx(0.1 * 0.2 * 0.3)


def test_winding_is_one_inside_and_zero_outside_of_a_closed_mesh() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.03, 0.02, -0.01], [0.2, 0.0, 0.0], [0.0, 0.0, 0.051]])
    assert winding_number(points, triangles(box(0.1, 0.1, 0.1))) == pytest.approx([1, 1, 0, 0], abs=1e-9)


def test_the_hollow_of_a_bowl_is_outside() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.0375]])
    assert winding_number(points, triangles(bowl(0.08, 0.005))) == pytest.approx([0, 1], abs=1e-9)


def test_winding_agrees_with_an_independent_library_on_an_open_mesh() -> None:
    shape = Shape(ball(0.1).vertices, ball(0.1).faces[100:])
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (50, 3))
    assert winding_number(points, triangles(shape)) == pytest.approx(
        igl.winding_number(shape.vertices, shape.faces, points), abs=1e-6
    )
