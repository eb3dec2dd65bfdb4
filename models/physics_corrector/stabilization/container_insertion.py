"""Insertion into containers: the free space of a container, and poses of long objects that lean in it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import shapely
import trimesh
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.geometry.leaning import (
    FOOT_CLEARANCE,
    FOOT_SHARE_CORRECTED,
    LEAN_SHARE,
    LEAST_ROOM,
    PROTRUSION_CORRECTED,
    SLENDER_MESH,
    feet_radius,
)
from stable_data.geometry.shape import Shape
from stable_data.rotations import rotation_matrix, stand_on_end
from stable_data.scene import FloatArray, SceneObject
from stable_data.scene_graph.relations import INSIDE_FLOOR, INSIDE_SLACK

# How the free space of a container is found. Tuned on: not recorded.
_SECTION_LEVELS = (0.98, 0.9, 0.75, 0.6, 0.45, 0.3, 0.15)  # heights of the sections from above, shares of the height
_SAME_CAVITY = 0.5  # a lower section is of the same cavity if it has at least this share of the area of the one above
_UPSIDE_DOWN = 0.3  # an object whose axis points down more steeply than this (sine of the slope) stands on its other end


@dataclass(frozen=True, slots=True)
class ContainerInterior:
    """The free space of a container: a cylinder that widens towards the rim.

    Attributes:
        middle: Centre of its cross-section, (2,) metres, world frame.
        radius: Radius of the largest circle in the cross-section at the floor, metres.
        mouth: The same at the rim, metres.
        reach: Largest distance along the table between ``middle`` and the centre of an object in the container, metres. It may
            be larger than the radius, because long objects lean out over the rim.
        floor: Height of its floor, or a little above, metres.
        rim: Height of its rim, metres.
        below: Height of the container's underside, metres.
    """

    middle: FloatArray
    radius: float
    mouth: float
    reach: float
    floor: float
    rim: float
    below: float


def interior_of(o: SceneObject, shape: Shape) -> ContainerInterior | None:
    """Computes the free space of an object; None if it has no walls all around.

    Args:
        o: The object, resolved.
        shape: Its geometry.
    """
    mesh, height = trimesh.Trimesh(shape.vertices, shape.faces, process=False), float(shape.size[2])
    free, mouth, floor = None, None, 0.0
    for level in _SECTION_LEVELS:
        section = mesh.section((0.0, 0.0, 1.0), (0.0, 0.0, (level - 0.5) * height))
        rings = [] if section is None else [ring for ring in section.to_2D(np.eye(4))[0].polygons_closed if ring is not None]
        # Nested rings bound solid and free space in turns.
        solid = reduce(shapely.symmetric_difference, rings, shapely.Polygon())
        holes = [
            shapely.Polygon(ring)
            for part in shapely.get_parts(solid)
            if isinstance(part, shapely.Polygon)
            for ring in part.interiors
        ]
        if free is not None:
            common = (part for hole in holes for part in shapely.get_parts(hole.intersection(free)))
            holes = [part for part in common if isinstance(part, shapely.Polygon) and part.area > _SAME_CAVITY * free.area]
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


def is_inside(o: SceneObject, interior: ContainerInterior, store: AssetStore) -> bool:
    """Whether an object is in a container.

    Its centre must be over the container, as in the scene graph, and its underside between the rim and the underside of the
    container. If it leans out, its foot must be in the free space: an object that leans on the rim from outside is not inside.
    """
    bottom = o.bottom
    aside = float(np.linalg.norm(interior.middle - o.position[:2]))
    if aside >= interior.reach or not interior.below + INSIDE_FLOOR < bottom < interior.rim:
        return False
    if aside < interior.radius:
        return True
    height = min(1.0, max(0.0, (bottom - interior.floor) / (interior.rim - interior.floor)))
    room = interior.radius + height * (interior.mouth - interior.radius)
    x, y = _foot(store.shape(o)[0]).tolist()
    c, s = np.cos(o.yaw), np.sin(o.yaw)
    there = np.array([c * x - s * y, s * x + c * y]) + o.position[:2]
    return float(np.linalg.norm(interior.middle - there)) < room


def _foot(shape: Shape) -> FloatArray:
    """Returns the centre of the lower end of an object, (2,) metres, yaw frame."""
    low = shape.vertices[shape.vertices[:, 2] < (FOOT_SHARE_CORRECTED - 0.5) * shape.size[2]]
    return np.asarray((low.min(axis=0) + low.max(axis=0))[:2] / 2)


def is_long(o: SceneObject, interior: ContainerInterior, store: AssetStore) -> bool:
    """Whether an object leans in a container: it is slender, and longer than the free space is wide and deep."""
    mesh = store.mesh_of(o)
    if mesh is None or o.scale is None:
        return False
    _, across, along = sorted((mesh.extents * o.scale).tolist())
    depth = max(interior.rim - interior.floor, 2 * interior.radius)
    return bool(along > SLENDER_MESH * across and along > PROTRUSION_CORRECTED * depth)


def place_leaning(sticks: Sequence[SceneObject], interior: ContainerInterior, store: AssetStore) -> list[SceneObject]:
    """Places long objects in a container, as many as have room.

    A single object leans across, from the foot of one side to the rim of the other: in a wide bowl it would otherwise tip over
    the rim. Several objects would cross; each leans to its own side, with the feet side by side.

    Args:
        sticks: Objects for which :func:`is_long` holds, the more important first.
        interior: The free space of the container.
        store: Geometry of the assets.

    Returns:
        The placed objects; those without room are missing.
    """
    ends = [end for end in ((o, *_on_end(o, store)) for o in sticks) if end[2] + LEAST_ROOM < interior.radius]
    # The least important object is left out until the others have room to lean.
    while ends:
        half = max(half for *_, half in ends)
        alone = half + FOOT_CLEARANCE - interior.radius
        foot = alone if len(ends) == 1 else feet_radius(half, len(ends))
        room = interior.radius - half - foot
        if room > LEAST_ROOM:
            break
        ends.pop()
    if not ends:
        return []
    lean = Rotation.from_euler("x", LEAN_SHARE * np.arctan2(room, interior.rim - interior.floor))
    away = np.subtract(ends[0][0].position[:2], interior.middle)
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
        there = interior.middle + foot * np.array([s, -c]) - np.array([[c, -s], [s, c]]) @ _foot(shape)
        i, j = there.tolist()
        a, b, h = shape.size.tolist()
        height = interior.floor + FOOT_CLEARANCE + h / 2
        found.append(replace(o, position=(i, j, height), yaw=yaw, tilt_quat_xyzw=(x, y, z, w), size=(a, b, h)))
    return found


def _on_end(o: SceneObject, store: AssetStore) -> tuple[Rotation, float]:
    """Returns the rotation that stands a long object on its lower end, and the radius of its foot in that pose, metres."""
    mesh = store.mesh_of(o)
    assert mesh is not None
    assert o.scale is not None
    axis = int(np.argmax(mesh.extents * o.scale))
    is_down = rotation_matrix(o.tilt_quat_xyzw)[2, axis] < -_UPSIDE_DOWN
    upright = Rotation.from_quat(stand_on_end(axis, is_down=is_down))
    vertices = upright.apply(mesh.vertices * o.scale)
    low = vertices[:, 2].min()
    foot = vertices[vertices[:, 2] < low + FOOT_SHARE_CORRECTED * np.ptp(vertices[:, 2])][:, :2]
    return upright, float(np.linalg.norm(np.ptp(foot, axis=0))) / 2
