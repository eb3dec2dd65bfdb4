"""Matches surfaces with the mesh that was made of them and repaired: triangles that the repair left where they were are equal."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint, to_linear
from stable_data.geometry.surface import Surface
from stable_data.scene import FloatArray, IntArray

_NEAR = 1e-5  # share of the largest extent: corners that are nearer are one


def surfaces_on_mesh(mesh: Mesh, look: Sequence[Surface], paint: Paint) -> list[Surface]:
    """Divides the faces of a mesh into surfaces.

    A face whose corners are those of a triangle of the look gets its material, colours and texture coordinates, also if it was
    turned over. Other faces, such as those that close a hole, keep their colour.

    Args:
        mesh: The mesh.
        look: Surfaces in its frame and unit.
        paint: Colours of the faces of the mesh, see :func:`stable_data.geometry.mesh_colors.load_paint`.

    Returns:
        Surfaces whose triangles are the faces of the mesh, each once.
    """
    triangles = np.concatenate([surface.triangles for surface in look])
    of = np.repeat(np.arange(len(look)), [len(surface.triangles) for surface in look])
    faces, source, corner = _equal_triangles(mesh, triangles)
    found = []
    starts = np.searchsorted(of, np.arange(len(look)))
    for number, surface in enumerate(look):
        rows = np.flatnonzero(of[source] == number)
        own, corners = source[rows] - starts[number], corner[rows]

        def chosen(values: FloatArray | None, own: IntArray = own, corners: IntArray = corners) -> FloatArray | None:
            return None if values is None else values[own[:, None], corners]

        uv, colours = chosen(surface.corner_uv), chosen(surface.corner_colours)
        found.append(replace(surface, triangles=mesh.triangles[faces[rows]], corner_uv=uv, corner_colours=colours))
    is_left = np.ones(len(mesh.faces), bool)
    is_left[faces] = False
    for colour, rows in paint:
        red, green, blue = to_linear(np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])).tolist()
        found.append(Surface(mesh.triangles[rows[is_left[rows]]], (red, green, blue)))
    return [surface for surface in found if len(surface.triangles)]


def oriented_as(mesh: Mesh, surfaces: Sequence[Surface]) -> list[Surface]:
    """Turns over those triangles that face the other way in a mesh: of a file that is inside out, renderers show the far side.

    Args:
        mesh: The repaired mesh of the surfaces.
        surfaces: In its frame and unit; at least one triangle in all. A triangle that is no face of the mesh, or that is there twice,
            as on both sides of a sheet, stays as it is.
    """
    triangles = np.concatenate([surface.triangles for surface in surfaces])
    _, source, corner = _equal_triangles(mesh, triangles)
    middles = cKDTree(triangles.mean(axis=1))
    near = _NEAR * float(mesh.extents.max())
    is_twice = middles.query_ball_point(triangles[source].mean(axis=1), near, return_length=True) > 1
    is_odd = (corner[:, 1] - corner[:, 0]) % 3 == 2
    turned = np.zeros(len(triangles), bool)
    turned[source[is_odd & ~is_twice]] = True
    ends = np.cumsum([len(surface.triangles) for surface in surfaces])
    return [_turned(s, turned[end - len(s.triangles) : end]) for s, end in zip(surfaces, ends, strict=True)]


def _turned(surface: Surface, rows: npt.NDArray[np.bool_]) -> Surface:
    """A surface some of whose triangles are turned over."""
    order = np.where(rows[:, None], [0, 2, 1], [0, 1, 2])

    def chosen(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else np.take_along_axis(values, order[..., None], axis=1)

    return replace(
        surface,
        triangles=np.take_along_axis(surface.triangles, order[..., None], axis=1),
        corner_uv=chosen(surface.corner_uv),
        corner_colours=chosen(surface.corner_colours),
    )


def _equal_triangles(mesh: Mesh, triangles: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Faces of a mesh that are one of some triangles.

    Returns:
        Numbers of the faces (N,); the triangle of each, (N,); and the corner of the triangle at each corner of the face, (N, 3).
    """
    near = _NEAR * float(mesh.extents.max())
    distance, nearest = cKDTree(triangles.mean(axis=1)).query(mesh.triangles.mean(axis=1), distance_upper_bound=near)
    faces = np.flatnonzero(np.isfinite(distance))
    source = np.asarray(nearest, np.int64)[faces]
    gaps = np.linalg.norm(mesh.triangles[faces][:, :, None] - triangles[source][:, None], axis=3)  # (N, corner, corner)
    corner = gaps.argmin(axis=2)
    is_equal = (gaps.min(axis=2) <= near).all(axis=1) & (np.sort(corner, axis=1) == [0, 1, 2]).all(axis=1)
    return faces[is_equal], source[is_equal], corner[is_equal]
