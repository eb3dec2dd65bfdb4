"""Signed-distance grids: their content, and sampling in one or many of them.

Needs only numpy; :mod:`stable_data.geometry.sdf.build` makes grids.

**Frame.** A grid belongs to a mesh at an aspect (``SceneObject.scale`` divided by its largest component). The mesh, multiplied by
the aspect and divided by the largest extent of its box, is the *unit mesh*; the grid uses its frame and its unit of length. The
remaining factor is uniform, s metres per unit, and distances scale with it: ``D_{s·M}(x) = s · D_M(x / s)``. An uneven scale is
never applied to a distance.

**Values** are float16 in the unit: 11 significant bits, so the relative error is at most 1/2048. That is 2.4e-4 at half an extent
and negligible near the surface.

**Sampling** is trilinear. A point outside the box gets the value at the nearest point of the box plus the distance to that point.
Except for the grid's own error, this is never less than the true distance, and exact where the way to the box leads straight to
the surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import numpy.typing as npt

from stable_data.scene import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class SdfGrid:
    """Signed distance of one mesh at one aspect, negative inside, unit frame (see the module).

    Attributes:
        values: At the nodes, (nx, ny, nz) float16, C order, at least 2 along each axis, units.
        origin: Coordinates of node (0, 0, 0), (3,) float64, units.
        spacing: Distance between nodes, the same along each axis, units.
        extent: One unit in the lengths of the mesh at its aspect: metres per unit are ``extent`` times the largest scale.
        shell_thickness: Thickness given to a sheet, units; 0 for a solid.
        wall_thickness: Estimated wall thickness of the mesh, units; 0 if it has no wall.
        mean_error: Mean of |grid − exact| within one spacing of the surface, at points between the nodes, units.
        max_error: The largest of these errors, units.
        far_error: The largest |grid − exact| at points in the rest of the box, units.
        sign_error: Share of the points at least half a spacing from the surface that have the wrong sign.
    """

    values: npt.NDArray[np.float16]
    origin: FloatArray
    spacing: float
    extent: float = 1.0
    shell_thickness: float = 0.0
    wall_thickness: float = 0.0
    mean_error: float = 0.0
    max_error: float = 0.0
    far_error: float = 0.0
    sign_error: float = 0.0


@dataclass(frozen=True, slots=True)
class GridLimits:
    """Limits on the resolution of a grid.

    Attributes:
        min_nodes: Nodes of the coarsest grid, whatever the wall thickness.
        max_nodes: Nodes of the finest grid, however thin the wall.
        nodes_per_wall: Wanted wall thickness in spacings, if ``max_nodes`` permits it.
        padding: Nodes around the mesh's box on each side.
    """

    min_nodes: int = 56**3
    max_nodes: int = 96**3
    nodes_per_wall: float = 3.0
    padding: int = 2


USUAL_LIMITS = GridLimits()
"""The limits of the grids of a run."""


@dataclass(frozen=True, slots=True, eq=False)
class GridAtlas:
    """G grids in one flat buffer, so that points of different grids are sampled together.

    Attributes:
        values: All nodes, one grid after the other, each in C order, float16, units.
        offset: Start of each grid in ``values``, (G,) int64.
        shape: Nodes along each axis, (G, 3) int64.
        origin: Coordinates of node (0, 0, 0), (G, 3) float64, units.
        spacing: Distance between nodes, (G,) float64, units.
    """

    values: npt.NDArray[np.float16]
    offset: IntArray
    shape: IntArray
    origin: FloatArray
    spacing: FloatArray

    @classmethod
    def from_grids(cls, grids: Sequence[SdfGrid]) -> "GridAtlas":
        """Copies grids into one buffer, in their order."""
        size = np.array([g.values.size for g in grids], np.int64)
        values = [g.values.ravel() for g in grids]
        return cls(
            np.concatenate(values) if values else np.zeros(0, np.float16),
            np.cumsum(size) - size,
            np.array([g.values.shape for g in grids], np.int64).reshape(-1, 3),
            np.array([g.origin for g in grids], np.float64).reshape(-1, 3),
            np.array([g.spacing for g in grids], np.float64),
        )

    def __len__(self) -> int:
        """Number of grids."""
        return len(self.offset)

    def sample(self, grid_index: IntArray, points: FloatArray, scale: FloatArray | float = 1.0) -> FloatArray:
        """Computes signed distances, each point in its own grid.

        Args:
            grid_index: Grid of each point, (P,) int64.
            points: (P, 3) float64, frame of that grid's mesh, metres if the scale is metres per unit.
            scale: Uniform factor from units to the lengths of the points, (P,) or one for all, positive.

        Returns:
            Distances, (P,) float64, negative inside, in the lengths of the points.
        """
        return self.sample_with_gradient(grid_index, points, scale)[0]

    def sample_with_gradient(
        self, grid_index: IntArray, points: FloatArray, scale: FloatArray | float = 1.0
    ) -> tuple[FloatArray, FloatArray]:
        """As :meth:`sample`, and the derivative of the returned value (not of the mesh) with respect to the points, (P, 3) float64."""
        factor = np.broadcast_to(np.asarray(scale, np.float64), len(points))
        shape, spacing = self.shape[grid_index], self.spacing[grid_index][:, None]
        places = (points / factor[:, None] - self.origin[grid_index]) / spacing  # in nodes
        held = np.clip(places, 0, shape - 1)  # the nearest point of the box
        beyond = places - held
        value, slope = self._trilinear(self.offset[grid_index], shape, held)
        gap = np.linalg.norm(beyond, axis=1)
        direction = beyond / np.where(gap > 0, gap, 1)[:, None]
        gradient = np.where(beyond != 0, direction, slope / spacing)
        return factor * (value + gap * spacing[:, 0]), gradient

    def _trilinear(self, offset: IntArray, shape: IntArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value (P,) and slope per node (P, 3) at places inside the grids, measured in nodes."""
        cell = np.minimum(places.astype(np.int64), shape - 2)  # a point on the upper face is in the last cell
        part = places - cell
        stride = np.stack([shape[:, 1] * shape[:, 2], shape[:, 2], np.ones(len(shape), np.int64)], axis=1)
        first = offset + (cell * stride).sum(axis=1)
        value, slope = np.zeros(len(places)), np.zeros((len(places), 3))
        for corner in product((0, 1), repeat=3):
            node = self.values[first + stride @ np.array(corner)].astype(np.float64)
            weight = np.where(corner, part, 1 - part)
            value += node * weight.prod(axis=1)
            for axis in range(3):
                others = weight[:, (axis + 1) % 3] * weight[:, (axis + 2) % 3]
                slope[:, axis] += (node if corner[axis] else -node) * others
        return value, slope


def sample_grid(grid: SdfGrid, points: FloatArray, scale: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Computes signed distances and their gradient in one grid.

    Args:
        grid: The grid.
        points: (P, 3) float64, frame of the mesh, metres if the scale is metres per unit.
        scale: Uniform factor from units to the lengths of the points, positive.

    Returns:
        Distances (P,) float64, negative inside, in the lengths of the points, and their derivative with respect to the points,
        (P, 3) float64.
    """
    return GridAtlas.from_grids([grid]).sample_with_gradient(np.zeros(len(points), np.int64), points, scale)
