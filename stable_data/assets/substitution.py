"""Replaces requested objects by objects with assets, with the same instance, x, y and support.

An asset is seldom as high as the requested box, so the height of the underside is preserved: in the world frame, or relative to
the support if the support changes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from stable_data.assets.retrieval import AssetMatch
from stable_data.scene import SceneObject
from stable_data.scene_graph.support_tree import SupportTree

UNKNOWN_CATEGORY = "object"
"""Category of an object whose asset has none and does not name the wanted one."""


def substitute_asset(wanted: SceneObject, match: AssetMatch) -> SceneObject:
    """Returns an object with the asset of a match.

    Instance, x, y, yaw, description, stage, support and the height of the underside are those of the object; the yaw is 90 degrees
    more if the asset is turned. Asset, category, tilt, scale and size are those of the match, so that another thing than the wanted one
    does not count as that. An asset of unknown category is :data:`UNKNOWN_CATEGORY`.
    :func:`substitute_assets` also moves supported objects.

    Args:
        wanted: The object; ``position`` is the centre of its box in the yaw frame, metres, world frame.
        match: The match of the object.
    """
    x, y, _ = wanted.position
    return replace(
        wanted,
        position=(x, y, wanted.bottom + match.size[2] / 2),
        yaw=wanted.yaw + math.pi / 2 if match.is_turned else wanted.yaw,
        category=match.category or UNKNOWN_CATEGORY,
        asset_id=match.asset_id,
        tilt_quat_xyzw=match.tilt_quat_xyzw,
        scale=match.scale,
        size=match.size,
    )


def substitute_assets(objects: Sequence[SceneObject], matches: Mapping[str, AssetMatch]) -> tuple[SceneObject, ...]:
    """Replaces the objects of a layout by objects with assets, and moves supported objects with their supports.

    An object on top of its support moves up or down with the top of the support. An object within the height of its support, as
    in a bowl, keeps its relative height between underside and top. Both hold for stacks of any height. x and y do not change;
    the corrector resolves collisions.

    Args:
        objects: The layout. A support that is not one of them, such as ``table`` or an object of an earlier stage, does not
            change.
        matches: Instance -> match, for objects that get an asset; the other objects only move with their supports.

    Returns:
        The objects, in the given order.

    Raises:
        SceneError: Supports form a cycle (``support_circle``).
    """
    wanted = {o.instance: o for o in objects}
    done: dict[str, SceneObject] = {}
    for name in SupportTree.of(objects).bottom_up():
        done[name] = _placed(wanted[name], matches.get(name), wanted, done)
    return tuple(done[o.instance] for o in objects)


def _placed(
    o: SceneObject, match: AssetMatch | None, wanted: Mapping[str, SceneObject], done: Mapping[str, SceneObject]
) -> SceneObject:
    """Returns an object with its asset, at its height on the replaced support."""
    low = o.bottom
    if o.support in done and o.support is not None:
        before, after = wanted[o.support], done[o.support]
        above = low - before.bottom
        if above >= before.size[2] > 0:
            low = after.bottom + after.size[2] + (above - before.size[2])
        elif above > 0:
            low = after.bottom + above / before.size[2] * after.size[2]
        else:
            low = after.bottom + above
    x, y, _ = o.position
    moved = replace(o, position=(x, y, low + o.size[2] / 2))
    return moved if match is None else substitute_asset(moved, match)
