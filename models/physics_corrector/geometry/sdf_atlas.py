"""The buffer of :class:`stable_data.geometry.sdf.grid.GridAtlas` in torch, with the analytic gradient.

``grid_sample`` of torch would need a copy of the grid for every pair of objects; here eight fetches read each point in any grid
of the buffer. Values are float16; the arithmetic has the dtype of the points. Frame, values and the rule outside a grid's box
are those of :mod:`stable_data.geometry.sdf.grid`: outside, the sign is correct and the gradient points away from the box.
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
    """G grids; the attributes are those of ``GridAtlas``, but ``origin`` and ``spacing`` are float32."""

    values: Tensor
    offset: Tensor
    shape: Tensor
    origin: Tensor
    spacing: Tensor

    @classmethod
    def from_grids(cls, grids: Sequence[SdfGrid]) -> "SdfAtlas":
        """Concatenates grids, in their order."""
        atlas = GridAtlas.from_grids(grids)
        return cls(
            torch.from_numpy(atlas.values),
            torch.from_numpy(atlas.offset),
            torch.from_numpy(atlas.shape),
            torch.from_numpy(atlas.origin).float(),
            torch.from_numpy(atlas.spacing).float(),
        )

    def to(self, device: torch.device | str) -> "SdfAtlas":
        """Copies the buffer to a device."""
        return SdfAtlas(*(getattr(self, name).to(device) for name in self.__slots__))

    def __len__(self) -> int:
        """Number of grids."""
        return len(self.offset)

    def box(self, grid_index: Tensor) -> tuple[Tensor, Tensor]:
        """The lowest and highest corners of grids (M,), (M, 3) float32 each, units."""
        low = self.origin[grid_index]
        return low, low + self.spacing[grid_index, None] * (self.shape[grid_index] - 1)

    def sample(self, grid_index: Tensor, points: Tensor) -> Tensor:
        """Reads the signed distance of each point in its grid; differentiable once with respect to the points.

        Args:
            grid_index: Grid of each point, (M,) int64.
            points: (M, 3) float32 or float64, unit frame.

        Returns:
            Distances, (M,), dtype of the points, negative inside, units.
        """
        if points.requires_grad and torch.is_grad_enabled():
            distance: Tensor = _Sample.apply(self, grid_index, points)  # type: ignore[no-untyped-call]
            return distance
        return self._read(grid_index, points, with_gradient=False)[0]

    def sample_with_gradient(self, grid_index: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Reads the signed distance and its gradient; arguments as for :meth:`sample`.

        Returns:
            Distances, (M,), units, and gradients, (M, 3); neither is differentiable.
        """
        return self._read(grid_index, points.detach(), with_gradient=True)

    def _read(self, grid_index: Tensor, points: Tensor, *, with_gradient: bool) -> tuple[Tensor, Tensor]:
        """Returns values (M,) and, on request, gradients (M, 3)."""
        shape, spacing = self.shape[grid_index], self.spacing[grid_index].to(points.dtype)
        nodes = (points - self.origin[grid_index]) / spacing[:, None]  # coordinates in nodes
        # nan_to_num: a pose that is not finite gives a distance that is not finite, but never an index outside the buffer.
        clamped = torch.minimum(nodes.nan_to_num().clamp_min(0), shape.to(points.dtype) - 1)
        beyond = nodes - clamped
        gap = torch.linalg.vector_norm(beyond, dim=1)
        value, slope = self._trilinear(self.offset[grid_index], shape, clamped, with_gradient=with_gradient)
        value = value + gap * spacing
        if with_gradient:
            outwards = beyond / gap.clamp_min(torch.finfo(gap.dtype).tiny)[:, None]
            slope = torch.where(beyond != 0, outwards, slope / spacing[:, None])
        return value, slope

    def _trilinear(self, offset: Tensor, shape: Tensor, nodes: Tensor, *, with_gradient: bool) -> tuple[Tensor, Tensor]:
        """Returns the value (M,) and the slope per node (M, 3) at node coordinates inside the grids."""
        cell = torch.minimum(nodes.long(), shape - 2)
        x, y, z = (nodes - cell).unbind(1)
        along_y = shape[:, 2]
        along_x = shape[:, 1] * along_y
        first = offset + cell[:, 0] * along_x + cell[:, 1] * along_y + cell[:, 2]
        second = first + along_x
        # Interpolates along x, then y, then z; the differences between corners also give the slope. vYZ: value at corner y, z.
        corners = (first, first + 1, first + along_y, first + along_y + 1)
        opposite = (second, second + 1, second + along_y, second + along_y + 1)
        near = [self.values[node].to(nodes.dtype) for node in corners]
        rise_x = [self.values[node].to(nodes.dtype) - value for node, value in zip(opposite, near, strict=True)]
        v00, v01, v10, v11 = (value + x * rise for value, rise in zip(near, rise_x, strict=True))
        v0, v1 = v00 + y * (v10 - v00), v01 + y * (v11 - v01)
        value = v0 + z * (v1 - v0)
        if not with_gradient:
            return value, value
        r0, r1 = rise_x[0] + y * (rise_x[2] - rise_x[0]), rise_x[1] + y * (rise_x[3] - rise_x[1])
        slope_y = (v10 - v00) + z * ((v11 - v01) - (v10 - v00))
        return value, torch.stack([r0 + z * (r1 - r0), slope_y, v1 - v0], dim=1)


class _Sample(torch.autograd.Function):
    """Computes value and gradient with the same fetches and saves only the gradient, three numbers per point, for backward."""

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
