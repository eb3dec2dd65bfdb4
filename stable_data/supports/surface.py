"""A surface of a support: a plane with a region on which objects can stand."""

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely

from stable_data.errors import SceneError
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, Rectangle, SupportFrame, Tabletop, Vec3

_STEP = 0.01  # of the grid on which a rectangle is searched, metres
_MOST_LINES = 400  # of that grid, along one axis
_TOLERANCE = 0.001  # by which a rectangle may leave its region, metres
_WORTH = 1.02  # a rectangle with a restricted zone must have as many times the room of the plain one


@dataclass(frozen=True, slots=True, eq=False)
class SupportSurface:
    """A plane with a free region, in a frame of its own: its plane is z = 0, and the region's box begins at the origin.

    Attributes:
        name: Unique on its support, such as ``top`` or ``shelf_2``.
        origin: The origin of its frame in the frame of the support, metres; the height of the plane is its last number.
        yaw: Rotation of its frame about +z in the frame of the support, radians, from -pi/4 to pi/4.
        outline: The outer boundary of the region, (K, 2) float64, metres, surface frame, counter-clockwise, not closed.
        holes: Boundaries of places in the region that are not free, (K, 2) each, clockwise.
        clearance: Height of the lowest thing above the region, metres above the plane; None if nothing is within a metre.
        area: Of the region, square metres.
    """

    name: str
    origin: Vec3
    yaw: float
    outline: FloatArray
    holes: tuple[FloatArray, ...]
    clearance: float | None
    area: float

    @property
    def height(self) -> float:
        """Height of the plane in the frame of the support, metres."""
        return self.origin[2]

    @property
    def size_xy(self) -> tuple[float, float]:
        """Extents of the region along the axes of its frame, metres."""
        x, y = self.outline.max(axis=0).tolist()
        return x, y

    def to_support(self, points: FloatArray) -> FloatArray:
        """Converts points (..., 3) from the surface's frame to the support's, metres."""
        flat = points.reshape(-1, 3)
        turned = np.column_stack([rotate_xy(flat[:, :2], self.yaw), flat[:, 2]]) + self.origin
        return np.asarray(turned.reshape(points.shape))


@dataclass(frozen=True, slots=True)
class TabletopFit:
    """A rectangle on a surface, as a table top.

    Attributes:
        tabletop: The rectangle as a table. Its restricted zone contains all of it that does not belong to the surface's region.
        corner: Its near left corner in the frame of the surface, metres: the table's origin.
        share: Share of the surface's region on which objects may stand, 0 to 1.
        quarters: Quarter turns of the table's frame in that of the surface, counter-clockwise.
    """

    tabletop: Tabletop
    corner: tuple[float, float]
    share: float
    quarters: int = 0

    def turned(self, quarters: int) -> "TabletopFit":
        """Returns the same rectangle, seen from another side: its x axis is turned by quarters, counter-clockwise."""
        fit = self
        for _ in range(quarters % 4):
            (width, depth), zone = fit.tabletop.size_xy, fit.tabletop.restricted_zone
            if zone is not None:
                zone = (zone[2], zone[3], width - zone[1], width - zone[0])
            x, y = rotate_xy(np.array([[width, 0.0]]), fit.quarters * math.pi / 2)[0].tolist()
            corner = fit.corner[0] + x, fit.corner[1] + y
            tabletop = replace(fit.tabletop, size_xy=(depth, width), restricted_zone=zone)
            fit = replace(fit, tabletop=tabletop, corner=corner, quarters=(fit.quarters + 1) % 4)
        return fit

    def frame(self, surface: SupportSurface, support: str = "", asset_id: str | None = None) -> SupportFrame:
        """Returns the table's frame on the support; ``surface`` is the one that was fitted."""
        x, y, z = surface.to_support(np.array([[*self.corner, 0.0]]))[0].tolist()
        yaw = math.remainder(surface.yaw + self.quarters * math.pi / 2, 2 * math.pi)
        return SupportFrame(support, surface.name, (x, y, z), yaw, asset_id)


def as_tabletop(surface: SupportSurface, table_type: str = "table") -> TabletopFit:
    """Finds the rectangle along the axes of a surface's frame on which most can stand.

    A table has at most one restricted zone, a rectangle. It covers what is missing in the surface's region, such as a sink, the
    foot of a lamp, or the corner of an angle. So three rectangles are compared: the largest in the region, the largest in the
    region with its holes filled, and the box of the region. The first is the largest to within a centimetre at each side; of a
    region whose boundaries are parallel to the axes it is exact.

    Args:
        surface: The surface.
        table_type: Type of the table.

    Raises:
        SceneError: No rectangle of a square centimetre fits (``surface_too_narrow``).
    """
    region = shapely.Polygon(surface.outline, surface.holes)
    plain = _largest_rectangle(region)
    if not (plain[1] - plain[0] > _STEP and plain[3] - plain[2] > _STEP):
        raise SceneError(
            f"surface {surface.name}: no rectangle fits into its region of {surface.area:.4f} m², expected at least 1 cm × 1 cm; "
            "use another surface",
            "surface_too_narrow",
        )
    x, y = surface.size_xy
    around = [(0.0, x, 0.0, y)]
    if surface.holes:
        around.append(_largest_rectangle(shapely.Polygon(surface.outline)))
    best = _area(plain)
    found: tuple[Rectangle, Rectangle | None] = (plain, None)
    for rectangle in around:
        zone = _zone(rectangle, region)
        free = _area(rectangle) - (0.0 if zone is None else _area(zone))
        if free > best * _WORTH:
            best, found = free, (rectangle, zone)
    (x_min, x_max, y_min, y_max), zone = found
    if zone is not None:
        zone = (zone[0] - x_min, zone[1] - x_min, zone[2] - y_min, zone[3] - y_min)
    table = Tabletop(table_type, (x_max - x_min, y_max - y_min), zone, surface.clearance)
    return TabletopFit(table, (x_min, y_min), min(1.0, best / surface.area))


def _area(rectangle: Rectangle) -> float:
    x_min, x_max, y_min, y_max = rectangle
    return (x_max - x_min) * (y_max - y_min)


def _zone(rectangle: Rectangle, region: shapely.Polygon) -> Rectangle | None:
    """The box of what a region lacks of a rectangle; None if it lacks nothing."""
    x_min, x_max, y_min, y_max = rectangle
    lacking = shapely.difference(
        shapely.box(x_min, y_min, x_max, y_max), shapely.buffer(region, _TOLERANCE, join_style="mitre")
    )
    if lacking.area <= 0:
        return None
    low_x, low_y, high_x, high_y = shapely.bounds(lacking).tolist()
    grown = _TOLERANCE  # the lacking part was measured from a grown region
    return max(low_x - grown, x_min), min(high_x + grown, x_max), max(low_y - grown, y_min), min(high_y + grown, y_max)


def _largest_rectangle(region: shapely.Polygon) -> Rectangle:
    """The largest rectangle whose sides lie on lines of a grid; corners of the region have lines of their own."""
    corners = shapely.get_coordinates(region)
    x, y = (_grid_lines(corners[:, k]) for k in range(2))
    grown = shapely.buffer(region, _TOLERANCE, join_style="mitre")
    shapely.prepare(grown)
    cells = shapely.box(x[:-1], y[:-1, None], x[1:], y[1:, None])
    is_free = shapely.covers(grown, cells)
    best, found = 0.0, (0.0, 0.0, 0.0, 0.0)
    starts = np.zeros(len(x) - 1)  # where the free cells below each column begin
    for row in range(len(y) - 1):
        starts = np.where(is_free[row], starts, y[row + 1])
        found_here = _largest_under(x, y[row + 1] - starts)
        if found_here[0] > best + 1e-12:
            best, (left, right, height) = found_here[0], found_here[1:]
            found = (left, right, float(y[row + 1]) - height, float(y[row + 1]))
    return found


def _largest_under(x: FloatArray, heights: FloatArray) -> tuple[float, float, float, float]:
    """Area, left, right and height of the largest rectangle under columns between lines ``x``, (K + 1,)."""
    best = (0.0, 0.0, 0.0, 0.0)
    open_columns: list[tuple[float, float]] = []  # left end and height of rectangles that can still grow, heights rise
    for left, height in zip(x.tolist(), [*heights.tolist(), 0.0], strict=True):
        start = left
        while open_columns and open_columns[-1][1] >= height:
            start, tall = open_columns.pop()
            if (left - start) * tall > best[0]:
                best = ((left - start) * tall, start, left, tall)
        open_columns.append((start, height))
    return best


def _grid_lines(values: FloatArray) -> FloatArray:
    """Positions of grid lines: those of the corners, and between them at most a step apart."""
    low, high = float(values.min()), float(values.max())
    count = min(_MOST_LINES, max(2, math.ceil((high - low) / _STEP) + 1))
    lines = np.unique(np.concatenate([np.linspace(low, high, count), values if len(values) <= _MOST_LINES else values[:0]]))
    keep = np.r_[True, np.diff(lines) > 1e-6]
    return np.asarray(lines[keep])
