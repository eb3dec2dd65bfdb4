"""An independent second opinion on signed-distance grids, by pysdf; and grids that are built with it.

pysdf measures to the faces at the nearest vertices, so that long triangles mislead it: the mesh is subdivided first. Its robust mode
gets the sign from rays, which needs no closed mesh with outward faces. Both ways differ from those of
:mod:`~stable_data.geometry.sdf.exact`, so that a mistake of one shows as a disagreement.
"""

from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Literal, TypeAlias

import numpy as np
import trimesh

from stable_data.errors import ConfigError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf.build import build_grid, measure_grid_errors, unit_mesh
from stable_data.geometry.sdf.exact import SignedDistance
from stable_data.geometry.sdf.grid import SdfGrid, sample_grid
from stable_data.scene import FloatArray, Vec3

SdfBackend: TypeAlias = Literal["exact", "pysdf"]
"""What computes a grid: libigl near the surface, or pysdf at every node."""

INSTALL = "pip install -c constraints.txt '.[pysdf]' in a checkout"
"""How pysdf is installed."""

_LONGEST_EDGE = 0.02  # of the subdivided mesh, extents
_NUM_POINTS = 1000
_LEAST_AGREEMENT, _MOST_WRONG_SIGNS = 0.99, 0.01


@dataclass(frozen=True, slots=True)
class SecondOpinion:
    """How a grid agrees with pysdf at random points in its box.

    Attributes:
        agreement: Share of points at which the distances without sign differ by less than a spacing.
        sign_disagreement: Share of points with different signs, of those farther than a spacing from the surface; None if none is.
    """

    agreement: float
    sign_disagreement: float | None

    @property
    def disagrees(self) -> bool:
        """Whether one of the two is probably wrong."""
        return self.agreement < _LEAST_AGREEMENT or (self.sign_disagreement or 0.0) > _MOST_WRONG_SIGNS


def has_pysdf() -> bool:
    """Whether pysdf is installed."""
    return find_spec("pysdf") is not None


class PysdfDistance:
    """Signed distance to a mesh by pysdf in its robust mode.

    Args:
        mesh: A unit mesh (``build.unit_mesh``).

    Raises:
        ConfigError: pysdf is not installed (``pysdf_missing``).
    """

    def __init__(self, mesh: Mesh) -> None:
        if not has_pysdf():
            message = f"pysdf is not installed, expected it for the backend pysdf; {INSTALL}"
            raise ConfigError(message, "pysdf_missing")
        import pysdf

        vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _LONGEST_EDGE)
        self._tree = pysdf.SDF(vertices.astype(np.float32), faces.astype(np.uint32), robust=True)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Signed distances (P,) float64, negative inside, of points (P, 3), in the units of the mesh."""
        return -np.asarray(self._tree.calc(np.ascontiguousarray(points, np.float32), n_threads=1), np.float64)


def second_opinion(grid: SdfGrid, mesh: Mesh, aspect: Vec3) -> SecondOpinion:
    """Compares a grid with pysdf.

    Args:
        grid: The grid of a solid.
        mesh: Its mesh, mesh frame.
        aspect: Its aspect.

    Raises:
        ConfigError: pysdf is not installed (``pysdf_missing``).
    """
    size = (np.array(grid.values.shape) - 1) * grid.spacing
    points = grid.origin + size * np.random.default_rng(0).random((_NUM_POINTS, 3))
    read, other = sample_grid(grid, points)[0], PysdfDistance(unit_mesh(mesh, aspect)[0])(points)
    is_clear = np.abs(other) > grid.spacing
    wrong = (read < 0) != (other < 0)
    return SecondOpinion(
        float((np.abs(np.abs(read) - np.abs(other)) < grid.spacing).mean()),
        float(wrong[is_clear].mean()) if is_clear.any() else None,
    )


def build_grid_by_pysdf(mesh: Mesh, aspect: Vec3 = (1.0, 1.0, 1.0), *, is_sheet: bool = False) -> SdfGrid:
    """Builds a grid whose values are pysdf's at every node; its errors are measured against the exact distance.

    A sheet has no inside for pysdf's rays: its grid is the exact one.

    Args:
        mesh: Repaired, mesh frame.
        aspect: Scale along the mesh's axes divided by its largest component.
        is_sheet: The mesh is open and represents a thin shell.

    Raises:
        ConfigError: pysdf is not installed (``pysdf_missing``).
        MeshError: The mesh has no extent.
    """
    grid = build_grid(mesh, aspect=aspect, is_sheet=is_sheet)
    if is_sheet:
        return grid
    unit, _ = unit_mesh(mesh, aspect)
    axes = [grid.origin[k] + grid.spacing * np.arange(count) for k, count in enumerate(grid.values.shape)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = PysdfDistance(unit)(nodes).reshape(grid.values.shape).astype(np.float16)
    return measure_grid_errors(replace(grid, values=values), SignedDistance(unit))
