"""Values in the XML of models: numbers, poses, tensors, colours."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np

from stable_data.errors import MeshError
from stable_data.geometry.mesh_colors import to_linear
from stable_data.scene import FloatArray


def child_of(element: ET.Element, place: str) -> ET.Element | None:
    """Returns the first element at a place such as ``surface/friction``; names may have prefixes. None if there is none."""
    current: ET.Element | None = element
    for name in place.split("/"):
        current = None if current is None else next((child for child in current if child.tag == name), None)
    return current


def text_of(element: ET.Element, place: str) -> str:
    """Returns the text of an element at a place, blanks joined; empty if it is not there."""
    found = child_of(element, place)
    return "" if found is None else " ".join((found.text or "").split())


def numbers(text: str | None, count: int, what: str, path: str) -> FloatArray:
    """Parses numbers that blanks separate.

    Raises:
        MeshError: ``model_unreadable``: another count, or a number that is not finite.
    """
    words = (text or "").split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        found = f"{path}: {what} is {(text or '').strip()[:60]!r}"
        raise MeshError(f"{found}, expected {count} finite number{'s' if count > 1 else ''}; correct it", "model_unreadable")
    return values


def pose_matrix(position: FloatArray, rotation: FloatArray) -> FloatArray:
    """Returns a pose (4, 4) from a place (3,) and a rotation (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def rotation_of_rpy(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Returns the rotation (3, 3) of turns about the fixed axes x, then y, then z, radians."""
    (cr, cp, cy), (sr, sp, sy) = np.cos((roll, pitch, yaw)), np.sin((roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def inertia_of(values: Mapping[str, float]) -> FloatArray:
    """Returns the tensor (3, 3) of its six values ``ixx`` to ``izz``."""
    xx, xy, xz, yy, yz, zz = (values[name] for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def positive(values: Sequence[float], what: str, path: str) -> tuple[float, ...]:
    """Returns sizes as they are.

    Raises:
        MeshError: ``model_unreadable``: one is not more than 0.
    """
    if min(values) <= 0:
        found = f"{path}: a {what} has size {', '.join(f'{value:g}' for value in values)}"
        raise MeshError(f"{found}, expected more than 0; correct it", "model_unreadable")
    return tuple(float(value) for value in values)


def linear_colour(text: str | None) -> tuple[float, float, float] | None:
    """Returns a display colour ``r g b`` or ``r g b a`` as linear colour; None if it is not one, since it is only a look."""
    try:
        values = np.array([float(word) for word in (text or "").split()[:3]])
    except ValueError:
        return None
    if len(values) != 3 or not np.isfinite(values).all():
        return None
    red, green, blue = to_linear(np.clip(values, 0.0, 1.0)).tolist()
    return (red, green, blue)
