"""A surface of a support: a plane with a region on which objects can stand."""

import math
from dataclasses import dataclass

import numpy as np
import shapely

from stable_data.errors import SceneError
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, Rectangle, Tabletop, Vec3

_STEP = 0.01  # of the grid on which a rectangle is searched, metres
_MOST_LINES = 400  # of that grid, along one axis
_TOLERANCE = 0.001  # by which a rectangle may leave its region, metres


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
    """The largest rectangle in the region of a surface, as a table top.

    Attributes:
        tabletop: The rectangle as a table.
        corner: Its near left corner in the frame of the surface, metres: the table's origin.
        share: Share of the region that it covers, 0 to 1.
    """

    tabletop: Tabletop
    corner: tuple[float, float]
    share: float


def as_tabletop(surface: SupportSurface, table_type: str = "table") -> TabletopFit:
    """Finds the largest rectangle along the axes of a surface's frame that lies in its region.

    It is the largest to within a centimetre at each side; of a region whose boundaries are parallel to the axes it is exact.

    Args:
        surface: The surface.
        table_type: Type of the table.

    Raises:
        SceneError: No rectangle of a square centimetre fits (``surface_too_narrow``).
    """
    region = shapely.Polygon(surface.outline, surface.holes)
    x_min, x_max, y_min, y_max = _largest_rectangle(region)
    if not (x_max - x_min > _STEP and y_max - y_min > _STEP):
        raise SceneError(
            f"surface {surface.name}: no rectangle fits into its region of {surface.area:.4f} m², expected at least 1 cm × 1 cm; "
            "use another surface",
            "surface_too_narrow",
        )
    share = (x_max - x_min) * (y_max - y_min) / surface.area
    return TabletopFit(Tabletop(table_type, (x_max - x_min, y_max - y_min)), (x_min, y_min), min(1.0, share))


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
