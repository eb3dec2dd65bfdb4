"""The two meanings of ``position`` in MesaTask layouts of tilted objects, and the conversion between them."""

import math
from dataclasses import replace
from enum import StrEnum

import numpy as np

from stable_data.rotations import UPRIGHT_TILT, rotation_matrix, yaw_frame_box
from stable_data.scene import FloatArray, QuatXyzw, SceneObject, Vec3

_SIZE_SLACK = (2.5e-3, 0.02)  # metres and share of the size; a difference must exceed both, because sizes are rounded to 1 mm
_MIN_OFFSET = 3e-3  # difference in height of the two centres that rounding to 1 mm cannot hide, metres


class PositionConvention(StrEnum):
    """Which centre of a tilted mesh its position is."""

    BOX_CENTRE = "box_centre"
    """The centre of the box in the yaw frame, tilt included: the meaning in this library; resting heights agree with it."""

    MESH_CENTRE = "mesh_centre"
    """The centre of the mesh's own box, rotated with the mesh, as the official viewer of the format places it."""


def has_size(extents: FloatArray, size: Vec3) -> bool:
    """Whether a mesh has the size of an object: the test of whether the scene was made with this mesh.

    Args:
        extents: Box of the mesh at the object's scale and tilt, (3,) float64, metres, yaw frame.
        size: The object's ``size``, metres.
    """
    error = np.abs(extents - size)
    return not ((error > _SIZE_SLACK[0]) & (error > _SIZE_SLACK[1] * np.asarray(size))).any()


def keeps_box(quat_xyzw: QuatXyzw) -> bool:
    """Whether a rotation maps boxes to boxes, within a degree: then the two centres of :class:`PositionConvention` coincide."""
    # Every rotated axis must be close to an axis of the frame.
    return bool(np.abs(rotation_matrix(quat_xyzw)).max(axis=0).min() > math.cos(UPRIGHT_TILT))


def to_box_centre(scene_object: SceneObject, vertices: FloatArray) -> SceneObject:
    """Converts the position of an object from ``mesh_centre`` to ``box_centre``.

    Args:
        scene_object: Position: rotated centre of the mesh's own box (``mesh_centre``), metres, world frame.
        vertices: Its mesh, (V, 3) float64, mesh units, z up, the mesh's own box centred on the origin.

    Returns:
        The object with the centre of its box in its yaw frame as position. Unchanged if it has no scale.
    """
    if scene_object.scale is None:
        return scene_object
    low, high = yaw_frame_box(vertices, scene_object.scale, scene_object.tilt_quat_xyzw)
    right, back, up = ((low + high) / 2).tolist()
    c, s = math.cos(scene_object.yaw), math.sin(scene_object.yaw)
    x, y, z = scene_object.position
    return replace(scene_object, position=(x + c * right - s * back, y + s * right + c * back, z + up))


def reveals_convention(scene_object: SceneObject, vertices: FloatArray) -> bool:
    """Whether an object's height shows which of the two conventions its dataset follows.

    The object must be tilted, its mesh must have its size (:func:`has_size`), and the heights of its two centres must differ by more
    than the millimetres to which a layout is rounded. The vertices are those of :func:`to_box_centre`.
    """
    if scene_object.scale is None or scene_object.tilt_angle < UPRIGHT_TILT:
        return False
    low, high = yaw_frame_box(vertices, scene_object.scale, scene_object.tilt_quat_xyzw)
    return has_size(high - low, scene_object.size) and bool(abs(low[2] + high[2]) / 2 > _MIN_OFFSET)
