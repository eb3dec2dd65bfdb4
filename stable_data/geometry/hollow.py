"""The hollow of a mesh that opens upward: how much water it would hold."""

import heapq
from dataclasses import dataclass

import numpy as np

from stable_data.geometry.mesh import Mesh
from stable_data.geometry.surface_sampling import sample_surface
from stable_data.scene import FloatArray

_CELLS = 28  # along the longer horizontal side
_SAMPLES = 60_000  # about 80 a cell
_SHALLOW = 0.3  # of the largest depth: what is less deep does not count as mouth


@dataclass(frozen=True, slots=True)
class Hollow:
    """A hollow that opens upward, in the pose and unit of the mesh; all are 0 without one.

    Attributes:
        depth: From the lowest point of its rim to its bottom.
        volume: What it holds up to the lowest point of its rim.
        mouth: Area of the part that is at least 30 % as deep as the deepest.
        footprint: Area of all of the object, seen from above.
    """

    depth: float
    volume: float
    mouth: float
    footprint: float


def upward_hollow(mesh: Mesh) -> Hollow:
    """Finds what a mesh in its pose would hold if water were poured on it, on a grid of 28 cells along its longer side.

    Args:
        mesh: z up, any unit.
    """
    points = sample_surface(mesh, _SAMPLES)
    low = mesh.vertices.min(axis=0)
    side = float(mesh.extents[:2].max()) / _CELLS
    cells = np.minimum(((points[:, :2] - low[:2]) / side).astype(np.int64), _CELLS - 1)
    shape = cells.max(axis=0) + 1
    top = np.full(shape, -np.inf)
    np.maximum.at(top, (cells[:, 0], cells[:, 1]), points[:, 2])
    level = _water_level(top)
    is_covered = np.isfinite(top)
    depth = np.subtract(level, top, out=np.zeros(shape), where=is_covered)
    deepest = float(depth.max())
    cell = side * side
    mouth = float((depth > _SHALLOW * deepest).sum() * cell) if deepest > 0 else 0.0
    return Hollow(deepest, float(depth.sum() * cell), mouth, float(is_covered.sum() * cell))


def _water_level(top: FloatArray) -> FloatArray:
    """Height of the water over each cell (X, Y) if it rains: the lowest barrier on any way to the edge, or the cell itself."""
    level = np.full(top.shape, np.inf)
    queue = []
    width, depth = top.shape
    for i in range(width):
        for j in range(depth):
            if i in (0, width - 1) or j in (0, depth - 1) or not np.isfinite(top[i, j]):
                level[i, j] = top[i, j]
                queue.append((float(top[i, j]), i, j))
    heapq.heapify(queue)
    while queue:
        height, i, j = heapq.heappop(queue)
        for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if 0 <= a < width and 0 <= b < depth and level[a, b] == np.inf:
                level[a, b] = max(height, float(top[a, b]))
                heapq.heappush(queue, (float(level[a, b]), a, b))
    return level
