"""The atlas reads what the numpy atlas and ``grid_sample`` read, with the gradient of what it reads."""

import numpy as np
import pytest
import torch

from models.physics_corrector.geometry.sdf_atlas import SdfAtlas
from stable_data.geometry.sdf.grid import GridAtlas, SdfGrid


def sphere_grid(radius: float, shape: tuple[int, int, int], spacing: float) -> SdfGrid:
    """Exact values of a sphere about the middle of the grid."""
    origin = -spacing * (np.array(shape) - 1) / 2
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    values = np.linalg.norm(origin + spacing * nodes, axis=-1) - radius
    return SdfGrid(values.astype(np.float16), origin, spacing)


GRIDS = [sphere_grid(0.4, (21, 25, 23), 0.05), sphere_grid(0.25, (13, 2, 17), 0.07)]


def points_around(count: int, spread: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Grids, and points in and around them."""
    generator = torch.Generator().manual_seed(0)
    places = (torch.rand((count, 3), generator=generator, dtype=torch.float64) - 0.5) * 2 * spread
    return torch.arange(count) % len(GRIDS), places


def read_with_gradient(atlas: SdfAtlas, index: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    points = points.clone().requires_grad_()
    value = atlas.sample(index, points)
    return value.detach(), torch.autograd.grad(value.sum(), points)[0]


def test_it_reads_what_the_numpy_atlas_reads_inside_and_outside() -> None:
    index, points = points_around(400)
    value, gradient = read_with_gradient(SdfAtlas.from_grids(GRIDS), index, points)
    expected, slope = GridAtlas.from_grids(GRIDS).sample_with_gradient(index.numpy(), points.numpy())
    np.testing.assert_allclose(value, expected, atol=2e-7)  # origins are float32
    np.testing.assert_allclose(gradient, slope, atol=2e-5)


def test_it_reads_what_grid_sample_reads() -> None:
    grid = GRIDS[0]
    _, points = points_around(200, 0.45)
    half = torch.tensor(grid.spacing * (np.array(grid.values.shape) - 1) / 2)
    where = (points / half).flip(1)[None, :, None, None]
    volume = torch.from_numpy(grid.values.astype(np.float64))[None, None]
    expected = torch.nn.functional.grid_sample(volume, where, align_corners=True)[0, 0, :, 0, 0]
    value = SdfAtlas.from_grids([grid]).sample(torch.zeros(200, dtype=torch.int64), points)
    torch.testing.assert_close(value, expected, atol=2e-7, rtol=0)


def test_its_gradient_is_that_of_finite_differences() -> None:
    index, points = points_around(60)
    atlas = SdfAtlas.from_grids(GRIDS)
    assert torch.autograd.gradcheck(lambda p: atlas.sample(index, p), points.requires_grad_())


def test_a_sphere_is_known_near_and_far() -> None:
    direction = torch.nn.functional.normalize(torch.randn((100, 3), generator=torch.Generator().manual_seed(1)), dim=1)
    atlas, index = SdfAtlas.from_grids(GRIDS[:1]), torch.zeros(100, dtype=torch.int64)
    for distance in (0.2, 0.4, 0.45, 0.6, 3.0):
        value, gradient = read_with_gradient(atlas, index, distance * direction)
        # Beyond the grid's box what is read is too large, never too small.
        assert (value - (distance - 0.4)).min() > -5e-3
        assert distance > 0.5 or (value - (distance - 0.4)).abs().max() < 5e-3
        assert (gradient * direction).sum(dim=1).min() > 0.6


def test_three_numbers_a_point_are_kept_for_the_backward_pass() -> None:
    index, points = points_around(50)
    kept: list[int] = []

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        kept.append(tensor.numel())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        SdfAtlas.from_grids(GRIDS).sample(index, points.requires_grad_())
    assert kept == [3 * 50]


def test_float32_points_are_read_in_float32_from_float16_storage() -> None:
    index, points = points_around(50)
    atlas = SdfAtlas.from_grids(GRIDS)
    value = atlas.sample(index, points.float())
    assert (atlas.values.dtype, value.dtype) == (torch.float16, torch.float32)
    torch.testing.assert_close(value.double(), atlas.sample(index, points), atol=1e-6, rtol=0)


def test_a_second_derivative_is_refused() -> None:
    index, points = points_around(4)
    value = SdfAtlas.from_grids(GRIDS).sample(index, points.requires_grad_()).square().sum()
    (gradient,) = torch.autograd.grad(value, points, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()  # type: ignore[no-untyped-call]


def test_what_is_not_finite_reads_as_not_finite() -> None:
    places = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [0, 0, -torch.inf]])
    value = SdfAtlas.from_grids(GRIDS).sample(torch.tensor([0, 1, 0]), places)
    assert not torch.isfinite(value).any()


def test_no_points_and_no_grids_give_nothing() -> None:
    nothing = torch.zeros(0, dtype=torch.int64)
    assert SdfAtlas.from_grids(GRIDS).sample(nothing, torch.zeros(0, 3)).shape == (0,)
    assert len(SdfAtlas.from_grids([])) == 0
