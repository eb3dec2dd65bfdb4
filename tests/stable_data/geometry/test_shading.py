"""Normals are smooth on round things and have a step at sharp edges."""

import numpy as np
import pytest
import trimesh

from stable_data.geometry.shading import corner_normals, split_at_creases, welded_corners

pytestmark = pytest.mark.sim


def test_normals_of_a_ball_point_away_from_its_centre() -> None:
    triangles = np.asarray(trimesh.creation.icosphere(3).triangles)
    np.testing.assert_allclose(corner_normals(triangles), triangles, atol=0.02)


def test_normals_of_a_cube_are_those_of_its_sides() -> None:
    cube = trimesh.creation.box()
    normals = corner_normals(np.asarray(cube.triangles))
    np.testing.assert_allclose(normals, np.repeat(cube.face_normals[:, None], 3, axis=1), atol=1e-12)


def test_a_cylinder_is_round_on_its_side_and_flat_on_top() -> None:
    mesh = trimesh.creation.cylinder(1.0, 2.0, sections=32)
    triangles = np.asarray(mesh.triangles)
    normals, is_side = corner_normals(triangles), np.abs(mesh.face_normals[:, 2]) < 0.5
    outward = triangles[is_side] * [1, 1, 0]
    np.testing.assert_allclose(normals[is_side], outward / np.linalg.norm(outward, axis=2, keepdims=True), atol=0.1)
    np.testing.assert_allclose(normals[is_side][..., 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(normals[~is_side][..., 2]), 1.0, atol=1e-9)


def test_faces_that_are_turned_over_share_no_normal() -> None:
    triangles = np.asarray(trimesh.creation.icosphere(2).triangles).copy()
    triangles[::7] = triangles[::7, ::-1]
    normals = corner_normals(triangles)
    facing = (normals * triangles).sum(axis=2)
    assert (facing[::7] < -0.9).all()
    assert (np.delete(facing, slice(None, None, 7), axis=0) > 0.9).all()


def test_a_triangle_without_area_has_a_normal() -> None:
    np.testing.assert_array_equal(corner_normals(np.zeros((1, 3, 3))), [[[0.0, 0.0, 1.0]] * 3])
    vertices, faces = split_at_creases(*welded_corners(np.eye(3)[None]))
    assert (len(vertices), faces.shape) == (3, (1, 3))
