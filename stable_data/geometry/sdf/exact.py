"""Exact signed distance of points to a mesh, negative inside.

The distance is libigl's (double precision, exact to the nearest triangle). The sign is the winding number, which tolerates holes
and reversed faces. docs/signed_distance.md explains the choice.

An open sheet has no inside: it is a thin shell, |d| - thickness / 2, whose hollow is outside.

Threads: libigl uses all cores. With many workers on one machine, set IGL_NUM_THREADS=1 before the first import.
"""

from functools import cached_property
from typing import TypeAlias

import igl
import numpy as np
import numpy.typing as npt

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray, IntArray

BoolArray: TypeAlias = npt.NDArray[np.bool_]

_INSIDE = 0.5  # winding number above which a point is inside: the midpoint between 0 and 1


class SignedDistance:
    """Exact signed distance to one mesh; the search trees are built once, on first use.

    Args:
        mesh: Any unit and frame; points and distances use the same.
        is_sheet: The mesh is open and represents a thin shell.
        shell_thickness: Thickness of that shell, mesh units; used for sheets only.

    Raises:
        MeshError: The mesh has no face, or the thickness of a sheet is negative or not finite.

    Example:
        >>> tetrahedron = Mesh(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
        >>> SignedDistance(tetrahedron)(np.array([[0.1, 0.2, 0.2], [0.0, 0.0, -2.0]]))
        array([-0.1,  2. ])
    """

    def __init__(self, mesh: Mesh, *, is_sheet: bool = False, shell_thickness: float = 0.0) -> None:
        if len(mesh.faces) == 0:
            raise MeshError("mesh has 0 faces, expected at least one; were all faces removed as degenerate?", "mesh_empty")
        if is_sheet and not (np.isfinite(shell_thickness) and shell_thickness >= 0):
            message = f"shell thickness is {shell_thickness}, expected zero or more mesh units"
            raise MeshError(message, "shell_thickness_invalid")
        self.mesh = mesh
        self.is_sheet = is_sheet
        self.half_thickness = shell_thickness / 2 if is_sheet else 0.0

    @cached_property
    def _tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    @cached_property
    def _winding_tree(self) -> igl.FastWindingNumberBVH:
        tree = igl.FastWindingNumberBVH()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    def nearest(self, points: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Finds the nearest surface points of points (P, 3) float64, mesh frame, on either side.

        Returns:
            Distance without sign (P,) float64, its face (P,) int64, and the surface point (P, 3) float64.
        """
        if len(points) == 0:
            return np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))
        squared, face, place = self._tree.squared_distance(self.mesh.vertices, self.mesh.faces, _rows(points))
        return np.sqrt(squared), face, place

    def winding_number(self, points: FloatArray) -> FloatArray:
        """Winding numbers (P,) float64 of points (P, 3), mesh frame: 1 inside, 0 outside, intermediate near a hole; to about 1e-2."""
        if len(points) == 0:
            return np.zeros(0)
        found: FloatArray = self._winding_tree.winding_number(_rows(points))
        return found

    def is_inside(self, points: FloatArray) -> BoolArray:
        """Whether each point is inside, (P,) bool; always False for a sheet, which has no inside except its shell."""
        if self.is_sheet:
            return np.zeros(len(points), np.bool_)
        inside: BoolArray = self.winding_number(points) > _INSIDE
        return inside

    def signed(self, distance: FloatArray, inside: BoolArray) -> FloatArray:
        """Adds the sign to distances (P,); for a sheet, subtracts half the thickness of its shell."""
        return np.where(inside, -distance, distance) - self.half_thickness

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Length of each ray up to its first face, (P,) float64, in lengths of its direction; inf if it hits none."""
        if len(origins) == 0:
            return np.zeros(0)
        face, length, _ = self._tree.intersect_ray_first(self.mesh.vertices, self.mesh.faces, _rows(origins), _rows(directions))
        return np.where(face >= 0, length, np.inf)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Exact signed distances (P,) float64, negative inside, of points (P, 3) float64, mesh frame; mesh units."""
        return self.signed(self.nearest(points)[0], self.is_inside(points))


def _rows(points: FloatArray) -> FloatArray:
    """Converts points to the layout that libigl requires."""
    return np.ascontiguousarray(points, np.float64)
