"""Vertical projections of what a mesh has between two heights, as exact polygons."""

from typing import Any

import numpy as np
import shapely

from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray

_SNAP = 1e-6  # grid of coordinates in unions, metres
_FLATTEST = 1e-12  # area of a slice that shades nothing, m²
_LEVEL = 1e-3  # rise of a triangle that counts as level, metres
_BESIDE = 0.01  # metres around a shape in which triangles are near it


class Shadows:
    """The projections of a mesh; metres.

    Args:
        mesh: Its triangles may be in any order and wound in any direction.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._triangles = mesh.triangles
        heights = self._triangles[..., 2]
        self._low, self._high = heights.min(axis=1), heights.max(axis=1)

    def between(self, area: shapely.Geometry, low: float, high: float, margin: float = 0.0) -> shapely.Geometry:
        """Returns the projection of what lies between two heights near an area, with a margin; without one walls have no area."""
        shapes = slices(self._triangles[self._rows(area, low, high)], low, high)
        if not margin:
            return union(shapes[shapely.area(shapes) > _FLATTEST])
        # Before they are joined: the slice of a wall is a line or a sliver, which a union drops.
        return union(shapely.buffer(shapes, margin, quad_segs=2))

    def lowest_above(self, area: shapely.Geometry, low: float, high: float) -> float | None:
        """Returns the lowest height between two heights at which something is over an area; None if nothing is."""
        rows = self._rows(area, low, high)
        shapely.prepare(area)
        above = rows[shapely.intersects(area, slices(self._triangles[rows], low, high))]
        return float(np.maximum(self._low[above], low).min()) if len(above) else None

    def levels(self, area: shapely.Geometry, low: float, high: float) -> FloatArray:
        """Returns the heights of level faces near an area that lie between two heights, and these two, rising."""
        rows = self._rows(area, low, high)
        rows = rows[self._high[rows] - self._low[rows] < _LEVEL]
        heights = self._low[rows]
        return np.unique(np.r_[low, heights[(heights > low) & (heights < high)], high])

    def _rows(self, area: shapely.Geometry, low: float, high: float) -> Any:
        """The triangles between two heights of which the box meets that of an area, (F,) int64."""
        x_min, y_min, x_max, y_max = shapely.bounds(area)
        flat = self._triangles[..., :2]
        start, end = flat.min(axis=1), flat.max(axis=1)
        near = ((end >= (x_min - _BESIDE, y_min - _BESIDE)) & (start <= (x_max + _BESIDE, y_max + _BESIDE))).all(axis=1)
        return np.flatnonzero((self._high >= low) & (self._low < high) & near)


def slices(triangles: FloatArray, low: float, high: float) -> Any:
    """Returns the vertical projections of the parts of triangles (F, 3, 3) between two heights, (F,) shapes: convex."""
    shapes = np.full(len(triangles), shapely.Polygon(), dtype=object)
    flat, heights = triangles[..., :2], triangles[..., 2]
    (ax, ay), (bx, by) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    is_whole = (abs(ax * by - ay * bx) > 2 * _FLATTEST) & (heights >= low).all(axis=1) & (heights <= high).all(axis=1)
    shapes[is_whole] = shapely.polygons(flat[is_whole])  # most of a fine mesh
    rest = np.flatnonzero(~is_whole & (heights.max(axis=1) >= low) & (heights.min(axis=1) <= high))
    shapes[rest] = _cut_slices(triangles[rest], low, high)
    return shapes


def _cut_slices(triangles: FloatArray, low: float, high: float) -> Any:
    """The same for triangles of which a part is between the heights, or that are upright."""
    a, b = triangles, np.roll(triangles, -1, axis=1)
    corners = [a]
    for level in (low, high):
        rise = b[..., 2] - a[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (level - a[..., 2]) / rise
        crosses = (share >= 0) & (share <= 1)
        share = np.where(crosses, share, 0.0)[..., None]
        point = a + share * (b - a)
        point[..., 2] = np.where(crosses, level, np.inf)  # left out below
        corners.append(point)
    points = np.concatenate(corners, axis=1)
    is_in = (points[..., 2] >= low) & (points[..., 2] <= high)
    first = points[np.arange(len(points)), is_in.argmax(axis=1)]
    points = np.where(is_in[..., None], points, first[:, None])  # a point twice changes no hull
    some = is_in.any(axis=1)
    count = points.shape[1]
    clouds = shapely.multipoints(points[some][..., :2].reshape(-1, 2), indices=np.arange(some.sum()).repeat(count))
    shapes = np.full(len(triangles), shapely.Polygon(), dtype=object)
    shapes[some] = shapely.convex_hull(clouds)
    return shapes


def union(shapes: Any) -> shapely.Geometry:
    """Returns the union of shapes, of which polygons alone remain."""
    # Snapping afterwards closes the same slits in a fifth of the time.
    return polygons(shapely.set_precision(shapely.union_all(shapes), _SNAP))


def polygons(shape: shapely.Geometry) -> shapely.Geometry:
    """Returns a shape without points and lines, which operations leave where outlines touch."""
    parts = [part for part in shapely.get_parts(shape) if part.geom_type in ("Polygon", "MultiPolygon")]
    found = shapely.multipolygons(shapely.get_parts(parts)) if parts else shapely.Polygon()
    return found if shapely.is_valid(found) else polygons(shapely.make_valid(found))


def grown(shape: shapely.Geometry, by: float) -> shapely.Geometry:
    """Returns a shape that is wider by a distance on all sides, with sharp corners; such a buffer is not always valid."""
    return polygons(shapely.buffer(shape, by, join_style="mitre"))


def common(one: shapely.Geometry, other: shapely.Geometry) -> shapely.Geometry:
    """Returns what two shapes have in common."""
    return polygons(shapely.intersection(one, other, grid_size=_SNAP))


def without(one: shapely.Geometry, other: shapely.Geometry) -> shapely.Geometry:
    """Returns a shape without another one."""
    return polygons(shapely.difference(one, other, grid_size=_SNAP))
