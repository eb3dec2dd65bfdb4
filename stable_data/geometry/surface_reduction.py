"""Reduces surfaces to fewer triangles; their colours and texture coordinates are kept where the seams of the texture allow it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import fast_simplification
import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from stable_data.geometry.images import texture_pixels
from stable_data.geometry.mesh import Mesh, double_areas
from stable_data.geometry.mesh_colors import texture_colours
from stable_data.geometry.surface import Surface
from stable_data.scene import FloatArray, IntArray

_MANY_FACES = 1_000_000  # more are clustered first: the simplification needs about 0.5 GB for a million
_CELLS = 512  # of a side of the box, for clustering
_UV_CELLS = 256  # of the unit square of texture coordinates, so that corners of different charts stay apart
_SLACK = 1.1  # a result with more faces than this times the wanted number has too many seams
_LEAST_AREA = 0.95  # of the source: if less is left, charts have vanished
_WELD = 1e-6  # share of the largest extent; nearer corners are one
_PROBES = 20_000  # corners of the source whose distance is measured


def reduce_surfaces(surfaces: Sequence[Surface], max_faces: int) -> tuple[list[Surface], float]:
    """Reduces surfaces to a number of triangles.

    Corners are joined within each chart of a texture, and new corners get the colours and texture coordinates of the nearest point
    of their chart. If there are too many charts to reduce them one by one, the textures are sampled into colours of the corners.

    Args:
        surfaces: At least one triangle in all. Their images are PNG or JPEG, as
            :func:`stable_data.geometry.images.encode_texture` makes them.
        max_faces: Number of triangles, which the result may exceed by a tenth.

    Returns:
        The surfaces, those without a triangle left out; and the maximum distance between them and the given ones, measured at
        corners, in their unit. It includes a bound for the step that comes before if there are more than a million triangles.

    Raises:
        MeshError: An image cannot be read.
    """
    given = [surface for surface in surfaces if len(surface.triangles)]
    if sum(len(surface.triangles) for surface in given) <= max_faces:
        return given, 0.0
    moved = 0.0
    if sum(len(surface.triangles) for surface in given) > _MANY_FACES:
        given, moved = _clustered(given)
    source = _Source.of_surfaces(given)
    joined = source.joined(with_seams=any(surface.image is not None for surface in given))
    reduced, charts = _simplified(joined, max_faces), _charts(joined)
    if len(reduced.faces) > _SLACK * max_faces or double_areas(reduced).sum() < _LEAST_AREA * double_areas(joined).sum():
        given = [_baked(surface) for surface in given]
        source = _Source.of_surfaces(given)
        reduced, charts = _simplified(source.joined(with_seams=False), max_faces), np.zeros(len(source.triangles), np.int64)
    return source.transferred(reduced, charts), moved + source.distance(reduced)


def _clustered(surfaces: Sequence[Surface]) -> tuple[list[Surface], float]:
    """Joins the corners in each cell of a grid and drops triangles that collapse; and the largest distance of a move."""
    low = np.min([s.triangles.min(axis=(0, 1)) for s in surfaces], axis=0)
    high = np.max([s.triangles.max(axis=(0, 1)) for s in surfaces], axis=0)
    cell = max(float((high - low).max()), 1e-300) / _CELLS
    found = []
    for surface in surfaces:
        x, y, z = np.minimum((surface.triangles.reshape(-1, 3) - low) / cell, _CELLS - 1).astype(np.int64).T
        key = (x << 20) | (y << 10) | z
        if surface.corner_uv is not None:
            u, v = np.floor(_UV_CELLS * (np.nan_to_num(surface.corner_uv.reshape(-1, 2)) % 1.0)).astype(np.int64).T
            key = (key << 18) | (u << 9) | v
        _, first, group = np.unique(key, return_index=True, return_inverse=True)
        corner = first[group].reshape(-1, 3)
        a, b, c = corner.T
        corner = corner[(a != b) & (b != c) & (c != a)]
        found.append(_with_corners(surface, corner))
    return [surface for surface in found if len(surface.triangles)], float(np.sqrt(3) * cell)


def _with_corners(surface: Surface, corner: IntArray) -> Surface:
    """The triangles (F, 3) of some of a surface's corners, by their numbers."""

    def chosen(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else values.reshape(-1, values.shape[-1])[corner]

    return replace(
        surface,
        triangles=surface.triangles.reshape(-1, 3)[corner],
        corner_uv=chosen(surface.corner_uv),
        corner_colours=chosen(surface.corner_colours),
    )


def _baked(surface: Surface) -> Surface:
    """A surface whose texture, base colour and corner colours are all colours of its corners."""
    colours = np.ones_like(surface.triangles) * np.array(surface.colour or (1.0, 1.0, 1.0))
    if surface.corner_colours is not None:
        colours = colours * surface.corner_colours
    if surface.image is not None and surface.corner_uv is not None:
        pixels = texture_pixels(surface.image, has_alpha=surface.has_alpha)
        colours = colours * texture_colours(pixels[..., :3], surface.corner_uv)
    return Surface(surface.triangles, None, colours, opacity=surface.opacity)


def _simplified(mesh: Mesh, max_faces: int) -> Mesh:
    points, triangles = fast_simplification.simplify(
        mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), target_count=max_faces
    )
    return Mesh(points, triangles)


def _charts(mesh: Mesh) -> IntArray:
    """The number of the connected piece of each face, (F,)."""
    a, b, c = mesh.faces.T
    size = len(mesh.vertices)
    edges = sp.coo_array((np.ones(2 * len(a), bool), (np.r_[a, b], np.r_[b, c])), (size, size))
    return np.asarray(connected_components(edges, directed=False)[1][a], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """All triangles of some surfaces.

    Attributes:
        surfaces: The surfaces.
        triangles: (F, 3, 3).
        values: Texture coordinates and colours of the corners, (F, 3, 5); zero where a surface has none.
        of: Index of the surface of each triangle, (F,).
    """

    surfaces: Sequence[Surface]
    triangles: FloatArray
    values: FloatArray
    of: IntArray

    @classmethod
    def of_surfaces(cls, surfaces: Sequence[Surface]) -> "_Source":
        counts = [len(s.triangles) for s in surfaces]
        values = np.zeros((sum(counts), 3, 5))
        for s, end in zip(surfaces, np.cumsum(counts), strict=True):
            own = values[end - len(s.triangles) : end]
            if s.corner_uv is not None:
                own[..., :2] = np.nan_to_num(s.corner_uv)
            if s.corner_colours is not None:
                own[..., 2:] = np.nan_to_num(s.corner_colours)
        return cls(surfaces, np.concatenate([s.triangles for s in surfaces]), values, np.repeat(np.arange(len(counts)), counts))

    def joined(self, *, with_seams: bool) -> Mesh:
        """The triangles with common corners; with seams, corners of other texture coordinates or surfaces remain apart."""
        corners = self.triangles.reshape(-1, 3)
        extent = float(np.ptp(corners, axis=0).max())
        columns = [np.rint((corners - corners.min(axis=0)) / max(_WELD * extent, 1e-300)).astype(np.int32)]
        if with_seams:
            columns += [self.values[..., :2].reshape(-1, 2).astype(np.float32).view(np.int32), self.of.repeat(3)[:, None]]
        rows = np.ascontiguousarray(np.concatenate(columns, axis=1, dtype=np.int32, casting="same_kind"))
        key = rows.view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).ravel()
        _, first, group = np.unique(key, return_index=True, return_inverse=True)
        return Mesh(corners[first], group.reshape(-1, 3))

    def transferred(self, mesh: Mesh, charts: IntArray) -> list[Surface]:
        """The surfaces with the triangles of a reduced mesh.

        Args:
            mesh: The mesh.
            charts: The chart of each triangle of the source, (F,). A face takes its values from the chart that is nearest to it.
        """
        triangles = mesh.triangles
        nearest = self._nearest(triangles.mean(axis=1), np.arange(len(self.triangles)))[0]
        chart, values = charts[nearest], np.empty((len(triangles), 3, 5))
        by_chart, starts = np.argsort(charts, kind="stable"), np.r_[0, np.cumsum(np.bincount(charts))]
        order = np.argsort(chart, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(chart[order])) + 1):
            if len(rows):
                own = by_chart[starts[chart[rows[0]]] : starts[chart[rows[0]] + 1]]
                face, weights = self._nearest(triangles[rows].reshape(-1, 3), own)
                values[rows] = np.einsum("pc,pcv->pv", weights, self.values[face]).reshape(-1, 3, 5)
        found = []
        for number, surface in enumerate(self.surfaces):
            rows = np.flatnonzero(self.of[nearest] == number)
            uv = None if surface.corner_uv is None else values[rows, :, :2]
            colours = None if surface.corner_colours is None else values[rows, :, 2:]
            found.append(replace(surface, triangles=triangles[rows], corner_uv=uv, corner_colours=colours))
        return [surface for surface in found if len(surface.triangles)]

    def _nearest(self, points: FloatArray, own: IntArray) -> tuple[IntArray, FloatArray]:
        """The nearest of some triangles to each point, (P,), and the barycentric coordinates of the nearest place in it, (P, 3)."""
        corners = self.triangles[own].reshape(-1, 3)
        _, face, place = igl.point_mesh_squared_distance(points, corners, np.arange(len(corners)).reshape(-1, 3))
        a, b, c = self.triangles[own[face]].transpose(1, 0, 2)
        u, v, w = b - a, c - a, place - a
        uu, uv, vv, wu, wv = ((p * q).sum(axis=1) for p, q in ((u, u), (u, v), (v, v), (w, u), (w, v)))
        det = uu * vv - uv * uv
        is_flat = det <= 1e-12 * uu * vv
        safe = np.where(is_flat, 1.0, det)
        second, third = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
        weights = np.clip(np.stack([1 - second - third, second, third], axis=1), 0.0, 1.0)
        weights[is_flat] = 1 / 3
        return own[face], weights / weights.sum(axis=1, keepdims=True)

    def distance(self, mesh: Mesh) -> float:
        """The largest distance between corners and middles of one side and the surface of the other."""
        corners = self.triangles.reshape(-1, 3)
        soup = np.arange(len(corners)).reshape(-1, 3)
        of_mesh = np.concatenate([mesh.vertices, mesh.triangles.mean(axis=1)])
        probes = corners[:: max(1, len(corners) // _PROBES)]
        there = igl.point_mesh_squared_distance(of_mesh, corners, soup)[0]
        back = igl.point_mesh_squared_distance(probes, mesh.vertices, mesh.faces)[0]
        return float(np.sqrt(max(there.max(), back.max())))
