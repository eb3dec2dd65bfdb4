"""What carries each object of a layout, by its boxes alone: no meshes are known yet, so there are no contacts."""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely
from scipy.sparse.csgraph import connected_components

from stable_data.scene import TABLE, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import INSIDE_SLACK, supports, yawed_rectangle

ON_TABLE = 0.01
"""An underside this low is on the table, metres, as the scene graph has it."""

GAP = 0.01
"""So far below an object is what may carry it, metres, as the scene graph has it."""


_COMMON = 0.3  # so much of the smaller outline is common where one thing reaches into the other that carries it


def carriers_of(objects: Sequence[SceneObject], table: Tabletop) -> dict[str, str | None]:
    """What carries each object, in the scene graph's sense without contacts.

    Only what has another's centre above it can carry it, so objects are looked at in groups. An object that reaches deeper into
    another than the scene graph allows (the bow of a gift box) is carried by it all the same: it does not float, and how deep
    it may be is for the correction.

    Args:
        objects: All objects of a layout; instances are unique.
        table: The table.

    Returns:
        Instance to instance, ``table``, or None where nothing is near below.
    """
    found: dict[str, str | None] = {}
    for group in _meeting(objects):
        if len(group) == 1:
            found[group[0].instance] = TABLE if bottom(group[0]) <= ON_TABLE else None
            continue
        of_group = supports(Scene("layout", table, tuple(group)), {})
        for o in group:
            if of_group[o.instance] is None:
                of_group[o.instance] = _reached_into(o, group, of_group)
        found |= of_group
    return {o.instance: found[o.instance] for o in objects}


def bottom(item: SceneObject) -> float:
    """Height of an object's underside, metres."""
    return item.position[2] - item.size[2] / 2


def top(item: SceneObject) -> float:
    """Height of an object's highest point, metres."""
    return item.position[2] + item.size[2] / 2


def _meeting(objects: Sequence[SceneObject]) -> list[list[SceneObject]]:
    """Objects in groups: what may carry another has the other's centre within the extent of its box, or nearly so."""
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


def _reached_into(item: SceneObject, others: Sequence[SceneObject], carriers: Mapping[str, str | None]) -> str | None:
    """The object of most common outline that an object reaches into from above, None where there is none."""
    outline = shapely.Polygon(yawed_rectangle(item))
    best: tuple[float, str] | None = None
    for o in others:
        if o is item or not bottom(o) < bottom(item) <= top(o) + GAP or _rests_on(o.instance, item.instance, carriers):
            continue
        other = shapely.Polygon(yawed_rectangle(o))
        share = float(outline.intersection(other).area / min(outline.area, other.area))
        if share >= _COMMON and (best is None or share > best[0]):
            best = share, o.instance
    return best[1] if best else None


def _rests_on(one: str, other: str, carriers: Mapping[str, str | None]) -> bool:
    """Is one carried by the other, directly or through others?"""
    above: str | None = one
    for _ in range(len(carriers)):
        if above is None or above == other:
            break
        above = carriers.get(above)
    return above == other
