"""Cups and the long things that lean in them: how much room a cup has inside, and how pencils are put into it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import shapely
import trimesh
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.geometry.shape import Shape
from stable_data.rotations import rotation_matrix, stood_on_end
from stable_data.scene import FloatArray, SceneObject
from stable_data.scene_graph.relations import INSIDE_FLOOR, INSIDE_SLACK

_SLENDER = 2.5  # what leans is longer than it is wide by this factor, and than its cup is deep by the next
_STICKS_OUT = 1.05
_LEVELS = (0.98, 0.9, 0.75, 0.6, 0.45, 0.3, 0.15)  # heights at which a cup is cut, shares of its own, from above
_SAME = 0.5  # a lower cut is of the same hollow while it has this share of its area
_FOOT = 0.05  # of a long thing, share of its length
_LEAN, _CLEAR = 0.8, 7e-4  # how far it leans of what has room; what is between feet, and below them, metres
_LEAST = 1e-3  # room without which nothing leans, metres
_STEEP = 0.3  # sine of the slope from which on a thing that is upside down is meant to be so


@dataclass(frozen=True, slots=True)
class ContainerInterior:
    """A cup, and what is free inside it: a cylinder that widens towards the rim.

    Attributes:
        middle: Of its cross-section, (2,) metres, world frame.
        radius: Of the largest circle in it at the floor, metres.
        mouth: The same at the rim, metres.
        reach: How far from the middle that of what is in the cup is at most, metres: long things lean out over the rim.
        floor: Height of its floor, or a little above, metres.
        rim: Height of its rim, metres.
        below: Height of the cup's underside, metres.
    """

    middle: FloatArray
    radius: float
    mouth: float
    reach: float
    floor: float
    rim: float
    below: float


def hollow_of(o: SceneObject, shape: Shape) -> ContainerInterior | None:
    """What is free inside a thing; None where it has no walls all around.

    Args:
        o: The thing, resolved.
        shape: Its geometry.
    """
    mesh, height = trimesh.Trimesh(shape.vertices, shape.faces, process=False), float(shape.size[2])
    free, mouth, floor = None, None, 0.0
    for level in _LEVELS:
        section = mesh.section((0.0, 0.0, 1.0), (0.0, 0.0, (level - 0.5) * height))
        rings = [] if section is None else [ring for ring in section.to_2D(np.eye(4))[0].polygons_closed if ring is not None]
        solid = reduce(shapely.symmetric_difference, rings, shapely.Polygon())
        holes = [
            shapely.Polygon(ring)
            for part in shapely.get_parts(solid)
            if isinstance(part, shapely.Polygon)
            for ring in part.interiors
        ]
        if free is not None:
            common = (part for hole in holes for part in shapely.get_parts(hole.intersection(free)))
            holes = [part for part in common if isinstance(part, shapely.Polygon) and part.area > _SAME * free.area]
        if not holes:
            break
        free, floor = max(holes, key=lambda hole: float(hole.area)), (level - 0.5) * height
        mouth = mouth or free
    if free is None:
        return None
    circle = shapely.maximum_inscribed_circle(free)
    (x, y), _ = circle.coords
    c, s = np.cos(o.yaw), np.sin(o.yaw)
    middle = np.array([c * x - s * y, s * x + c * y]) + o.position[:2]
    outline = shapely.convex_hull(shapely.multipoints(shape.vertices[:, :2]))
    reach = float(outline.exterior.distance(shapely.Point(x, y))) + INSIDE_SLACK
    z, radius = o.position[2], float(circle.length)
    opens = max(radius, float(shapely.maximum_inscribed_circle(mouth).length))
    return ContainerInterior(middle, radius, opens, reach, z + floor, z + height / 2, z - height / 2)


def is_inside(o: SceneObject, hollow: ContainerInterior, store: AssetStore) -> bool:
    """Is a thing in a cup?

    Its middle is over the cup, as the scene graph asks, its bottom below the rim and above the cup's; and where it leans out,
    its foot is in the hollow: what lies under a rim from outside is not in it.
    """
    bottom = o.position[2] - o.size[2] / 2
    aside = float(np.linalg.norm(hollow.middle - o.position[:2]))
    if aside >= hollow.reach or not hollow.below + INSIDE_FLOOR < bottom < hollow.rim:
        return False
    if aside < hollow.radius:
        return True
    height = min(1.0, max(0.0, (bottom - hollow.floor) / (hollow.rim - hollow.floor)))
    room = hollow.radius + height * (hollow.mouth - hollow.radius)
    x, y = _foot(store.shape(o)[0]).tolist()
    c, s = np.cos(o.yaw), np.sin(o.yaw)
    there = np.array([c * x - s * y, s * x + c * y]) + o.position[:2]
    return float(np.linalg.norm(hollow.middle - there)) < room


def _foot(shape: Shape) -> FloatArray:
    """Middle of the lower end of a thing, (2,) metres, its yaw frame."""
    low = shape.vertices[shape.vertices[:, 2] < (_FOOT - 0.5) * shape.size[2]]
    return np.asarray((low.min(axis=0) + low.max(axis=0))[:2] / 2)


def is_long(o: SceneObject, hollow: ContainerInterior, store: AssetStore) -> bool:
    """Is a thing slender, and longer than a hollow is wide and deep, so that it leans there rather than lies?"""
    mesh = store.mesh_of(o)
    if mesh is None or o.scale is None:
        return False
    _, across, along = sorted((mesh.extents * o.scale).tolist())
    return bool(along > _SLENDER * across and along > _STICKS_OUT * max(hollow.rim - hollow.floor, 2 * hollow.radius))


def stood(sticks: Sequence[SceneObject], hollow: ContainerInterior, store: AssetStore) -> list[SceneObject]:
    """Long things put into a hollow, as many as have room.

    One alone leans across, from the foot of one side to the rim of the other: in a wide bowl it would else tip over the rim. Of
    more, which would be in each other's way, each leans to its own side, their feet side by side.

    Args:
        sticks: The things, of which :func:`is_long` holds, the more important first.
        hollow: The hollow.
        store: Geometry of the assets.
    """
    ends = [end for end in ((o, *_on_end(o, store)) for o in sticks) if end[2] + _LEAST < hollow.radius]
    while ends:
        half = max(half for *_, half in ends)
        alone = half + _CLEAR - hollow.radius
        foot = alone if len(ends) == 1 else (half + _CLEAR) / np.sin(np.pi / len(ends))
        room = hollow.radius - half - foot
        if room > _LEAST:
            break
        ends.pop()
    if not ends:
        return []
    lean = Rotation.from_euler("x", _LEAN * np.arctan2(room, hollow.rim - hollow.floor))
    away = np.subtract(ends[0][0].position[:2], hollow.middle)
    first = float(np.arctan2(away[0], -away[1]))
    found = []
    for k, (o, upright, _) in enumerate(ends):
        yaw = first + 2 * np.pi * k / len(ends)
        x, y, z, w = (lean * upright).as_quat().tolist()
        mesh = store.mesh_of(o)
        assert mesh is not None
        assert o.scale is not None
        shape = Shape.from_mesh(mesh, o.scale, (x, y, z, w))
        c, s = np.cos(yaw), np.sin(yaw)
        there = hollow.middle + foot * np.array([s, -c]) - np.array([[c, -s], [s, c]]) @ _foot(shape)
        i, j = there.tolist()
        a, b, h = shape.size.tolist()
        height = hollow.floor + _CLEAR + h / 2
        found.append(replace(o, position=(i, j, height), yaw=yaw, tilt_quat_xyzw=(x, y, z, w), size=(a, b, h)))
    return found


def _on_end(o: SceneObject, store: AssetStore) -> tuple[Rotation, float]:
    """The rotation that stands a long thing on end, the one that is lower now, and the radius of its foot then, metres."""
    mesh = store.mesh_of(o)
    assert mesh is not None
    assert o.scale is not None
    axis = int(np.argmax(mesh.extents * o.scale))
    is_down = rotation_matrix(o.tilt_quat_xyzw)[2, axis] < -_STEEP
    upright = Rotation.from_quat(stood_on_end(axis, is_down=is_down))
    vertices = upright.apply(mesh.vertices * o.scale)
    low = vertices[:, 2].min()
    foot = vertices[vertices[:, 2] < low + _FOOT * np.ptp(vertices[:, 2])][:, :2]
    return upright, float(np.linalg.norm(np.ptp(foot, axis=0))) / 2
