"""Shapes in their yaw frames: distances against the exact ones, samples on the surface, each shape and grid once."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from models.physics_corrector.geometry.shape_tensors import STRETCH, ShapeCollector, grids_from_rows
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.aspects import aspect_of, aspect_steps
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.shape import Shape
from stable_data.scene import UPRIGHT, QuatXyzw, SceneObject, Vec3
from stable_data.storage.table_rows import arrow_table
from tests.models.physics_corrector.geometry.shapes import store, table, thing

OBLIQUE: QuatXyzw = tuple(Rotation.from_euler("xyz", (30, 50, 70), degrees=True).as_quat().tolist())
HALF_A_STEP = 1.05**0.49
"""Where snapping the aspect leaves the most."""


def index_of(o: SceneObject) -> tuple[int, Shape]:
    """An object's place in the table of all tests, and its exact shape."""
    shape, notices = store().shape(o)
    assert not notices
    return table().index(o, shape), shape


@pytest.mark.parametrize(
    ("name", "scale", "tilt"),
    [
        ("bowl", (1.0, 1.0, 1.0), UPRIGHT),
        ("bowl", (1.3, 1.3, 1.3), OBLIQUE),
        ("cube", (0.5, 0.5, 0.5), OBLIQUE),
        ("cube", (HALF_A_STEP, 1.0, 2.0), OBLIQUE),
        ("ball", (1.0, 1.0, HALF_A_STEP), OBLIQUE),
    ],
)
def test_a_distance_is_the_exact_one_within_the_grids_error(name: str, scale: Vec3, tilt: QuatXyzw) -> None:
    index, shape = index_of(thing(name, (0, 0, 0, 0), scale=scale, tilt=tilt))
    exact = SignedDistance(Mesh(shape.vertices, shape.faces))
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (4000, 3)) * shape.size
    truth = exact(points)
    geometry = table().geometry()
    read = geometry.signed_distance(torch.full((4000,), index), torch.from_numpy(points)).numpy()
    grid = store().grid(name, scale)
    metres = grid.extent * max(scale)
    # The stated errors are sampled; what snapping leaves is a share of the distance.
    error = np.abs(read - truth) - (STRETCH - 1) * np.abs(truth)
    near = np.abs(truth) < metres * grid.spacing
    assert error[near].mean() <= 1.2 * metres * grid.mean_error
    assert error[near].max() <= 1.5 * metres * grid.max_error
    affine = geometry.unit_from_yaw[index].numpy()
    places = points @ affine[:, :3].T + affine[:, 3]
    low, high = (corner[0].numpy() for corner in geometry.atlas.box(geometry.grid_index[index, None]))
    is_held = ((places >= low) & (places <= high)).all(axis=1)
    worst = 1.5 * metres * max(grid.max_error, grid.far_error)
    assert error[is_held].max() <= worst
    assert ((read - truth)[~is_held] >= -worst - (STRETCH - 1) * truth[~is_held]).all()


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1.0, HALF_A_STEP, 2.0), (1.0, HALF_A_STEP, HALF_A_STEP)])
def test_samples_lie_on_the_surface_that_the_grid_shows_however_the_aspect_was_snapped(scale: Vec3) -> None:
    index, shape = index_of(thing("plate", (0, 0, 0, 0), scale=scale, tilt=OBLIQUE))
    geometry, grid = table().geometry(), store().grid("plate", scale)
    samples = geometry.surface[index]
    read = geometry.signed_distance(torch.full((len(samples),), index), samples)
    assert read.abs().max() <= 1.5 * grid.max_error * grid.extent * max(scale) + 1e-6
    assert (samples.abs().amax(dim=0) <= torch.tensor(shape.size).float() / 2 + 1e-6).all()


def test_the_lowest_point_is_a_sample_of_the_bottom() -> None:
    index, shape = index_of(thing("bowl", (0, 0, 0, 0), tilt=OBLIQUE))
    bottom = table().geometry().bottom[index]
    assert bottom[:, 2].min().item() == pytest.approx(-shape.size[2] / 2, abs=1e-7)


@pytest.mark.parametrize("name", ["cloth", "plate", "bowl"])
def test_no_grid_reads_negative_beyond_the_reach_of_its_box(name: str) -> None:
    index, shape = index_of(thing(name, (0, 0, 0, 0), tilt=OBLIQUE))
    geometry = table().geometry()
    reach = float(geometry.reach[index])
    points = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (50000, 3)) * (shape.size / 2 + 2 * reach))
    read = geometry.signed_distance(torch.full((len(points),), index), points)
    beyond = (points.abs() > torch.from_numpy(shape.size) / 2 + reach).any(dim=1)
    assert beyond.any()
    assert (read[beyond] > 0).all()


def test_the_gradient_is_that_of_finite_differences() -> None:
    index, _ = index_of(thing("cube", (0, 0, 0, 0), scale=(HALF_A_STEP, 1.0, 2.0), tilt=OBLIQUE))
    geometry = table().geometry()
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.2, 0.2, (40, 3))).requires_grad_()
    which = torch.full((40,), index)
    assert torch.autograd.gradcheck(lambda p: geometry.signed_distance(which, p), points)


def test_one_shape_is_kept_once_and_one_aspect_has_one_grid() -> None:
    shapes = ShapeCollector(store())
    objects = [
        thing("cube", (0, 0, 0, 0)),
        thing("cube", (1, 1, 1, 1)),
        thing("cube", (0, 0, 0, 0), scale=(2.0, 2.0, 2.0)),
        thing("cube", (0, 0, 0, 0), tilt=OBLIQUE),
    ]
    assert [shapes.index(o, store().shape(o)[0]) for o in objects] == [0, 0, 1, 2]
    geometry = shapes.geometry()
    assert (len(geometry), len(geometry.atlas)) == (3, 1)


def test_a_box_stands_in_for_a_missing_mesh() -> None:
    shapes = ShapeCollector(store())
    o = SceneObject("1_ghost_0", "ghost", (0, 0, 0), 0.0, (0.1, 0.2, 0.4))
    index = shapes.index(o, store().shape(o)[0])
    points = torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [0, 0, 0.2], [0, 0.15, 0.0], [0.04, 0.0, 0.0]])
    read = shapes.geometry().signed_distance(torch.full((5,), index), points)
    torch.testing.assert_close(read, torch.tensor([-0.05, 0, 0, 0.05, -0.01]), atol=2e-3, rtol=0)


def test_a_stand_in_may_be_flat() -> None:
    shapes = ShapeCollector(store())
    o = SceneObject("1_ghost_0", "ghost", (0, 0, 0), 0.0, (0.1, 0.2, 0.0))
    index = shapes.index(o, store().shape(o)[0])
    read = shapes.geometry().signed_distance(torch.tensor([index]), torch.tensor([[0.0, 0.0, 0.05]]))
    assert read.item() == pytest.approx(0.05, abs=2e-3)


def test_grids_of_the_table_are_taken_instead_of_built() -> None:
    steps = aspect_steps((1.0, 1.0, 1.0))
    grid = store().grid("ball", (1.0, 1.0, 1.0))
    fields = {name: getattr(grid, name) for name in grid.__slots__}
    row = fields | {"values": grid.values.ravel(), "shape": grid.values.shape, "asset_id": "ball", "aspect": aspect_of(steps)}
    row |= {"sdf_agreement": None, "sign_disagreement": None}
    grids = grids_from_rows(arrow_table("sdf", [row]).to_pylist())
    assert grids.keys() == {("ball", steps)}
    np.testing.assert_array_equal(grids["ball", steps].values, grid.values)
    shapes = ShapeCollector(store(), grids=grids)
    o = thing("ball", (0, 0, 0, 0), scale=(0.7, 0.7, 0.7))
    index = shapes.index(o, store().shape(o)[0])
    read = shapes.geometry().signed_distance(torch.tensor([index]), torch.tensor([[0.0, 0.0, 0.05]]))
    assert read.item() == pytest.approx(0.05 - 0.7 * 0.05, abs=1e-3)
    assert math.isclose(float(shapes.geometry().metres_per_unit[index]), 0.07, rel_tol=1e-3)
