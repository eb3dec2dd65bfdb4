"""Tests whether an object stays on its table and out of the restricted zone."""

import numpy as np
import shapely

from stable_data.metrics.triangle_intersection import boxes
from stable_data.scene import FloatArray, Rectangle, Tabletop


def leaves_table(low: FloatArray, high: FloatArray, table: Tabletop, slack: float) -> bool:
    """Returns whether the footprint reaches over the edge by more than a slack.

    Args:
        low: Lowest corner of the mesh's box, (3,) float64, metres, world frame.
        high: Highest corner, (3,).
        table: The table.
        slack: Metres.
    """
    return bool((low[:2] < -slack).any() or (high[:2] > np.asarray(table.size_xy) + slack).any())


def enters_zone(triangles: FloatArray, zone: Rectangle | None, slack: float) -> bool:
    """Returns whether the mesh, seen from above, reaches into a rectangle by more than a slack.

    Args:
        triangles: (F, 3, 3) float64, metres, world frame.
        zone: Rectangle, metres; None is never entered.
        slack: Metres.
    """
    if zone is None or zone[0] + 2 * slack >= zone[1] or zone[2] + 2 * slack >= zone[3]:
        return False
    # Below, the zone is smaller by the slack on every side.
    low, high = np.array([zone[0], zone[2]]) + slack, np.array([zone[1], zone[3]]) - slack
    flat = triangles[:, :, :2]
    lowest, highest = boxes(flat)
    near = flat[(lowest < high[:, None]).all(axis=0) & (highest > low[:, None]).all(axis=0)]
    if not len(near):
        return False
    if ((near > low) & (near < high)).all(axis=2).any():
        return True
    # No corner is inside: an edge crosses the rectangle, or a triangle covers all of it.
    return bool(shapely.intersects(shapely.box(*low, *high), shapely.linearrings(near)).any()) or bool(
        shapely.contains_xy(shapely.polygons(near), *((low + high) / 2)).any()
    )
