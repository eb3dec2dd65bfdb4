"""Exact signed distance, grids of it, and the atlas: analytic shapes, identities, one real mug."""

from pathlib import Path

import manifold3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_glb
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.geometry.sdf.build import build_grid, probe_points, unit_mesh, wall_thickness
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.sdf.grid import GridAtlas, GridLimits, SdfGrid, sample_grid
from stable_data.geometry.sdf.narrow_band import distance_to_faces
from stable_data.scene import FloatArray

SMALL = GridLimits(min_nodes=20**3, max_nodes=28**3)


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    given = solid.to_mesh()
    return Mesh(np.asarray(given.vert_properties, np.float64)[:, :3], np.asarray(given.tri_verts, np.int64))


def sphere(radius: float = 0.5) -> Mesh:
    return mesh_of(manifold3d.Manifold.sphere(radius, 128))


def box(*size: float) -> Mesh:
    return mesh_of(manifold3d.Manifold.cube(size, True))


def bowl(outer: float = 0.5, wall: float = 0.06) -> Mesh:
    ball = manifold3d.Manifold.sphere(outer, 96) - manifold3d.Manifold.sphere(outer - wall, 96)
    return mesh_of(ball.trim_by_plane((0.0, 0.0, -1.0), 0.0))


def sheet() -> Mesh:
    corners = np.array([[-0.5, -0.3, 0.0], [0.5, -0.3, 0.0], [0.5, 0.3, 0.0], [-0.5, 0.3, 0.0]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def box_distance(points: FloatArray, size: FloatArray) -> FloatArray:
    q = np.abs(points) - size / 2
    found: FloatArray = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    return found


@pytest.fixture(scope="module")
def grids() -> list[SdfGrid]:
    return [build_grid(m, limits=SMALL) for m in (sphere(), box(0.4, 1.0, 0.2), bowl())]


def test_sphere_is_radius_minus_distance_from_its_centre(rng: np.random.Generator) -> None:
    points = rng.uniform(-1, 1, (500, 3))
    found = SignedDistance(sphere())(points)
    np.testing.assert_allclose(found, np.linalg.norm(points, axis=1) - 0.5, atol=4e-4)  # of 128 segments


def test_box_agrees_with_its_formula(rng: np.random.Generator) -> None:
    size = np.array([0.4, 1.0, 0.2])
    points = rng.uniform(-1, 1, (500, 3))
    np.testing.assert_allclose(SignedDistance(box(*size))(points), box_distance(points, size), atol=1e-6)


def test_hollow_of_a_bowl_is_outside_and_its_wall_inside() -> None:
    exact = SignedDistance(bowl())
    np.testing.assert_allclose(exact(np.array([[0, 0, -0.2], [0, 0, -0.47], [0, 0, -0.6]])), [0.24, -0.03, 0.1], atol=2e-3)


def test_sheet_is_a_shell_of_the_thickness_given() -> None:
    exact = SignedDistance(sheet(), is_sheet=True, shell_thickness=0.02)
    np.testing.assert_allclose(exact(np.array([[0, 0, 0.0], [0, 0, 0.05], [0.1, 0.1, -0.01]])), [-0.01, 0.04, 0.0], atol=1e-12)


def test_sign_survives_a_tenth_of_the_faces_turned(rng: np.random.Generator) -> None:
    mesh = bowl()
    faces = mesh.faces.copy()
    turned = rng.choice(len(faces), len(faces) // 10, replace=False)
    faces[turned] = faces[turned, ::-1]
    points = rng.uniform(-0.6, 0.6, (2000, 3))
    truth = SignedDistance(mesh)(points)
    is_clear = np.abs(truth) > 0.01
    wrong = SignedDistance(Mesh(mesh.vertices, faces))(points) * truth < 0
    assert wrong[is_clear].mean() < 0.02


@settings(max_examples=20, deadline=None)
@given(st.floats(1e-3, 1e3), st.integers(0, 2**31))
def test_distance_scales_with_the_mesh(scale: float, seed: int) -> None:
    mesh = box(0.4, 1.0, 0.2)
    points = np.random.default_rng(seed).uniform(-1, 1, (50, 3))
    scaled = SignedDistance(Mesh(scale * mesh.vertices, mesh.faces))(scale * points)
    np.testing.assert_allclose(scaled, scale * SignedDistance(mesh)(points), rtol=1e-9, atol=1e-12 * scale)


def test_grid_of_a_scaled_mesh_is_the_same_grid_read_at_that_scale(rng: np.random.Generator) -> None:
    mesh = bowl()
    small, large = build_grid(mesh, limits=SMALL), build_grid(Mesh(8 * mesh.vertices, mesh.faces), limits=SMALL)
    np.testing.assert_array_equal(small.values, large.values)
    assert large.extent == pytest.approx(8 * small.extent)
    points = rng.uniform(-0.7, 0.7, (100, 3))
    at_one = sample_grid(small, points)[0]
    np.testing.assert_allclose(sample_grid(small, 3 * points, 3.0)[0], 3 * at_one, rtol=1e-12, atol=1e-15)


def test_grid_at_an_aspect_is_the_grid_of_the_stretched_mesh() -> None:
    mesh, aspect = bowl(), (1.0, 0.5, 0.8)
    stretched = Mesh(mesh.vertices * aspect, mesh.faces)
    np.testing.assert_array_equal(
        build_grid(mesh, aspect=aspect, limits=SMALL).values, build_grid(stretched, limits=SMALL).values
    )


@pytest.mark.parametrize("mesh", [sphere(), box(0.4, 1.0, 0.2), box(1.0, 0.5, 0.02), bowl()])
def test_grid_nodes_are_exact_near_the_surface_and_within_a_spacing_elsewhere(mesh: Mesh) -> None:
    grid = build_grid(mesh, limits=SMALL)
    unit, _ = unit_mesh(mesh)
    nodes = grid.origin + grid.spacing * np.indices(grid.values.shape).reshape(3, -1).T
    truth = SignedDistance(unit)(nodes)
    found = grid.values.ravel().astype(np.float64)
    is_near = np.abs(truth) <= grid.spacing / 2
    np.testing.assert_allclose(found[is_near], truth[is_near], rtol=1e-3, atol=1e-6)
    assert np.abs(found - truth).max() < grid.spacing
    is_off = np.abs(truth) > 1e-6
    np.testing.assert_array_equal((found < 0)[is_off], (truth < 0)[is_off])


def test_measured_errors_hold_for_other_points(rng: np.random.Generator, grids: list[SdfGrid]) -> None:
    size = np.array([0.4, 1.0, 0.2])
    points = rng.uniform(-0.5, 0.5, (4000, 3)) * (size + 0.1)
    truth = box_distance(points, size)
    error = np.abs(sample_grid(grids[1], points)[0] - truth)
    is_near = np.abs(truth) < grids[1].spacing
    assert error[is_near].mean() < 1.5 * grids[1].mean_error
    assert error.max() < grids[1].spacing
    assert grids[1].sign_error == 0


def test_grid_follows_the_wall_within_its_limits() -> None:
    thin = build_grid(bowl(wall=0.06))
    assert thin.wall_thickness == pytest.approx(0.06, rel=0.1)
    assert thin.spacing <= 0.06 / 3 + 1e-9
    assert thin.values.size <= GridLimits().max_nodes
    coarse = build_grid(bowl(wall=0.06), limits=SMALL)
    assert coarse.values.size <= SMALL.max_nodes


def test_wall_thickness_of_a_plate_is_its_height() -> None:
    assert wall_thickness(SignedDistance(box(1.0, 0.8, 0.05))) == pytest.approx(0.05, rel=1e-3)


def test_surface_of_a_sheet_reads_as_inside_its_shell() -> None:
    grid = build_grid(sheet(), is_sheet=True, shell_thickness=1e-3, limits=SMALL)
    points, _ = probe_points(sheet(), 500)
    assert grid.shell_thickness >= grid.spacing
    assert sample_grid(grid, points)[0].max() <= 1e-3 * grid.spacing


def test_build_is_deterministic() -> None:
    np.testing.assert_array_equal(build_grid(bowl(), limits=SMALL).values, build_grid(bowl(), limits=SMALL).values)


def test_atlas_reads_what_each_grid_reads(rng: np.random.Generator, grids: list[SdfGrid]) -> None:
    atlas = GridAtlas.from_grids(grids)
    points, index = rng.uniform(-1, 1, (300, 3)), rng.integers(0, len(grids), 300)
    scale = rng.uniform(0.5, 2, 300)
    found, gradient = atlas.sample_with_gradient(index, points, scale)
    for i in range(300):
        one, slope = sample_grid(grids[index[i]], points[i : i + 1], float(scale[i]))
        np.testing.assert_array_equal(found[i], one[0])
        np.testing.assert_array_equal(gradient[i], slope[0])
    np.testing.assert_array_equal(atlas.sample(index, points, scale), found)
    assert len(atlas) == len(grids)
    assert atlas.values.dtype == np.float16


def test_atlas_reads_the_nodes_themselves(grids: list[SdfGrid]) -> None:
    for grid in grids:
        nodes = grid.origin + grid.spacing * np.indices(grid.values.shape).reshape(3, -1).T
        np.testing.assert_allclose(sample_grid(grid, nodes)[0], grid.values.ravel().astype(np.float64), atol=1e-9)


def test_empty_atlas_and_no_points_are_fine(grids: list[SdfGrid]) -> None:
    assert len(GridAtlas.from_grids([])) == 0
    found, gradient = sample_grid(grids[0], np.zeros((0, 3)))
    assert found.shape == (0,)
    assert gradient.shape == (0, 3)


def test_gradient_is_the_derivative_inside_and_outside_the_box(rng: np.random.Generator, grids: list[SdfGrid]) -> None:
    step = 1e-7
    for grid in grids:
        points = rng.uniform(-1, 1, (400, 3))
        gradient = sample_grid(grid, points, 1.3)[1]
        difference = [sample_grid(grid, points + e, 1.3)[0] - sample_grid(grid, points - e, 1.3)[0] for e in step * np.eye(3)]
        np.testing.assert_allclose(gradient, np.stack(difference, axis=1) / (2 * step), atol=1e-5)


def test_gradient_points_out_of_a_sphere(rng: np.random.Generator, grids: list[SdfGrid]) -> None:
    away = rng.normal(size=(200, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    gradient = sample_grid(grids[0], 0.5 * away)[1]
    assert (gradient * away).sum(axis=1).min() > 0.93


def test_reading_outside_the_box_is_never_short(rng: np.random.Generator, grids: list[SdfGrid]) -> None:
    points = 3 * rng.normal(size=(500, 3))
    found = sample_grid(grids[0], points)[0]
    truth = np.linalg.norm(points, axis=1) - 0.5
    is_far = np.abs(points).max(axis=1) > 0.7
    assert (found - truth)[is_far].min() > -grids[0].spacing


def test_distance_to_faces_agrees_with_the_tree(rng: np.random.Generator) -> None:
    triangles = rng.normal(size=(200, 3, 3))
    triangles[0, 1] = triangles[0, 0]  # a segment
    points = rng.normal(size=(200, 3))
    faces = np.arange(3)[None]
    truth = [SignedDistance(Mesh(t, faces)).nearest(p[None])[0][0] for t, p in zip(triangles, points, strict=True)]
    np.testing.assert_allclose(distance_to_faces(points, triangles), truth, atol=1e-9)


def test_no_faces_and_no_extent_are_refused() -> None:
    with pytest.raises(MeshError, match="0 faces"):
        SignedDistance(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64)))
    with pytest.raises(MeshError, match="extent"):
        build_grid(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))
    with pytest.raises(MeshError, match="shell thickness"):
        build_grid(sheet(), is_sheet=True, shell_thickness=-1.0)


def test_hollow_of_real_open_vessels_is_outside(real_data: Path) -> None:
    vessels = []
    for path in sorted((real_data / "Assets_library").glob("*.glb"))[::3]:
        mesh, report, _ = repair_mesh(load_glb(path, path.stem)[0], path.stem)
        unit, _ = unit_mesh(mesh)
        above = SignedDistance(unit).first_hit(np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]]))[0]
        depth = unit.vertices[:, 2].max() - (1 - above)
        if np.isfinite(above) and depth > 0.3:
            vessels.append((unit, report.is_sheet, depth))
    assert len(vessels) >= 3
    for unit, is_sheet, depth in vessels:
        grid = build_grid(unit, is_sheet=is_sheet)
        inside_hollow = np.array([[0.0, 0.0, unit.vertices[:, 2].max() - depth / 2]])
        assert sample_grid(grid, inside_hollow)[0][0] > 0
        assert grid.sign_error < 0.01


@pytest.mark.parametrize("share", [0.01, 0.1, 0.3])
def test_grid_of_a_mesh_with_a_hole_has_the_sides_of_its_winding_number(share: float) -> None:
    mesh = sphere()
    height = mesh.triangles[:, :, 0].mean(axis=1)
    holed = Mesh(mesh.vertices, mesh.faces[height < np.quantile(height, 1 - share)])
    unit, _ = unit_mesh(holed)
    grid = build_grid(holed, limits=SMALL)
    nodes = grid.origin + grid.spacing * np.indices(grid.values.shape).reshape(3, -1).T
    inside = SignedDistance(unit).is_inside(nodes).reshape(grid.values.shape)
    wrong = (grid.values < 0) != inside
    assert wrong.mean() < 2e-3


def test_grid_of_a_mesh_with_turned_faces_has_the_sides_of_its_winding_number(rng: np.random.Generator) -> None:
    mesh = bowl()
    faces = mesh.faces.copy()
    turned = rng.choice(len(faces), len(faces) // 10, replace=False)
    faces[turned] = faces[turned, ::-1]
    grid = build_grid(Mesh(mesh.vertices, faces), limits=SMALL)
    right = build_grid(mesh, limits=SMALL)
    is_clear = np.abs(right.values) > 0.5 * right.spacing
    assert ((grid.values < 0) != (right.values < 0))[is_clear].mean() < 0.01
