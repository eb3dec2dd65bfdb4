"""Joins the scenes that stand on one piece of furniture to one scene, for exports."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from stable_data.errors import SceneError
from stable_data.rotations import rotate_xy
from stable_data.scene import UPRIGHT, FloatArray, Scene, SceneObject, SupportFrame, Tabletop, Vec3
from stable_data.scene_graph.relations import yawed_rectangle

FLOOR = "floor"
"""Table type of a joined scene, whose plane z = 0 is the floor below the support."""

_BOARD = 0.01  # thickness of the body below each surface, metres,
_THINNEST = 0.001  # and the least of it below a sheet
_SAME = 1e-4  # heights that differ by less are one, metres
_EDGE = 0.01  # of a surface that what is fixed beside it may reach over, metres
_MARGIN = 0.2  # of the floor around the support, metres


def join_scenes(scenes: Sequence[Scene], low: FloatArray, high: FloatArray) -> Scene:
    """Joins scenes on surfaces of one support.

    Args:
        scenes: The scenes, at least one; each has a frame, and all of them name the same support.
        low: Lowest corner of the support, (3,) metres, in its frame.
        high: Highest corner.

    Returns:
        A scene with the name of the support. Its frame is upright on the floor, and turned as that of the first scene. Objects have
        the names ``<surface>_<instance>``. Each surface is the top of fixed bodies ``<surface>_board_<k>`` around its restricted
        zone, which may be a sink. A fixed object of one surface ends at the plane of another one over which it would reach. The
        scene has no task and no relations.

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
    boards = [_boards(scene, scenes, joined) for scene in scenes]
    ends = [board for own in boards for board in own]
    objects: list[SceneObject] = []
    fixed: set[str] = set()
    for scene, own in zip(scenes, boards, strict=True):
        assert scene.frame is not None
        objects += own
        fixed |= {board.instance for board in own}
        for o in scene.objects:
            named = replace(o, instance=f"{scene.frame.surface}_{o.instance}", support=None, stage=None)
            moved = _moved(named, scene.frame, joined)
            if o.instance in scene.fixed:
                moved = _ended(moved, ends)
                fixed.add(moved.instance)
            objects.append(moved)
    return Scene(first.support, Tabletop(FLOOR, (width, depth)), tuple(objects), fixed=frozenset(fixed), frame=joined)


def _boards(scene: Scene, others: Sequence[Scene], target: SupportFrame) -> list[SceneObject]:
    """The bodies below a surface around its restricted zone, as thin as the furniture is above the free room of another surface."""
    frame, (width, depth) = scene.frame, scene.table.size_xy
    assert frame is not None
    area, thick = _area(scene), _BOARD
    for other in others:
        if other.frame is None or other.table.clearance is None or not shapely.intersects(_area(other), area):
            continue
        sheet = frame.origin[2] - (other.frame.origin[2] + other.table.clearance)
        thick = min(thick, sheet) if sheet > -_THINNEST else thick
    thick = max(thick, _THINNEST)
    x_min, x_max, y_min, y_max = scene.table.restricted_zone or (width, width, 0.0, depth)
    sides = [(0.0, x_min, 0.0, depth), (x_max, width, 0.0, depth), (x_min, x_max, 0.0, y_min), (x_min, x_max, y_max, depth)]
    bodies = [
        ((left + right) / 2, (near + far) / 2, right - left, far - near)
        for left, right, near, far in sides
        if right - left > _THINNEST and far - near > _THINNEST
    ]
    return [
        _moved(SceneObject(f"{frame.surface}_board_{k}", "board", (x, y, -thick / 2), 0.0, (wide, deep, thick)), frame, target)
        for k, (x, y, wide, deep) in enumerate(bodies)
    ]


def _area(scene: Scene) -> shapely.Polygon:
    """The table of a scene in the plane of its support."""
    assert scene.frame is not None
    corners = shapely.get_coordinates(shapely.box(0.0, 0.0, *scene.table.size_xy))
    return shapely.Polygon(rotate_xy(corners, scene.frame.yaw) + scene.frame.origin[:2])


def _ended(o: SceneObject, boards: Sequence[SceneObject]) -> SceneObject:
    """A fixed object that ends at the lowest of the boards over which it reaches; its body is a little thicker than the furniture."""
    outline = shapely.Polygon(yawed_rectangle(o))
    ends = [
        board.top
        for board in boards
        if o.bottom + _SAME < board.top < o.top
        and shapely.intersects(outline, shapely.buffer(shapely.Polygon(yawed_rectangle(board)), -_EDGE))
    ]
    if not ends or o.tilt_quat_xyzw != UPRIGHT:
        return o
    height = min(ends) - o.bottom
    (x, y, z), (wide, deep, high) = o.scale or (1.0, 1.0, 1.0), o.size
    return replace(
        o,
        position=(o.position[0], o.position[1], o.bottom + height / 2),
        scale=None if o.scale is None else (x, y, z * height / high),
        size=(wide, deep, height),
    )


def _moved(o: SceneObject, source: SupportFrame, target: SupportFrame) -> SceneObject:
    """An object in another frame on the same support."""
    there = np.append(rotate_xy(np.array([o.position[:2]]), source.yaw)[0], o.position[2]) + source.origin - target.origin
    (x, y), z = rotate_xy(there[None, :2], -target.yaw)[0].tolist(), float(there[2])
    position: Vec3 = (x, y, z)
    return o.moved(position, o.yaw + source.yaw - target.yaw)
