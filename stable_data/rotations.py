"""Rotations as unit quaternions, xyzw: products, yaw and tilt, boxes of rotated objects."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Vec3

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

UPRIGHT_TILT = math.radians(1.0)
"""A smaller tilt counts as upright, radians."""

YAW_ARM = 0.1
"""Weight of a rotation against a translation in distances of poses, metres per radian."""

_UPRIGHT = 1e-3  # radians: below it, scale_factor times original_size is the box in the yaw frame
_GIMBAL = 1e-5  # horizontal length of the x axis below which its heading is noise
_HEADING_TOLERANCE = 1e-3  # radians
_SMALL, _LARGE = 1e-140, 1e150  # between them, squares have all of their digits


def quat_product(a: QuatXyzw, b: QuatXyzw) -> QuatXyzw:
    """Returns the rotation ``b`` followed by the rotation ``a``, xyzw."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def yaw_quat(yaw: float) -> QuatXyzw:
    """The rotation by ``yaw`` radians about +z, xyzw."""
    return (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


def normalise_quat(quat_xyzw: QuatXyzw) -> QuatXyzw:
    """Returns the unit quaternion of the same direction, xyzw; the given one is finite and not zero."""
    x, y, z, w = quat_xyzw
    longest = max(map(abs, quat_xyzw))
    if not _SMALL < longest < _LARGE and 0 < longest < math.inf:  # the squares would leave the range of doubles
        return normalise_quat((x / longest, y / longest, z / longest, w / longest))
    square = math.fsum(q * q for q in quat_xyzw)
    norm = math.sqrt(square)
    return (x / norm, y / norm, z / norm, w / norm)


def canonical_quaternion(tilt_quat_xyzw: QuatXyzw) -> QuatXyzw:
    """Returns the unit quaternion with a fixed choice of sign, since q and -q are the same rotation."""
    sign = 1.0 if next((q for q in reversed(tilt_quat_xyzw) if abs(q) > 0.01), 1.0) > 0 else -1.0
    x, y, z, w = (sign * q + 0.0 for q in normalise_quat(tilt_quat_xyzw))
    return x, y, z, w


def tilt_key(tilt_quat_xyzw: QuatXyzw) -> QuatXyzw:
    """Returns a tilt with each component rounded to 0.01, so that tilts within about one degree are equal."""
    x, y, z, w = (round(q, 2) + 0.0 for q in canonical_quaternion(tilt_quat_xyzw))
    return x, y, z, w


def wxyz(quat_xyzw: QuatXyzw) -> list[float]:
    """Returns the quaternion with the real part first, as MuJoCo expects it."""
    return [quat_xyzw[3], *quat_xyzw[:3]]


def quat_of(rotation: "Rotation") -> QuatXyzw:
    """Returns the quaternion of a single SciPy rotation, xyzw."""
    x, y, z, w = rotation.as_quat().tolist()
    return (x, y, z, w)


def wrap_angle(angle: FloatArray) -> FloatArray:
    """Returns angles of the same directions between −π and π, radians."""
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def rotate_xy(points: FloatArray, yaw: float) -> FloatArray:
    """Rotates horizontal points (..., 2) by ``yaw`` radians about the origin."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def half_extents_xy(size: Sequence[float], yaw: float) -> FloatArray:
    """Half the extents along x and y, (2,) float64, of a box of that size rotated by ``yaw`` radians; its height is not used."""
    c, s = abs(np.cos(yaw)), abs(np.sin(yaw))
    return np.array([c * size[0] + s * size[1], s * size[0] + c * size[1]]) / 2


def rotation_matrix(quat_xyzw: QuatXyzw) -> FloatArray:
    """Returns the matrix of a unit quaternion, (3, 3) float64."""
    x, y, z, w = quat_xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def stand_on_end(axis: int, *, is_down: bool = False) -> QuatXyzw:
    """Returns the rotation, xyzw, that stands an object with the long axis 0, 1 or 2 on end, if ``is_down`` on its positive end."""
    half = math.sqrt(0.5)
    upward = ((0.0, -half, 0.0, half), (half, 0.0, 0.0, half), UPRIGHT)[axis]
    return quat_product((1.0, 0.0, 0.0, 0.0), upward) if is_down else upward


def heading(quat_xyzw: QuatXyzw) -> tuple[float, float]:
    """The horizontal direction of the rotated x axis.

    Returns:
        Its angle atan2(R10, R00), radians, and its horizontal length; if the length is 0, the angle has no meaning.
    """
    x, y, z, w = quat_xyzw
    east, north = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w)  # first column of the rotation matrix
    return math.atan2(north, east), math.hypot(east, north)


def tilt_angle(quat_xyzw: QuatXyzw) -> float:
    """Angle between the rotated z axis and z, radians."""
    x, y, z, w = quat_xyzw
    # Unlike acos, atan2 is accurate for small angles.
    return 2 * math.atan2(math.hypot(x, y), math.hypot(z, w))


def is_yaw_of(yaw: float, quat_xyzw: QuatXyzw) -> bool:
    """Whether an angle is the z angle of an Euler form x-y-z of a rotation.

    Such an angle is the heading modulo 2 pi. For a tilted object it may also be the heading plus pi, the equivalent Euler form. If
    the x axis points straight up or down, every angle is a z angle.
    """
    angle, length = heading(quat_xyzw)
    if length < _GIMBAL:
        return True
    period = math.pi if tilt_angle(quat_xyzw) > UPRIGHT_TILT else 2 * math.pi
    # The shorter the horizontal part of the x axis, the less certain is its heading.
    return abs(math.remainder(yaw - angle, period)) <= _HEADING_TOLERANCE + 1e-6 / length


def tilt_of(quat_xyzw: QuatXyzw, yaw: float) -> QuatXyzw:
    """Returns the rotation without its yaw: Rz(-yaw) · R, unit, xyzw."""
    x, y, z, w = quat_xyzw
    if x == 0 and y == 0 and abs(math.remainder(yaw - 2 * math.atan2(z, w), 2 * math.pi)) < 1e-6:
        return UPRIGHT  # a pure yaw: the remainder is rounding
    return normalise_quat(quat_product(yaw_quat(-yaw), quat_xyzw))


def rotated_extents(extents: Vec3, quat_xyzw: QuatXyzw) -> Vec3:
    """Extents of the axis-aligned box around a rotated box; an upper bound for the contents of the box."""
    if quat_xyzw == UPRIGHT:
        return extents
    x, y, z = (np.abs(rotation_matrix(quat_xyzw)) @ np.asarray(extents)).tolist()
    return (x, y, z)


def yaw_frame_box(vertices: FloatArray, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> tuple[FloatArray, FloatArray]:
    """Computes the box of a scaled and tilted mesh, in the yaw frame.

    Args:
        vertices: (V, 3) float64, mesh units, z up, the mesh's own box centred on the origin.
        scale: Metres per mesh unit along the mesh's own axes.
        tilt_quat_xyzw: Rotation before yaw, unit.

    Returns:
        Lowest and highest corner, (3,) float64 each, metres, measured from the centre of the mesh's own box.
    """
    tilted = (np.asarray(vertices, np.float64) * np.asarray(scale)) @ rotation_matrix(tilt_quat_xyzw).T
    return tilted.min(axis=0), tilted.max(axis=0)


def is_upright(tilt: QuatXyzw) -> bool:
    """Whether a tilt is so small that the extents of the scaled mesh are its box in the yaw frame."""
    return abs(tilt[3]) >= math.cos(_UPRIGHT / 2)  # w is the cosine of half the angle
