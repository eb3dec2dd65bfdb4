"""Signed-distance grids for contacts, built once for each mesh and kept in files that all processes of a user share."""

from collections import OrderedDict
from pathlib import Path

import numpy as np

from stable_data.assets.user_cache import ArrayFiles, array_key
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf import build as build_module
from stable_data.geometry.sdf.aspects import aspect_of
from stable_data.geometry.sdf.build import build_grid
from stable_data.geometry.sdf.grid import GridLimits, SdfGrid

LIMITS = GridLimits(min_nodes=32**3, max_nodes=80**3)
"""Resolution of the grids: coarser than those of preprocess, because the exact audit judges the result, but with nodes inside of
placemats and magazines."""

_FIGURES = ("spacing", "extent", "shell_thickness", "wall_thickness", "mean_error", "max_error", "far_error", "sign_error")


class ContactGrids:
    """Grids of meshes.

    Args:
        folder: Keeps the grids; None keeps them in memory alone.
        max_bytes: Grids in memory; 0.1 to 1 MB each.
    """

    def __init__(self, folder: Path | None = None, max_bytes: int = 2**28) -> None:
        self._files, self._max_bytes = ArrayFiles(folder), max_bytes
        self._grids: OrderedDict[str, SdfGrid] = OrderedDict()
        self._num_bytes = 0

    def grid(self, mesh: Mesh, steps: tuple[int, int, int], *, is_sheet: bool) -> SdfGrid:
        """Returns the grid of a repaired mesh at an aspect in steps (``stable_data.geometry.sdf.aspects.aspect_steps``)."""
        key = _digest(mesh, steps, is_sheet)
        if key not in self._grids:
            self._grids[key] = grid = self._read(key) or self._built(key, mesh, steps, is_sheet)
            self._num_bytes += grid.values.nbytes
            while self._num_bytes > self._max_bytes and len(self._grids) > 1:
                self._num_bytes -= self._grids.popitem(last=False)[1].values.nbytes
        self._grids.move_to_end(key)
        return self._grids[key]

    def _read(self, key: str) -> SdfGrid | None:
        """A grid from its file; None if there is no usable one."""
        found = self._files.read(key)
        if found is None or not {"values", "origin", "figures"} <= found.keys() or len(found["figures"]) != len(_FIGURES):
            return None
        return SdfGrid(found["values"], found["origin"], **dict(zip(_FIGURES, found["figures"].tolist(), strict=True)))

    def _built(self, key: str, mesh: Mesh, steps: tuple[int, int, int], is_sheet: bool) -> SdfGrid:
        grid = build_grid(mesh, aspect=aspect_of(steps), is_sheet=is_sheet, limits=LIMITS)
        figures = np.array([getattr(grid, name) for name in _FIGURES])
        self._files.write(key, {"values": grid.values, "origin": grid.origin, "figures": figures})
        return grid


def _digest(mesh: Mesh, steps: tuple[int, int, int], is_sheet: bool) -> str:
    code = Path(build_module.__file__).parent
    return array_key(code, mesh.vertices.tobytes(), mesh.faces.tobytes(), repr((steps, is_sheet, LIMITS)).encode())
