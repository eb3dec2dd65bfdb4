"""Derives the supports of a layout from its boxes alone, for layouts without meshes, whose contacts are not known."""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from scipy.sparse.csgraph import connected_components

from stable_data.scene import TABLE, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import GAP, INSIDE_SLACK, common_share, supports, yawed_rectangle
from stable_data.scene_graph.support_tree import ancestors

ON_TABLE = GAP
"""An object whose bottom is at most this high stands on the table, metres, as in the scene graph."""

_COMMON = 0.3  # least common share of the smaller outline for an object that reaches into its support


def carriers_of(objects: Sequence[SceneObject], table: Tabletop) -> dict[str, str | None]:
    """Derives the support of each object, in the meaning of the scene graph, without contacts.

    An object supports another one only if the centre of that one is above it, so objects are compared within groups. An object
    may reach deeper into another one than the scene graph allows (the bow of a gift box). That one is its support nevertheless:
    the object does not float, and the correction decides on the depth.

    Args:
        objects: All objects of a layout; instances are unique.
        table: The table.

    Returns:
        Instance -> instance, ``table``, or None without a support near below.
    """
    found: dict[str, str | None] = {}
    for group in _groups(objects):
        if len(group) == 1:  # the common case needs no outlines
            found[group[0].instance] = TABLE if group[0].bottom <= ON_TABLE else None
            continue
        of_group = supports(Scene("layout", table, tuple(group)), {})
        for o in group:
            if of_group[o.instance] is None:
                of_group[o.instance] = _penetrated_support(o, group, of_group)
        found |= of_group
    return {o.instance: found[o.instance] for o in objects}


def _groups(objects: Sequence[SceneObject]) -> list[list[SceneObject]]:
    """Groups objects so that an object and a possible support, whose box contains the centre of the object, share a group."""
    if not objects:
        return []
    centres = np.array([o.position[:2] for o in objects])
    corners = np.array([yawed_rectangle(o) for o in objects])
    low, high = corners.min(1) - INSIDE_SLACK, corners.max(1) + INSIDE_SLACK
    within = ((centres[:, None] >= low) & (centres[:, None] <= high)).all(2)
    _, group_of = connected_components(within)
    groups: dict[int, list[SceneObject]] = {}
    for item, group in zip(objects, group_of.tolist(), strict=True):
        groups.setdefault(group, []).append(item)
    return list(groups.values())


def _penetrated_support(item: SceneObject, others: Sequence[SceneObject], carriers: Mapping[str, str | None]) -> str | None:
    """The object with the largest common outline of those that an object reaches into from above; None without any."""
    outline = shapely.Polygon(yawed_rectangle(item))
    shares = {
        o.instance: common_share(outline, shapely.Polygon(yawed_rectangle(o)))
        for o in others
        if o.bottom < item.bottom <= o.top + GAP and item.instance not in ancestors(carriers, o.instance)
    }
    best = max(shares, key=shares.__getitem__, default=None)
    return best if best is not None and shares[best] >= _COMMON else None
