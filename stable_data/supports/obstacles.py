"""What rises around a surface of a support, as convex bodies: walls and ceilings of a shelf, a lamp on a desk.

The mesh of a support may be open, double or thin. Its vertical projections between two heights are exact polygons, so the bodies
are vertical prisms on convex pieces of these. They contain all of the mesh that lies above the surface; between two levels of the
mesh they are as wide as it is anywhere there.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import shapely

from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, SupportFrame, Tabletop
from stable_data.supports.finding import SupportLimits
from stable_data.supports.shadow import Shadows, common, grown, union
from stable_data.supports.surface import SupportSurface, TabletopFit

_REACH = 0.03  # metres around a table in which things are in the way
_CEILING = 0.02  # metres: thickness of the body for what covers a table
_THICKNESS = 1e-3  # metres that a sheet is given on both sides
_STEP = 5e-3  # levels that are nearer than this count as one, metres
_MOST_LEVELS = 16
_LAYER = 0.05  # greatest height of a layer without level faces, metres
_SAME = 3e-3  # metres: layers whose outlines differ by less are one
_GAP = 4e-3  # metres: half the width of gaps that are closed
_BULGE = 2e-4  # m² by which the hull of a piece may be larger than it,
_BULGE_SHARE = 0.05  # and as a share
_MOST_CUTS = 6  # halvings of a piece
_LEAST = 1e-7  # m²: smaller pieces are dropped
_LIMITS = SupportLimits()


def to_frame(mesh: Mesh, frame: SupportFrame) -> Mesh:
    """Returns a mesh of a support in the frame of a scene on it, metres."""
    moved = mesh.vertices - np.array(frame.origin)
    return Mesh(np.column_stack([rotate_xy(moved[:, :2], -frame.yaw), moved[:, 2]]), mesh.faces)


def seen_from_open_side(mesh: Mesh, surface: SupportSurface, fit: TabletopFit, others: Sequence[Mesh] = ()) -> TabletopFit:
    """Turns a table so that its viewer stands where least is in the way, preferably at a long side.

    Args:
        mesh: The support, metres, z up.
        surface: The surface.
        fit: The table on it.
        others: Things fixed on the support, in its frame.
    """
    parts = find_obstacles(mesh, fit.frame(surface), fit.tabletop, others)
    ceiling = (fit.tabletop.clearance or math.inf) - 2 * _THICKNESS
    low = [part for part in parts if part.vertices[:, 2].min() < ceiling]
    shadow = union([shapely.convex_hull(shapely.multipoints(part.vertices[:, :2])) for part in low])
    width, depth = fit.tabletop.size_xy
    sides = [
        (0, -_REACH, width, 0),
        (width, 0, width + _REACH, depth),
        (0, depth, width, depth + _REACH),
        (-_REACH, 0, 0, depth),
    ]
    ranks = []
    for quarters, side in enumerate(sides):
        length, other = (width, depth) if quarters % 2 == 0 else (depth, width)
        pieces = shapely.get_parts(shapely.intersection(shadow, shapely.box(*side)))
        # What a person at that side sees as a wall: the pieces' extents along it.
        low_x, low_y, high_x, high_y = shapely.bounds(pieces).reshape(-1, 4).T
        spans = shapely.box(low_x, 0.0, high_x, 1.0) if quarters % 2 == 0 else shapely.box(low_y, 0.0, high_y, 1.0)
        blocked = round(float(shapely.union_all(spans).area) / length, 1)
        ranks.append((blocked >= 0.5, length < other - _STEP, blocked, quarters))
    return fit.turned(min(ranks)[-1])


def find_obstacles(
    mesh: Mesh, frame: SupportFrame, table: Tabletop, others: Sequence[Mesh] = (), limits: SupportLimits = _LIMITS
) -> tuple[Mesh, ...]:
    """Finds what rises from a surface of a support or hangs over it, near a table on it.

    Args:
        mesh: The support, metres, z up.
        frame: The table's frame on the support.
        table: The table.
        others: Things fixed on the support, in its frame.
        limits: What counts as part of the plane, and how far up things are looked for.

    Returns:
        Closed convex bodies, metres, in the frame of the table; none reaches lower than 2 mm above its plane.
    """
    shadows = Shadows(to_frame(join_meshes([mesh, *others]), frame))
    (width, depth), low = table.size_xy, limits.flatness
    high = limits.high if table.clearance is None else table.clearance - _THICKNESS
    free = shapely.box(0.0, 0.0, width, depth)
    if table.restricted_zone is not None:
        x_min, x_max, y_min, y_max = table.restricted_zone
        free = shapely.difference(free, shapely.box(x_min, y_min, x_max, y_max))
    area = shapely.box(-_REACH, -_REACH, width + _REACH, depth + _REACH)
    found: list[tuple[float, float, shapely.Geometry]] = []
    for start, end in _layers(shadows.levels(area, low, high)):
        shape = grown(grown(shadows.between(area, start, end, _THICKNESS), _GAP), -_GAP)
        shape = union([_filled(part, free) for part in shapely.get_parts(common(shape, area))])
        if found and found[-1][1] == start and _are_near(found[-1][2], shape):
            found[-1] = (found[-1][0], end, union([found[-1][2], shape]))
        elif not shape.is_empty:
            found.append((start, end, shape))
    if table.clearance is not None:
        if found and found[-1][1] == high:  # what is beside the table reaches up to its ceiling
            found[-1] = (found[-1][0], table.clearance, found[-1][2])
        # Over the table alone: beside it may be the room of another surface.
        found.append((high, high + _CEILING, shapely.box(0.0, 0.0, width, depth)))
    return tuple(
        _prism(piece, start, end)
        for start, end, shape in found
        for part in shapely.get_parts(shape)
        for piece in _convex_pieces(part)
    )


def _layers(levels: FloatArray) -> Iterator[tuple[float, float]]:
    """Layers, each from a height to another one: thin ones around the levels of faces, and those between, of limited height."""
    step = _STEP
    while len(groups := np.split(levels, np.flatnonzero(np.diff(levels) >= step) + 1)) > _MOST_LEVELS:
        step *= 1.5
    low, high = float(levels[0]), float(levels[-1])
    reached = low
    for group in groups:
        start, end = max(low, float(group[0]) - _THICKNESS), min(high, float(group[-1]) + _THICKNESS)
        if start > reached:
            between = np.linspace(reached, start, math.ceil((start - reached) / _LAYER) + 1).tolist()
            yield from pairwise(between)
        if end > start:
            yield start, end
        reached = end


def _are_near(one: shapely.Geometry, other: shapely.Geometry) -> bool:
    """Whether two shapes are nearly the same."""
    return bool(shapely.buffer(one, _SAME).covers(other) and shapely.buffer(other, _SAME).covers(one))


def _filled(part: shapely.Geometry, free: shapely.Geometry) -> shapely.Geometry:
    """A polygon without the holes that are inside of a body; the free area may lie in a hole, such as the ground of a tray."""
    holes = [ring for ring in part.interiors if shapely.intersection(shapely.Polygon(ring), free).area > _LEAST]
    return shapely.Polygon(part.exterior, holes)


def _convex_pieces(polygon: shapely.Polygon, cuts: int = 0) -> Iterator[shapely.Polygon]:
    """Halves a polygon until its pieces are nearly convex, and returns their hulls."""
    if polygon.geom_type != "Polygon" or polygon.area < _LEAST:
        return
    hull = shapely.convex_hull(polygon)
    if cuts == _MOST_CUTS or hull.area - polygon.area <= max(_BULGE, _BULGE_SHARE * polygon.area):
        yield hull
        return
    x_min, y_min, x_max, y_max = shapely.bounds(polygon)
    best: tuple[float, list[shapely.Geometry]] = (math.inf, [])
    for axis, (low, high) in enumerate(((x_min, x_max), (y_min, y_max))):
        corners = shapely.get_coordinates(polygon)[:, axis]
        inner = np.unique(corners[(corners > low + _THICKNESS) & (corners < high - _THICKNESS)])
        places = inner[np.linspace(0, len(inner) - 1, min(len(inner), 12)).round().astype(int)] if len(inner) else inner
        for at in {(low + high) / 2, *places.tolist()}:
            sides = ((x_min, y_min, at, y_max), (at, y_min, x_max, y_max)) if axis == 0 else (
                (x_min, y_min, x_max, at), (x_min, at, x_max, y_max))  # fmt: skip
            pieces = [
                part
                for side in sides
                for part in shapely.get_parts(shapely.intersection(polygon, shapely.box(*side)))
                if part.geom_type == "Polygon"
            ]
            cost = float(sum(shapely.convex_hull(part).area for part in pieces)) + _BULGE * len(pieces)
            best = min(best, (cost, pieces), key=lambda found: found[0])
    for piece in best[1]:
        yield from _convex_pieces(piece, cuts + 1)


def _prism(outline: shapely.Polygon, low: float, high: float) -> Mesh:
    """A convex polygon, extruded between two heights; faces outward."""
    ring = shapely.get_coordinates(shapely.orient_polygons(shapely.simplify(outline, 1e-5)).exterior)[:-1]
    count = len(ring)
    vertices = np.concatenate([np.column_stack([ring, np.full(count, z)]) for z in (low, high)])
    k = np.arange(count)
    n = (k + 1) % count
    fan = np.arange(1, count - 1)
    zero = np.zeros(count - 2, np.int64)
    faces = [
        np.column_stack([k, n, n + count]),
        np.column_stack([k, n + count, k + count]),
        np.column_stack([zero, fan + 1, fan]),
        np.column_stack([zero, fan, fan + 1]) + count,
    ]
    return Mesh(vertices, np.concatenate(faces))
