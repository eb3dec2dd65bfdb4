"""Joins the scenes that stand on one piece of furniture to one scene, for exports."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stable_data.errors import SceneError
from stable_data.rotations import rotate_xy
from stable_data.scene import FloatArray, Scene, SceneObject, SupportFrame, Tabletop, Vec3

FLOOR = "floor"
"""Table type of a joined scene, whose plane z = 0 is the floor below the support."""

_BOARD = 0.01  # thickness of the body below each surface, metres
_MARGIN = 0.2  # of the floor around the support, metres


def join_scenes(scenes: Sequence[Scene], low: FloatArray, high: FloatArray) -> Scene:
    """Joins scenes on surfaces of one support.

    Args:
        scenes: The scenes, at least one; each has a frame, and all of them name the same support.
        low: Lowest corner of the support, (3,) metres, in its frame.
        high: Highest corner.

    Returns:
        A scene with the name of the support. Its frame is upright on the floor, and turned as that of the first scene. Objects have
        the names ``<surface>_<instance>``. Each surface is the top of a fixed body ``<surface>_board``. It has no task and no
        relations.

    Raises:
        SceneError: A scene has no frame, or they name different supports (``not_joined``).
    """
    frames = [scene.frame for scene in scenes]
    if len({None if frame is None else frame.support for frame in frames}) != 1 or frames[0] is None:
        raise SceneError(f"{scenes[0].scene_id}: expected scenes on surfaces of one support", "not_joined")
    first = frames[0]
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    turned = rotate_xy(corners, -first.yaw)
    start, end = turned.min(axis=0) - _MARGIN, turned.max(axis=0) + _MARGIN
    x, y = rotate_xy(start[None], first.yaw)[0].tolist()
    joined = replace(first, surface=FLOOR, origin=(x, y, float(low[2])))
    width, depth = (end - start).tolist()
    objects: list[SceneObject] = []
    for scene in scenes:
        assert scene.frame is not None
        prefix = scene.frame.surface
        wide, deep = scene.table.size_xy
        board = SceneObject(f"{prefix}_board", "board", (wide / 2, deep / 2, -_BOARD / 2), 0.0, (wide, deep, _BOARD))
        own = (board, *(replace(o, instance=f"{prefix}_{o.instance}", support=None, stage=None) for o in scene.objects))
        objects += [_moved(o, scene.frame, joined) for o in own]
    fixed = {f"{scene.frame.surface}_{name}" for scene in scenes if scene.frame for name in (*scene.fixed, "board")}
    return Scene(first.support, Tabletop(FLOOR, (width, depth)), tuple(objects), fixed=frozenset(fixed), frame=joined)


def _moved(o: SceneObject, source: SupportFrame, target: SupportFrame) -> SceneObject:
    """An object in another frame on the same support."""
    there = np.append(rotate_xy(np.array([o.position[:2]]), source.yaw)[0], o.position[2]) + source.origin - target.origin
    (x, y), z = rotate_xy(there[None, :2], -target.yaw)[0].tolist(), float(there[2])
    position: Vec3 = (x, y, z)
    return o.moved(position, o.yaw + source.yaw - target.yaw)
