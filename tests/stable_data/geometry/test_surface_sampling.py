"""Samples: on the surface, evenly spread in every prefix, and of the bottom region alone."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.surface_sampling import bottom_points, sample_surface, surface_points
from stable_data.scene import FloatArray

BALL = Mesh(*(lambda m: (np.array(m.vertices), np.array(m.faces)))(trimesh.creation.icosphere(subdivisions=4)))
BOX = Mesh(*(lambda m: (np.array(m.vertices), np.array(m.faces)))(trimesh.creation.box((0.1, 0.2, 0.3))))


def test_points_lie_on_the_surface_with_their_normals() -> None:
    points, normals = surface_points(BALL, 512)
    assert points.dtype == normals.dtype == np.float32
    assert points.shape == normals.shape == (512, 3)
    assert np.allclose(np.linalg.norm(points, axis=1), 1, atol=5e-3)
    assert np.allclose(np.einsum("ij,ij->i", points, normals), 1, atol=5e-3)


def test_every_prefix_is_evenly_spread() -> None:
    points, _ = surface_points(BALL, 512)
    probes = BALL.vertices
    for num in (16, 64, 512):
        reach = np.linalg.norm(probes[:, None] - points[None, :num], axis=2).min(axis=1).max()
        assert reach < 3.4 / np.sqrt(num)  # a hexagonal cover of the unit ball needs about 2.2 / sqrt(num)


def test_the_same_seed_gives_the_same_points() -> None:
    whole, _ = surface_points(BALL, 256, np.random.default_rng(3))
    again, _ = surface_points(BALL, 256, np.random.default_rng(3))
    other, _ = surface_points(BALL, 256, np.random.default_rng(4))
    assert np.array_equal(whole, again)
    assert not np.array_equal(whole, other)


def test_points_fall_by_area() -> None:
    points = sample_surface(BOX, 4000)
    share = (np.abs(points[:, 2]) > 0.15 - 1e-9).mean()
    assert share == pytest.approx(2 * 0.02 / (2 * (0.02 + 0.03 + 0.06)), abs=0.01)


def test_nothing_can_be_sampled_from_a_needle() -> None:
    needle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    with pytest.raises(MeshError, match="no area"):
        surface_points(needle)


def test_bottom_of_a_box_is_its_floor_with_its_corners() -> None:
    points = bottom_points(BOX.vertices, BOX.faces, 64)
    assert points.shape == (64, 3)
    assert points.dtype == np.float32
    assert points[:, 2].max() < -0.15 + 0.01 + 1e-6
    assert (points[:, 2] < -0.15 + 1e-6).mean() > 0.6
    for corner in BOX.vertices[BOX.vertices[:, 2] < 0]:
        assert np.linalg.norm(points - corner, axis=1).min() < 1e-6


def test_bottom_of_a_tilted_box_is_its_lowest_edge() -> None:
    turned = BOX.vertices @ trimesh.transformations.rotation_matrix(0.5, [0, 1, 0])[:3, :3].T
    points = bottom_points(turned, BOX.faces, 64, band=0.005)
    assert points[:, 2].min() == pytest.approx(turned[:, 2].min(), abs=1e-7)
    assert points[:, 2].max() <= turned[:, 2].min() + 0.005 + 1e-7
    assert np.ptp(points[:, 1]) == pytest.approx(0.2, abs=1e-6)


def test_bottom_follows_the_object_when_it_moves() -> None:
    shift = np.array([1.0, 2.0, 3.0])
    moved = bottom_points(BALL.vertices + shift, BALL.faces, 32)
    assert np.allclose(moved - shift, bottom_points(BALL.vertices, BALL.faces, 32), atol=1e-5)


def test_unused_vertices_do_not_count_as_bottom() -> None:
    vertices = np.concatenate([BOX.vertices, [[0.0, 0.0, -9.0]]])
    assert bottom_points(vertices, BOX.faces, 16)[:, 2].min() == pytest.approx(-0.15)


def test_a_sheet_on_edge_still_has_a_bottom() -> None:
    upright = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    points = bottom_points(upright, np.array([[0, 1, 2], [0, 2, 3]]), 16, band=0.0)
    assert points.shape == (16, 3)
    assert np.allclose(points[:, 1:], 0)


def corners() -> st.SearchStrategy[FloatArray]:
    number = st.floats(-1, 1, width=32)
    return st.lists(st.tuples(number, number, number), min_size=6, max_size=12).map(lambda rows: np.array(rows, np.float64))


@settings(max_examples=60, deadline=None)
@given(corners(), st.floats(1e-3, 2.0))
def test_bottom_points_lie_in_the_band_on_the_surface(vertices: FloatArray, band: float) -> None:
    faces = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    points = bottom_points(vertices, faces, 24, band=band)
    low = vertices[faces.ravel(), 2].min()
    assert points.shape == (24, 3)
    assert points[:, 2].min() == pytest.approx(low, abs=1e-6)
    assert (points[:, 2] <= low + band + 1e-5).all()
