"""Finds the surfaces of a mesh on which objects can stand.

Faces that look up and lie in a plane are joined to regions. What rises above a plane, of the mesh itself or beside it, is cut out;
what a ceiling covers is a surface of its own, such as the board of a shelf. A region counts if a disc of a certain width fits into
it, if it has room above, and if it can be reached from outside. Shapes are exact: no grid and no sampling decides on an outline.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import igl
import numpy as np
import shapely

from stable_data.errors import MeshError
from stable_data.geometry.mesh import Mesh, join_meshes, unit_normals
from stable_data.limits import LIMITS, SETTING
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray
from stable_data.supports.shadow import Shadows, common, grown, union, without
from stable_data.supports.surface import SupportSurface


@dataclass(frozen=True, slots=True)
class SupportLimits:
    """What counts as a surface; lengths in metres, areas in square metres, angles in radians.

    Attributes:
        slope: Largest angle of a face to the horizontal.
        mean_slope: Largest angle of a whole plane.
        flatness: Largest difference of height within a plane.
        clearance: Least room above a surface.
        high: What is higher above a surface does not limit it.
        area: Least area.
        width: Diameter of a disc that must fit.
        gap: Seams up to this width are closed.
        fin: Parts of a region narrower than this are dropped.
        margin: Distance from things that rise above a surface.
        reach: Least share of directions, from above a surface to the upper half space, that meet nothing.
        max_faces: A mesh with more faces is refused.
    """

    slope: float = math.radians(5.0)
    mean_slope: float = math.radians(0.75)
    flatness: float = 0.002
    clearance: float = 0.05
    high: float = 1.0
    area: float = 0.01
    width: float = 0.1
    gap: float = 0.003
    fin: float = 0.02
    margin: float = 0.002
    reach: float = 0.02
    max_faces: int = LIMITS.work.max_support_faces


_LEAST_CEILING = 0.1  # share of a plane that must be covered so that the covered part is a surface of its own
_FRAME_GAIN = 0.98  # a turned frame must have a box smaller than this share of the straight one
_SMOOTH = 5e-4  # by which outlines are simplified, metres
_MOST_POINTS = 24  # from which it is tested whether a region can be reached
_DIRECTIONS = 64
_MOST_LEVELS = 64  # planes of a mesh that are looked at, the largest first


def find_surfaces(
    mesh: Mesh, obstacles: Sequence[Mesh] = (), limits: SupportLimits = SupportLimits()
) -> tuple[SupportSurface, ...]:
    """Finds the surfaces of a mesh on which objects can stand, from the highest to the lowest.

    Faces may be in any order, double, wound in any direction and not joined; the mesh may be open.

    Args:
        mesh: The support, metres, z up.
        obstacles: Things fixed on it, in its frame; they take away room and carry nothing.
        limits: What counts as a surface.

    Returns:
        The surfaces. The largest that is open above is called ``top``, other open ones ``level_1``, …; those below a ceiling are
        ``shelf_1``, …; counted from above.

    Raises:
        MeshError: Coordinates are not finite (``not_finite``), or there are too many faces (``mesh_too_large``).
    """
    whole = join_meshes([mesh, *obstacles])
    if not np.isfinite(whole.vertices).all():
        raise MeshError("the support has corners that are not finite, expected finite metres; repair it", "not_finite")
    if len(whole.faces) > limits.max_faces:
        raise MeshError(
            f"the support has {len(whole.faces)} faces, expected at most {limits.max_faces:,} (work.max_support_faces in {SETTING}); "
            "reduce it",
            "mesh_too_large",
        )
    if not len(whole.faces):
        return ()
    space = _Space(whole, limits)
    found = [region for height, faces in _levels(mesh, limits) for region in space.regions(height, faces)]
    found = _without_doubles(found, limits)
    found.sort(key=lambda r: (-round(r.height / limits.flatness), -round(r.shape.area, 6), r.shape.centroid.coords[0]))
    return tuple(_surface(region, name) for region, name in zip(found, _names(found), strict=True))


@dataclass(frozen=True, slots=True)
class _Region:
    """A free region of a plane, in the frame of the support."""

    height: float
    shape: shapely.Polygon
    clearance: float | None


def _levels(mesh: Mesh, limits: SupportLimits) -> Iterator[tuple[float, FloatArray]]:
    """Planes of horizontal faces, the largest first: the mean height, and the faces' triangles (F, 3, 3)."""
    triangles = mesh.triangles
    normals, double = unit_normals(triangles)
    heights = triangles[..., 2]
    is_flat = (abs(normals[:, 2]) >= math.cos(limits.slope)) & (np.ptp(heights, axis=1) <= limits.flatness) & (double > 0)
    triangles, area, steep = triangles[is_flat], double[is_flat] / 2, normals[is_flat]
    middle = triangles[..., 2].mean(axis=1)
    order = np.argsort(middle, kind="stable")
    triangles, area, steep, middle = triangles[order], area[order], steep[order], middle[order]
    is_left = np.ones(len(middle), bool)
    for _ in range(_MOST_LEVELS):
        sums = np.r_[0.0, np.cumsum(np.where(is_left, area, 0.0))]
        last = np.searchsorted(middle, middle + limits.flatness, side="right")
        within = sums[last] - sums[:-1]
        within[~is_left] = 0.0
        # The lowest of the planes that are equally large, whatever the rounding.
        first = int(np.argmax(within >= within.max() - 1e-9)) if len(within) else 0
        if not len(within) or within[first] < limits.area:
            return
        chosen = np.zeros(len(middle), bool)
        chosen[first : last[first]] = True
        chosen &= is_left
        is_left &= ~chosen
        upward = np.where(steep[chosen, 2:] < 0, -steep[chosen], steep[chosen])
        mean = (upward * area[chosen, None]).sum(axis=0)
        if math.atan2(math.hypot(mean[0], mean[1]), mean[2]) <= limits.mean_slope:
            yield float(np.average(middle[chosen], weights=area[chosen])), triangles[chosen]


class _Space:
    """Everything of a support and on it, to see what is above a plane."""

    def __init__(self, mesh: Mesh, limits: SupportLimits) -> None:
        self._mesh, self._limits, self._shadows = mesh, limits, Shadows(mesh)

    @cached_property
    def _tree(self) -> Any:
        tree = igl.AABB()
        tree.init(self._mesh.vertices, self._mesh.faces)
        return tree

    def regions(self, height: float, faces: FloatArray) -> Iterator[_Region]:
        """The free regions of a plane at a height, whose faces are triangles (F, 3, 3)."""
        limits = self._limits
        plane = union(shapely.polygons(faces[..., :2]))
        plane = grown(grown(plane, limits.gap / 2), -limits.gap / 2)
        if not any(True for _ in self._usable(plane)):
            return
        bottom = height + limits.flatness + 1e-3
        rising = self._shadows.between(plane, bottom, height + limits.clearance, limits.margin)
        plane = without(plane, rising)
        if not any(True for _ in self._usable(plane)):
            return
        ceiling = self._shadows.between(plane, height + limits.clearance, height + limits.high, 0.0)
        covered, free = common(plane, ceiling), without(plane, ceiling)
        is_ceiling_kept = any(region.area >= _LEAST_CEILING * plane.area for region in self._usable(covered))
        is_open_kept = any(True for _ in self._usable(free))
        if is_ceiling_kept and not is_open_kept:
            parts = [(plane, True)]  # an open rim belongs to the covered part
        else:
            parts = [(free, False), (covered, True)] if is_ceiling_kept else [(free, False)]
        for part, is_covered in parts:
            for region in self._usable(part):
                if is_covered and is_open_kept and region.area < _LEAST_CEILING * plane.area:
                    continue
                clearance = self._clearance(region, height) if is_covered else None
                if self._can_be_reached(region, height, clearance):
                    yield _Region(height, region, clearance)

    def _usable(self, shape: shapely.Geometry) -> Iterator[shapely.Polygon]:
        """The polygons of a shape that are large and wide enough, without their fins."""
        limits = self._limits
        opened = common(grown(grown(shape, -limits.fin / 2), limits.fin / 2), shape)
        for part in shapely.get_parts(opened):
            if part.geom_type != "Polygon" or part.area < limits.area:
                continue
            if not shapely.buffer(part, -limits.width / 2).is_empty:
                yield _tidy(part)

    def _clearance(self, region: shapely.Polygon, height: float) -> float | None:
        """Height of the lowest thing above a region, beyond the least clearance; None if only its edge is covered."""
        low, high = height + self._limits.clearance, height + self._limits.high
        inner = shapely.buffer(region, -2 * self._limits.margin)  # what touches the region's edge is beside it
        lowest = self._shadows.lowest_above(inner, low, high)
        return None if lowest is None else lowest - height

    def _can_be_reached(self, region: shapely.Polygon, height: float, clearance: float | None) -> bool:
        """Whether one can look out from above a region: not from the inside of a closed body."""
        points = _points_in(shapely.buffer(region, -self._limits.fin / 2))
        level = height + min(clearance or self._limits.high, 0.1) / 2
        sources = np.column_stack([points, np.full(len(points), level)]).repeat(_DIRECTIONS, axis=0)
        directions = np.tile(_upper_directions(), (len(points), 1))
        face, _, _ = self._tree.intersect_ray_first(self._mesh.vertices, self._mesh.faces, sources, directions)
        return bool((face < 0).mean() >= self._limits.reach)


def _tidy(part: shapely.Polygon) -> shapely.Polygon:
    """A polygon with fewer corners, without tiny holes."""
    holes = [ring for ring in part.interiors if shapely.Polygon(ring).area > 1e-5]
    simple = shapely.simplify(shapely.Polygon(part.exterior, holes), _SMOOTH)
    return simple if simple.geom_type == "Polygon" and not simple.is_empty else part


def _points_in(shape: shapely.Geometry) -> FloatArray:
    """Some points of a shape, (P, 2), spread over it."""
    x_min, y_min, x_max, y_max = shapely.bounds(shape)
    step = max(0.02, math.sqrt(shape.area / _MOST_POINTS))
    x, y = np.meshgrid(np.arange(x_min + step / 2, x_max, step), np.arange(y_min + step / 2, y_max, step))
    points = np.column_stack([x.ravel(), y.ravel()])
    points = points[shapely.contains_xy(shape, points)]
    return np.asarray(points if len(points) else shapely.get_coordinates(shapely.point_on_surface(shape)))


def _upper_directions() -> FloatArray:
    """Directions spread evenly over the upper half space, (D, 3), unit."""
    k = np.arange(_DIRECTIONS)
    z = (k + 0.5) / _DIRECTIONS
    angle = k * math.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _without_doubles(regions: Iterable[_Region], limits: SupportLimits) -> list[_Region]:
    """Regions of planes that are nearly one another: the higher, larger one is kept."""
    kept: list[_Region] = []
    for region in sorted(regions, key=lambda r: -r.height):
        near = [k for k in kept if k.height - region.height < limits.clearance]
        if not any(shapely.intersection(k.shape, region.shape).area > 0.5 * region.shape.area for k in near):
            kept.append(region)
    return kept


def _names(regions: Sequence[_Region]) -> list[str]:
    largest = max((r for r in regions if r.clearance is None), key=lambda r: r.shape.area, default=None)
    names: list[str] = []
    counts = {"level": 0, "shelf": 0}
    for region in regions:
        if region is largest:
            names.append("top")
            continue
        kind = "level" if region.clearance is None else "shelf"
        counts[kind] += 1
        names.append(f"{kind}_{counts[kind]}")
    return names


def _surface(region: _Region, name: str) -> SupportSurface:
    """The region in a frame whose axes follow its outline."""
    yaw = _yaw_of(region.shape)
    outline, *holes = (
        rotate_xy(shapely.get_coordinates(ring)[:-1], -yaw)
        for ring in (shapely.orient_polygons(region.shape).exterior, *shapely.orient_polygons(region.shape).interiors)
    )
    corner = outline.min(axis=0)
    x, y = rotate_xy(corner[None], yaw)[0].tolist()
    return SupportSurface(
        name=name,
        origin=(x, y, region.height),
        yaw=yaw,
        outline=outline - corner,
        holes=tuple(hole - corner for hole in holes),
        clearance=region.clearance,
        area=float(region.shape.area),
    )


def _yaw_of(shape: shapely.Polygon) -> float:
    """Yaw of the smallest box around a shape, from -pi/4 to pi/4; 0 if the straight box is nearly as small."""
    box = shapely.minimum_rotated_rectangle(shape)
    x_min, y_min, x_max, y_max = shapely.bounds(shape)
    if box.area > _FRAME_GAIN * (x_max - x_min) * (y_max - y_min):
        return 0.0
    corners = shapely.get_coordinates(box)
    side = corners[1] - corners[0]
    quarter = math.pi / 2
    yaw = math.atan2(side[1], side[0])
    return yaw - quarter * round(yaw / quarter)
