"""Signed-distance grids in torch: many in one flat buffer, read with their analytic gradient.

One grid per pair, as ``grid_sample`` wants it, copies a grid for every pair; here points of any grids are read by eight fetches
from where the grids lie. Storage is float16, arithmetic that of the points. Frame, values and what is read outside a grid are
those of :mod:`stable_data.geometry.sdf.grid`: the nearest point of the box plus the way there, so that outside the sign is
right and the gradient leads back.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from stable_data.geometry.sdf.grid import GridAtlas, SdfGrid


@dataclass(frozen=True, slots=True, eq=False)
class SdfAtlas:
    """Many grids in one flat buffer, G of them.

    Attributes:
        values: All nodes, one grid after the other, each in C order, float16, units.
        offset: Where each grid starts in ``values``, (G,) int64.
        shape: Nodes along each axis, (G, 3) int64.
        origin: Place of node (0, 0, 0), (G, 3) float32, units.
        spacing: Between nodes, (G,) float32, units.
    """

    values: Tensor
    offset: Tensor
    shape: Tensor
    origin: Tensor
    spacing: Tensor

    @classmethod
    def from_grids(cls, grids: Sequence[SdfGrid]) -> "SdfAtlas":
        """Puts grids into one buffer, in their order."""
        atlas = GridAtlas.from_grids(grids)
        return cls(
            torch.from_numpy(atlas.values),
            torch.from_numpy(atlas.offset),
            torch.from_numpy(atlas.shape),
            torch.from_numpy(atlas.origin).float(),
            torch.from_numpy(atlas.spacing).float(),
        )

    def to(self, device: torch.device | str) -> "SdfAtlas":
        """The same on a device."""
        return SdfAtlas(*(getattr(self, name).to(device) for name in self.__slots__))

    def __len__(self) -> int:
        """Number of grids."""
        return len(self.offset)

    def box(self, grid_index: Tensor) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner of grids (M,), (M, 3) float32 each, units."""
        low = self.origin[grid_index]
        return low, low + self.spacing[grid_index, None] * (self.shape[grid_index] - 1)

    def sample(self, grid_index: Tensor, points: Tensor) -> Tensor:
        """Signed distances, each point read in its own grid; differentiable once with respect to the points.

        Args:
            grid_index: Grid of each point, (M,) int64.
            points: (M, 3) float32 or float64, unit frame.

        Returns:
            Distances, (M,), dtype of the points, negative inside, units.
        """
        if points.requires_grad and torch.is_grad_enabled():
            read: Tensor = _Read.apply(self, grid_index, points)  # type: ignore[no-untyped-call]
            return read
        return self._read(grid_index, points, with_gradient=False)[0]

    def _read(self, grid_index: Tensor, points: Tensor, *, with_gradient: bool) -> tuple[Tensor, Tensor]:
        """Values (M,), and gradients (M, 3) where they are wanted."""
        shape, spacing = self.shape[grid_index], self.spacing[grid_index].to(points.dtype)
        places = (points - self.origin[grid_index]) / spacing[:, None]  # in nodes
        # A pose that is not finite reads as not finite, yet never outside the buffer.
        held = torch.minimum(places.nan_to_num().clamp_min(0), shape.to(points.dtype) - 1)
        beyond = places - held
        gap = torch.linalg.vector_norm(beyond, dim=1)
        value, slope = self._trilinear(self.offset[grid_index], shape, held, with_gradient=with_gradient)
        value = value + gap * spacing
        if with_gradient:
            outwards = beyond / gap.clamp_min(torch.finfo(gap.dtype).tiny)[:, None]
            slope = torch.where(beyond != 0, outwards, slope / spacing[:, None])
        return value, slope

    def _trilinear(self, offset: Tensor, shape: Tensor, places: Tensor, *, with_gradient: bool) -> tuple[Tensor, Tensor]:
        """Value (M,) and slope per node (M, 3) at places inside the grids, counted in nodes."""
        cell = torch.minimum(places.long(), shape - 2)
        x, y, z = (places - cell).unbind(1)
        along_y = shape[:, 2]
        along_x = shape[:, 1] * along_y
        first = offset + cell[:, 0] * along_x + cell[:, 1] * along_y + cell[:, 2]
        second = first + along_x
        # Corner xyz: first x, then y, then z is interpolated; the differences met on the way are the slope.
        corners = (first, first + 1, first + along_y, first + along_y + 1)
        opposite = (second, second + 1, second + along_y, second + along_y + 1)
        near = [self.values[node].to(places.dtype) for node in corners]
        rise_x = [self.values[node].to(places.dtype) - value for node, value in zip(opposite, near, strict=True)]
        v00, v01, v10, v11 = (value + x * rise for value, rise in zip(near, rise_x, strict=True))
        v0, v1 = v00 + y * (v10 - v00), v01 + y * (v11 - v01)
        value = v0 + z * (v1 - v0)
        if not with_gradient:
            return value, value
        r0, r1 = rise_x[0] + y * (rise_x[2] - rise_x[0]), rise_x[1] + y * (rise_x[3] - rise_x[1])
        slope_y = (v10 - v00) + z * ((v11 - v01) - (v10 - v00))
        return value, torch.stack([r0 + z * (r1 - r0), slope_y, v1 - v0], dim=1)


class _Read(torch.autograd.Function):
    """Value and gradient in the same fetches; of all that, three numbers a point wait for the backward pass."""

    @staticmethod
    def forward(ctx: Any, atlas: SdfAtlas, grid_index: Tensor, points: Tensor) -> Tensor:
        value, gradient = atlas._read(grid_index, points, with_gradient=True)
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_value: Tensor) -> tuple[None, None, Tensor]:
        (gradient,) = ctx.saved_tensors
        return None, None, grad_value[:, None] * gradient
