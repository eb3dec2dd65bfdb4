"""Regions of a table: its ninths, outer thirds, halves and edges, and directions on it."""

from collections.abc import Sequence

import numpy as np

from stable_data.scene import FloatArray
from stable_data.scene_graph.relations import CELLS, cell_bounds, cell_of

NEAR_EDGE = 0.12
"""An object is at an edge if its outline is at most this far from it, metres."""

DIRECTIONS = {"left": (0, -1), "right": (0, 1), "front": (1, -1), "back": (1, 1)}
"""Axis and sign of each direction on the table."""

THIRDS = tuple(DIRECTIONS)
"""The outer thirds: ``left`` is the third of the table at its left edge."""

HALVES = tuple(f"{side}_half" for side in DIRECTIONS)
EDGES = tuple(f"{side}_edge" for side in DIRECTIONS)

REGIONS = frozenset({*CELLS, *THIRDS, *HALVES, *EDGES})
"""The names of all regions."""


def edge_distance(edge: str, outline: FloatArray, size_xy: tuple[float, float]) -> float:
    """Returns how far an outline (K, 2), metres, is from an edge such as ``front_edge``; negative beyond it."""
    axis, sign = DIRECTIONS[edge.removesuffix("_edge")]
    return float(outline[:, axis].min() if sign < 0 else size_xy[axis] - outline[:, axis].max())


def is_in_region(region: str, centre: Sequence[float], outline: FloatArray, size_xy: tuple[float, float]) -> bool:
    """Returns whether an object is in a region.

    Args:
        region: One of REGIONS.
        centre: x and y of its centre, metres; it decides, but for edges.
        outline: Its convex outline, (K, 2) float64, metres; it decides for edges.
        size_xy: Size of the table, metres.
    """
    if region in EDGES:
        return edge_distance(region, outline, size_xy) <= NEAR_EDGE
    if region in CELLS:
        return cell_of((centre[0], centre[1]), size_xy) == region
    side = region.removesuffix("_half")
    if region in HALVES:
        axis, sign = DIRECTIONS[side]
        return sign * (centre[axis] - size_xy[axis] / 2) > 0
    return side in cell_of((centre[0], centre[1]), size_xy).split("_")


def region_bounds(region: str, size_xy: tuple[float, float]) -> FloatArray:
    """Returns the lowest and the highest point of the centres that a region contains, (2, 2) float64, metres.

    For an edge these are the centres of points; the centre of an object is farther away by half of its width.
    """
    if region in CELLS:
        return cell_bounds(region, size_xy)
    axis, sign = DIRECTIONS[region.removesuffix("_half").removesuffix("_edge")]
    depth = size_xy[axis] / 2 if region in HALVES else NEAR_EDGE if region in EDGES else size_xy[axis] / 3
    bounds = np.array(((0.0, 0.0), size_xy))
    bounds[1 if sign < 0 else 0, axis] = depth if sign < 0 else size_xy[axis] - depth
    return bounds
