"""Finds objects that have fallen over, and the rotation that puts them back on their feet.

The resting poses of an object are the faces of its convex hull over which its centre of mass lies. An object is expected to stand as
another keyframe of its file shows it; a hollow one with its opening upwards; a bottle, can or the like on its end; else with the z
axis of its body upwards, if it can stand firmly so. It has fallen if it lies on its side instead: a hollow one and a bottle in any
case, but not one that is upside down, which may be meant; another one if it lies less firmly than it would stand. One that stands
firmly with the z axis of its body upwards has not fallen.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from stable_data.scene import FloatArray, QuatXyzw

Upright: TypeAlias = Literal["auto", "body", "keep"]
"""``auto``: what has fallen over is put on its feet; ``body``: the z axis of each body points up wherever it can stand so; ``keep``:
tilts stay as they are.
"""

_SAME_FACE = math.cos(math.radians(1.5))  # normals of one face
_NEAR = math.radians(10.0)  # an object this near to a resting pose is meant to have it
_FALLEN = math.radians(30.0)  # an object turned less than this has not fallen
_SIDEWAYS = math.radians(45.0)  # a hollow object turned by this much, up to this much from upside down, lies on its side
_TALLER, _AS_TALL = 1.2, 0.95  # an object lies if it could stand as much higher; two ends stand about as high
_FIRM = math.radians(8.0)  # an object that stands firmly can be tipped as far without falling over
_LESS_FIRM = 0.6  # a fallen object can be tipped less far than a standing one, by this share
_EXACT = math.radians(0.05)  # a smaller turn is not worth moving anything


@dataclass(frozen=True, slots=True, eq=False)
class RestingFace:
    """A face of the convex hull on which an object can rest.

    Attributes:
        normal: Its outward normal, (3,), frame of the body: it points down at rest.
        tipping: The angle by which the object can be tipped before it falls over, radians.
    """

    normal: FloatArray
    tipping: float


@dataclass(frozen=True, slots=True, eq=False)
class UprightTurn:
    """A turn that an object needs.

    Attributes:
        rotation: The turn, in the frame of the file.
        reason: Why.
    """

    rotation: Rotation
    reason: str


def resting_faces(vertices: FloatArray, center: FloatArray) -> list[RestingFace]:
    """Finds the faces on which an object can rest on a level table, the firmest first.

    Args:
        vertices: Its shape, (V, 3) metres, frame of the body.
        center: Its centre of mass, (3,).
    """
    hull = ConvexHull(vertices)
    normals = hull.equations[:, :3]
    left, found = np.ones(len(normals), bool), list[RestingFace]()
    for k in np.argsort(-_areas(vertices, hull.simplices), kind="stable"):
        if not left[k]:
            continue
        # Of the same direction and, because the hull is convex, at about the same distance.
        same = left & (normals @ normals[k] > _SAME_FACE)
        left &= ~same
        corners = vertices[np.unique(hull.simplices[same])]
        tipping = _tipping(corners, normals[k], center)
        if tipping > 0:
            found.append(RestingFace(normals[k], tipping))
    return sorted(found, key=lambda face: -face.tipping)


def _end(faces: Sequence[RestingFace], vertices: FloatArray, down: FloatArray) -> RestingFace | None:
    """The face on which an object stands clearly higher than now, if there is one; of several the one below the z axis."""
    height = float(np.ptp(vertices @ down))
    heights = {id(face): float(np.ptp(vertices @ face.normal)) for face in faces if face.tipping >= _FIRM}
    tallest = max(heights.values(), default=0.0)
    if tallest < _TALLER * height:
        return None
    ends = [face for face in faces if heights.get(id(face), 0.0) > _AS_TALL * tallest]
    return max(ends, key=lambda face: (round(-float(face.normal[2]), 1), face.tipping))


def stands_firmly(vertices: FloatArray) -> bool:
    """Whether there is a face on which a shape (V, 3) with its mass in the middle of its box stands firmly."""
    faces = resting_faces(vertices, (vertices.min(axis=0) + vertices.max(axis=0)) / 2)
    return bool(faces) and faces[0].tipping >= _FIRM


def _areas(vertices: FloatArray, simplices: npt.NDArray[np.int32]) -> FloatArray:
    a, b, c = (vertices[simplices[:, k]] for k in range(3))
    areas: FloatArray = np.round(np.linalg.norm(np.cross(b - a, c - a), axis=1), 12)
    return areas


def _tipping(corners: FloatArray, normal: FloatArray, center: FloatArray) -> float:
    """The angle by which an object on a face can be tipped, radians; negative if it falls over by itself."""
    height = float((corners @ normal).max() - center @ normal)
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(normal, side)], axis=1)
    flat, middle = corners @ axes, center @ axes
    try:
        outline = ConvexHull(flat)
    except QhullError:  # points on a line: nothing stands on an edge
        return -1.0
    margin = -float((outline.equations[:, :2] @ middle + outline.equations[:, 2]).max())
    return math.atan2(margin, max(height, 1e-6))


def uprighting(
    vertices: FloatArray,
    center: FloatArray,
    quat_xyzw: QuatXyzw,
    known_quats: Sequence[QuatXyzw] = (),
    *,
    is_at_rest: bool | None = None,
    mode: Upright = "auto",
    opens_up: Callable[[FloatArray], bool] = lambda _: False,
    stands_on_end: bool = False,
) -> UprightTurn | None:
    """Decides whether an object must be turned to stand.

    Args:
        vertices: Its shape, (V, 3) metres, frame of the body.
        center: Its centre of mass, (3,).
        quat_xyzw: Its rotation in the file.
        known_quats: Other rotations that the file states for it.
        is_at_rest: Whether it stays as it is in the physics of its file; None if not known.
        mode: What is put on its feet.
        opens_up: Whether the object is hollow and its opening points up if a direction of its frame, (3,), points down.
        stands_on_end: Whether it is of a kind that stands on its end, such as a bottle.

    Returns:
        The turn; None if it stays as it is.
    """
    if mode == "keep":
        return None
    faces = resting_faces(vertices, center)
    rotation = Rotation.from_quat(quat_xyzw)
    down = rotation.inv().apply([0.0, 0.0, -1.0])
    present = _nearest(faces, down, _NEAR)
    for quat in known_quats if mode == "auto" else ():
        stated = _nearest(faces, Rotation.from_quat(quat).inv().apply([0.0, 0.0, -1.0]), _NEAR)
        is_other = stated is not None and stated.tipping >= _FIRM and _angle(stated.normal, down) > _FALLEN
        if stated is not None and is_other and (present is None or present.tipping < stated.tipping):
            return UprightTurn(_turn(stated, rotation), "lies; it stands in another pose of the file")
    standing = _nearest(faces, np.array([0.0, 0.0, -1.0]), _NEAR)
    lying = [face for face in faces if face.tipping >= _FIRM and _SIDEWAYS < _angle(face.normal, down) < math.pi - _SIDEWAYS]
    stands = standing is not None and standing is present and standing.tipping >= _FIRM
    if mode == "auto" and not stands and not (present is not None and opens_up(present.normal)):
        opening = next((face for face in lying if opens_up(face.normal)), None)
        if opening is not None:
            return UprightTurn(_turn(opening, rotation), "had fallen over: its opening did not point up")
    if mode == "auto" and stands_on_end and not stands and (end := _end(faces, vertices, down)) is not None:
        return UprightTurn(_turn(end, rotation), "had fallen over: such a thing stands on its end")
    if standing is not None and standing.tipping >= _FIRM and _angle(standing.normal, down) > _FALLEN:
        if mode == "body":
            return UprightTurn(_turn(standing, rotation), "z axis of the body turned upwards")
        is_less_firm = present is not None and present.tipping < _LESS_FIRM * standing.tipping
        if is_less_firm or (present is None and is_at_rest is not True):
            return UprightTurn(_turn(standing, rotation), "had fallen over")
    if is_at_rest:
        return None
    target = present if present is not None else _nearest(faces, down, math.pi)
    if target is None or target.tipping < _FIRM or _angle(target.normal, down) < _EXACT:
        return None
    return UprightTurn(_turn(target, rotation), "did not stand level")


def _nearest(faces: Sequence[RestingFace], down: FloatArray, within: float) -> RestingFace | None:
    """The resting face that points most nearly in a direction, of those that are about as near the firmest."""
    near = [face for face in faces if _angle(face.normal, down) <= within]
    return min(near, key=lambda face: (round(_angle(face.normal, down), 2), -face.tipping), default=None)


def _angle(a: FloatArray, b: FloatArray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def _turn(face: RestingFace, rotation: Rotation) -> Rotation:
    """The smallest turn, after a rotation, that points a face down."""
    now = rotation.apply(face.normal)
    axis = np.cross(now, [0.0, 0.0, -1.0])
    length = float(np.linalg.norm(axis))
    if length < 1e-12:
        return Rotation.identity() if now[2] < 0 else Rotation.from_rotvec([math.pi, 0.0, 0.0])
    return Rotation.from_rotvec(axis / length * math.atan2(length, -float(now[2])))
