"""The support surfaces of a scene file: level tops of what does not move, and which of them carries each free body."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from stable_data.errors import SceneError
from stable_data.geometry.mesh import unit_normals
from stable_data.importers.scenes.scene_file import SceneBody, SceneFile
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, Vec3

_LEVEL = math.cos(math.radians(3.0))  # least vertical component of the normal of a top
_SAME_HEIGHT = 2e-3  # metres between tops of one body that are one surface
_SMALLEST = 0.08  # metres: the shorter side of a surface; smaller tops are things that may carry others, not tables
_BESIDE = 0.05  # metres by which a centre may lie beside its surface
_GROUND_MARGIN = 0.5  # metres of the ground around the bodies on it
_FARTHEST = 1e4  # metres from the origin
_CELLS = 96  # raster of an outline that is no rectangle, along each side


@dataclass(frozen=True, slots=True, eq=False)
class SceneSurface:
    """A level rectangle on which things stand.

    Attributes:
        owner: Name of the body that has it.
        origin: Its corner with the least x and y, in its own frame; metres, frame of the file.
        yaw: Rotation of its frame about +z, radians, between -45 and 45 degrees.
        size_xy: Its extents, metres.
        names: The free bodies on it.
    """

    owner: str
    origin: Vec3
    yaw: float
    size_xy: tuple[float, float]
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Top:
    owner: str
    height: float
    outline: shapely.Geometry | None  # None: unlimited

    @cached_property
    def rectangle(self) -> tuple[FloatArray, float, FloatArray]:
        """The rectangle of its outline: its corner (2,), yaw and extents (2,); inside of an outline that is no rectangle."""
        assert self.outline is not None
        return _rectangle(self.outline)


def find_supports(file: SceneFile, table: str = "") -> list[SceneSurface]:
    """Finds the surfaces on which the free bodies of a scene stand, or over which they hang.

    Args:
        file: The scene.
        table: The body whose highest large surface carries all free bodies; empty: for each free body, the surface below it, or
            without one the surface with the most bodies.

    Returns:
        The surfaces with the most bodies first.

    Raises:
        SceneError: There is no such body or it has no surface (``table_unknown``), nothing is below any free body (``no_table``), or
            a body is kilometres away (``pose_implausible``).
    """
    for body in file.bodies:
        if not max(map(abs, body.position)) <= _FARTHEST:
            raise SceneError(
                f"{file.path}: {body.name!r} is at {body.position}, expected at most {_FARTHEST:,.0f} m from the origin; correct it",
                "pose_implausible",
            )
    tops = list(_tops(file))
    free = [body for body in file.bodies if body.is_free]
    groups: dict[int, list[SceneBody]] = defaultdict(list)
    if table:
        own = [k for k, top in enumerate(tops) if top.owner == table]
        if not own:
            there = ", ".join(sorted({top.owner for top in tops})[:12]) or "none"
            raise SceneError(
                f"{file.path}: {table!r} has no level surface, expected a body that has one: {there}", "table_unknown"
            )
        groups[max(own, key=lambda k: (_area(tops[k]) > _SMALLEST, tops[k].height))] = free
    lost = list[SceneBody]()
    for body in free if not table else ():
        points = np.concatenate([body.placed(part) for part in body.parts])
        below = [(top.height, k) for k, top in enumerate(tops) if _is_below(top, body.center, points)]
        if below:
            groups[max(below)[1]].append(body)
        else:
            lost.append(body)
    if not groups:
        found = "no level surface is below its free bodies, expected a table or a floor that collides"
        raise SceneError(f"{file.path}: {found}; name it with --table", "no_table")
    max(groups.values(), key=len).extend(lost)  # it is judged there: it floats, or is out of bounds
    ordered = sorted(groups.items(), key=lambda item: (-len(item[1]), tops[item[0]].owner, tops[item[0]].height))
    return [_surface(tops[k], bodies) for k, bodies in ordered]


def _tops(file: SceneFile) -> Iterator[_Top]:
    """The level surfaces that are large enough for things to stand on."""
    outlines: dict[str, list[tuple[float, shapely.Geometry]]] = defaultdict(list)
    for body in file.bodies:
        if body.is_free:
            continue
        for part in body.parts:
            triangles = body.placed(part)[part.faces]
            normals, _ = unit_normals(triangles)
            level = triangles[normals[:, 2] > _LEVEL]
            if len(level):
                flat = level[level[:, :, 2].max(axis=1) > level[:, :, 2].max() - _SAME_HEIGHT].reshape(-1, 3)
                outlines[body.name].append((float(flat[:, 2].max()), shapely.MultiPoint(flat[:, :2]).convex_hull))
    for owner, found in outlines.items():
        found.sort(key=lambda pair: -pair[0])
        while found:
            height = found[0][0]
            same = [outline for z, outline in found if z > height - _SAME_HEIGHT]
            found = [pair for pair in found if pair[0] <= height - _SAME_HEIGHT]
            # Neighbouring boards meet in one line; a slight growth joins them.
            joined = shapely.union_all([o.buffer(1e-4, join_style="mitre") for o in same])
            for outline in shapely.get_parts(joined):
                top = _Top(owner, height, outline)
                if min(top.rectangle[2]) >= _SMALLEST:
                    yield top
    for ground in file.grounds:
        yield _Top(ground.owner, ground.height, None)


def _area(top: _Top) -> float:
    return math.inf if top.outline is None else float(top.outline.area)


def _is_below(top: _Top, centre: FloatArray, points: FloatArray) -> bool:
    """Whether a surface is below the upper part of a body with a centre (3,) and corners (V, 3), which may have sunk into it."""
    if top.height > max(float(centre[2]) + 0.01, float(points[:, 2].max()) - 0.02):
        return False
    if top.outline is not None and (np.sort(top.rectangle[2]) < np.sort(np.ptp(points, axis=0))[:2]).any():
        return False  # a lid over its box: the box stands on a table itself
    return top.outline is None or bool(shapely.distance(top.outline, shapely.Point(centre[:2])) <= _BESIDE)


def _surface(top: _Top, bodies: Sequence[SceneBody]) -> SceneSurface:
    names = tuple(body.name for body in bodies)
    if top.outline is None:
        points = np.concatenate([body.placed(part)[:, :2] for body in bodies for part in body.parts])
        low, high = points.min(axis=0) - _GROUND_MARGIN, points.max(axis=0) + _GROUND_MARGIN
        origin, yaw, size = low, 0.0, high - low
    else:
        origin, yaw, size = top.rectangle
    x, y = origin.tolist()
    return SceneSurface(top.owner, (x, y, top.height), yaw, (float(size[0]), float(size[1])), names)


def _rectangle(outline: shapely.Geometry) -> tuple[FloatArray, float, FloatArray]:
    """The rectangle of a surface: its corner (2,), yaw and extents (2,); inside of an outline that is no rectangle."""
    around = outline.minimum_rotated_rectangle
    if around.geom_type != "Polygon":
        return np.zeros(2), 0.0, np.zeros(2)
    corners = np.array(around.exterior.coords)
    edge = corners[1] - corners[0]
    yaw = math.remainder(math.atan2(edge[1], edge[0]), math.pi / 2)
    if abs(yaw) < 1e-6:
        yaw = 0.0
    turned = shapely.transform(outline, lambda points: rotate_xy(points, -yaw))
    low_x, low_y, high_x, high_y = turned.bounds
    low, size = np.array([low_x, low_y]), np.array([high_x - low_x, high_y - low_y])
    if turned.area < 0.985 * float(size.prod()):
        low, size = _largest_inside(turned)
    return rotate_xy(low, yaw), yaw, size


def _largest_inside(outline: shapely.Geometry) -> tuple[FloatArray, FloatArray]:
    """The largest rectangle along the axes in an outline, on a raster: its corner (2,) and extents (2,)."""
    low_x, low_y, high_x, high_y = outline.bounds
    xs, ys = np.linspace(low_x, high_x, _CELLS + 1), np.linspace(low_y, high_y, _CELLS + 1)
    cells = shapely.box(xs[:-1, None], ys[None, :-1], xs[1:, None], ys[None, 1:])
    shapely.prepare(outline)
    inside = shapely.contains(outline, cells)
    best, found = 0.0, (0, 0, 0, 0)
    run = np.zeros(_CELLS, np.int64)
    for row in range(_CELLS):
        run = np.where(inside[row], run + 1, 0)
        for height in np.unique(run[run > 0]):
            wide = np.flatnonzero(np.diff(np.concatenate([[0], run >= height, [0]]).astype(np.int64)))
            for first, last in wide.reshape(-1, 2):
                area = float((xs[row + 1] - xs[row + 1 - height]) * (ys[last] - ys[first]))
                if area > best:
                    best, found = area, (row + 1 - height, row + 1, first, last)
    low, high = np.array([xs[found[0]], ys[found[2]]]), np.array([xs[found[1]], ys[found[3]]])
    return low, high - low
