"""Signed distance as grids: what a grid holds, and reading one or many of them. Numpy alone; `sdf_build` makes them.

**Frame.** A grid belongs to a mesh at an aspect (``SceneObject.scale`` divided by its largest component). The mesh, times the
aspect, divided by the largest extent of its box, is the *unit mesh*; the grid lies in that frame and its lengths are in that
unit. What remains is one uniform factor s, metres per unit, and distances scale with it: ``D_{s·M}(x) = s · D_M(x / s)``.
A distance is never taken through an uneven scale.

**Values** are float16 in the unit: 11 significant bits, so a value is off by at most 1/2048 of itself, 2.4e-4 at half an
extent and nothing that matters beside the surface.

**Reading** is trilinear. A point outside the box reads the nearest point of the box plus the way there: never less than the
true distance but for the grid's own error, and exact where the way there leads straight off the surface.
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
        origin: Place of node (0, 0, 0), (3,) float64, units.
        spacing: Between nodes, the same along each axis, units.
        extent: One unit in the lengths of the mesh at its aspect: metres per unit are ``extent`` times the largest scale.
        shell_thickness: What a sheet was given, units; 0 for a solid.
        wall_thickness: Of the mesh, estimated, units; 0 where there is none to speak of.
        mean_error: Mean of |grid − exact| within one spacing of the surface, at points between the nodes, units.
        max_error: The largest of them, units.
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


@dataclass(frozen=True, slots=True, eq=False)
class GridAtlas:
    """Many grids in one flat buffer, G of them, so that points of different grids are read together.

    Attributes:
        values: All nodes, one grid after the other, each in C order, float16, units.
        offset: Where each grid starts in ``values``, (G,) int64.
        shape: Nodes along each axis, (G, 3) int64.
        origin: Place of node (0, 0, 0), (G, 3) float64, units.
        spacing: Between nodes, (G,) float64, units.
    """

    values: npt.NDArray[np.float16]
    offset: IntArray
    shape: IntArray
    origin: FloatArray
    spacing: FloatArray

    @classmethod
    def from_grids(cls, grids: Sequence[SdfGrid]) -> "GridAtlas":
        """Puts grids into one buffer, in their order."""
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
        """Signed distances, each point read in its own grid.

        Args:
            grid_index: Grid of each point, (P,) int64.
            points: (P, 3) float64, frame of that grid's mesh, metres where the scale is metres per unit.
            scale: Uniform factor from units to the lengths of the points, (P,) or one for all, positive.

        Returns:
            Distances, (P,) float64, negative inside, in the lengths of the points.
        """
        return self.sample_with_gradient(grid_index, points, scale)[0]

    def sample_with_gradient(
        self, grid_index: IntArray, points: FloatArray, scale: FloatArray | float = 1.0
    ) -> tuple[FloatArray, FloatArray]:
        """As `sample`, and the derivative with respect to the points, (P, 3) float64, of what is returned, not of the mesh."""
        factor = np.broadcast_to(np.asarray(scale, np.float64), len(points))
        shape, spacing = self.shape[grid_index], self.spacing[grid_index][:, None]
        places = (points / factor[:, None] - self.origin[grid_index]) / spacing  # in nodes
        held = np.clip(places, 0, shape - 1)
        beyond = places - held
        value, slope = self._trilinear(self.offset[grid_index], shape, held)
        gap = np.linalg.norm(beyond, axis=1)
        direction = beyond / np.where(gap > 0, gap, 1)[:, None]
        gradient = np.where(beyond != 0, direction, slope / spacing)
        return factor * (value + gap * spacing[:, 0]), gradient

    def _trilinear(self, offset: IntArray, shape: IntArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value (P,) and slope per node (P, 3) at places inside the grids, counted in nodes."""
        cell = np.minimum(places.astype(np.int64), shape - 2)
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
    """Signed distances and their gradient, read in one grid.

    Args:
        grid: The grid.
        points: (P, 3) float64, frame of the mesh, metres where the scale is metres per unit.
        scale: Uniform factor from units to the lengths of the points, positive.

    Returns:
        Distances (P,) float64, negative inside, in the lengths of the points, and their derivative with respect to the points,
        (P, 3) float64.
    """
    return GridAtlas.from_grids([grid]).sample_with_gradient(np.zeros(len(points), np.int64), points, scale)
