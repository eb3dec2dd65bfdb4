"""Wanted objects become objects with assets: where they were, what they are called, standing on what they stood on.

An asset is seldom as high as the box that was wanted. So the underside is what stays: at its height where the object stands on
the table or on something that is not replaced, and on its carrier where that one changes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from stable_data.assets.retrieval import AssetMatch
from stable_data.scene import SceneObject
from stable_data.scene_graph.support_tree import SupportTree


def substitute_asset(wanted: SceneObject, match: AssetMatch) -> SceneObject:
    """The object as a match makes it.

    Its instance, x, y, yaw, description, stage and support stay, and so does the height of its underside. Asset, category
    (where the asset has one), tilt, scale and size are the match's. What rests on it is not looked at: see :func:`substitute_assets`.

    Args:
        wanted: The object; ``position`` is the centre of its box in the yaw frame, metres, world frame.
        match: What was found for it.
    """
    x, y, _ = wanted.position
    return replace(
        wanted,
        position=(x, y, wanted.bottom + match.size[2] / 2),
        category=match.category or wanted.category,
        asset_id=match.asset_id,
        tilt_quat_xyzw=match.tilt_quat_xyzw,
        scale=match.scale,
        size=match.size,
    )


def substitute_assets(objects: Sequence[SceneObject], matches: Mapping[str, AssetMatch]) -> tuple[SceneObject, ...]:
    """A layout with assets in place of wanted objects, what they carry moved with them.

    What stands on a carrier (``support``) is lifted or lowered by as much as the carrier's top moves; what lies within the
    carrier's height, as in a bowl, keeps its place between the carrier's underside and top. Both hold through stacks of any
    height. x and y stay: whether everything still has room is for the corrector to see to.

    Args:
        objects: The layout. A support that is not among them, such as ``table`` or an object of an earlier stage, stays as it
            is.
        matches: instance -> match, for those that get an asset; the others are only moved with their carriers.

    Returns:
        The objects, in their order.

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
    """An object with its asset, on its carrier as that one is now."""
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
