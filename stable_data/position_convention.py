"""The geometry of a MesaTask pose: yaw and tilt of a rotation, the box in the yaw frame, and what ``position`` is."""

import math
from dataclasses import replace
from enum import StrEnum

import numpy as np

from stable_data.rotations import UPRIGHT_TILT, rotation_matrix, yaw_frame_box
from stable_data.scene import FloatArray, QuatXyzw, SceneObject, Vec3

_SIZE_SLACK = (2.5e-3, 0.02)  # metres and share of the size, both to be passed: sizes are rounded to 1 mm
_TELLING = 3e-3  # metres


class PositionConvention(StrEnum):
    """What the position of a tilted mesh is the centre of."""

    BOX_CENTRE = "box_centre"
    """Of the box in the yaw frame, tilt included: this library's own meaning, and the one that resting heights support."""

    MESH_CENTRE = "mesh_centre"
    """Of the mesh's own box, turned with the mesh, as the format's official viewer places it."""


def has_size(extents: FloatArray, size: Vec3) -> bool:
    """Whether a mesh is as large as an object says: the test of whether it is the mesh that the scene was made with.

    Args:
        extents: Box of the mesh at the object's scale and tilt, (3,) float64, metres, yaw frame.
        size: The object's ``size``, metres.
    """
    error = np.abs(extents - size)
    return not ((error > _SIZE_SLACK[0]) & (error > _SIZE_SLACK[1] * np.asarray(size))).any()


def keeps_box(quat_xyzw: QuatXyzw) -> bool:
    """Whether a rotation takes boxes to boxes, to a degree: then a mesh's own box and its box in the yaw frame share a centre."""
    return bool(np.abs(rotation_matrix(quat_xyzw)).max(axis=0).min() > math.cos(UPRIGHT_TILT))


def to_box_centre(scene_object: SceneObject, vertices: FloatArray) -> SceneObject:
    """The object whose position was read as its mesh's centre, with the position that this library means.

    Args:
        scene_object: Position: turned centre of the mesh's own box (``mesh_centre``), metres, world frame.
        vertices: Its mesh, (V, 3) float64, mesh units, z up, the mesh's own box centred on the origin.

    Returns:
        The same object; position: centre of its box in its yaw frame. Unchanged where it has no scale.
    """
    if scene_object.scale is None:
        return scene_object
    low, high = yaw_frame_box(vertices, scene_object.scale, scene_object.tilt_quat_xyzw)
    right, back, up = ((low + high) / 2).tolist()
    c, s = math.cos(scene_object.yaw), math.sin(scene_object.yaw)
    x, y, z = scene_object.position
    return replace(scene_object, position=(x + c * right - s * back, y + s * right + c * back, z + up))


def reveals_convention(scene_object: SceneObject, vertices: FloatArray) -> bool:
    """Whether an object's height tells which of the two conventions its dataset follows.

    It is tilted, its mesh is the annotated one (:func:`has_size`), and its two centres differ in height by more than the
    millimetres that a layout is written to.

    Args:
        scene_object: The object.
        vertices: Its mesh, as for :func:`to_box_centre`.
    """
    if scene_object.scale is None or scene_object.tilt_angle < UPRIGHT_TILT:
        return False
    low, high = yaw_frame_box(vertices, scene_object.scale, scene_object.tilt_quat_xyzw)
    return has_size(high - low, scene_object.size) and bool(abs(low[2] + high[2]) / 2 > _TELLING)
