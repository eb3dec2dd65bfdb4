"""Reads one object of a layout: names, pose, scale and size, each with a fallback or a reason to refuse the scene."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from stable_data.assets.annotation import AssetAnnotation, category_of
from stable_data.json_text import ReadLog, are_finite, number, numbers, quote_value
from stable_data.limits import LIMITS, LayoutLimits, at_most
from stable_data.mesatask.library import is_inside, stem_of
from stable_data.rotations import heading, is_upright, is_yaw_of, normalise_quat, rotated_extents, tilt_of
from stable_data.scene import UPRIGHT, QuatXyzw, SceneObject, Vec3

POSE_KEYS = ("rotation", "scale_factor")
"""Keys of an object that only the dataset's form has."""
BOX_YAW = "box_yaw"
"""An addition to the format: repeats a ``z_rotation`` that is valid although it is no Euler angle of ``rotation``."""
MAX_NAME_LENGTH = 200

_UNIT_TOLERANCE = 1e-3
_SIZE_ROUNDING = 2e-3  # largest difference between a size, rounded to 1 mm, and the exact product, metres


@dataclass(frozen=True, slots=True)
class ReadContext:
    """The context in which the objects of one layout are read.

    Attributes:
        log: Collects the notices.
        origin_cm: x_min, y_min of the zone, which become the origin.
        size_xy: The table, metres.
        is_reply: Whether the layout is a language model's.
        annotations: Annotations of assets by uid.
        limits: Limits beyond which the layout is refused.
    """

    log: ReadLog
    origin_cm: tuple[float, float]
    size_xy: tuple[float, float]
    is_reply: bool = False
    annotations: Mapping[str, AssetAnnotation] = field(default_factory=dict)
    limits: LayoutLimits = field(default_factory=lambda: LIMITS.layout)


def read_object(entry: Mapping[str, Any], instance: str, context: ReadContext) -> SceneObject:
    """Reads one object of a layout from its entry in the file; ``instance`` is its name, made unique."""
    log = context.log
    asset_id = _asset_id(entry, instance, context)
    annotation = _annotation(asset_id, context.annotations)
    position = _position(entry, instance, context)
    if context.is_reply:
        yaw, tilt, scale = _reply_yaw(entry, instance, log), UPRIGHT, None
    else:
        yaw, tilt = _rotation(entry, instance, log)
        scale = read_scale(entry, instance, log)
    return SceneObject(
        instance,
        category_of(annotation.category if annotation and annotation.category else instance),
        position,
        yaw,
        _size(entry, instance, scale, tilt, context),
        asset_id=asset_id,
        scale=scale,
        tilt_quat_xyzw=tilt,
        description=_description(entry, annotation),
        source=entry,
    )


def _asset_id(entry: Mapping[str, Any], instance: str, context: ReadContext) -> str | None:
    """The selected uid, else the retrieved one."""
    uid = entry.get("selected_uid") or entry.get("retrieved_uid")
    if not uid:
        if not context.is_reply:
            context.log.warn("uid_missing", f"object {instance} names no asset; a box of its size replaces it")
        return None
    if not isinstance(uid, str) or len(uid) > MAX_NAME_LENGTH:
        message = f"object {instance} has uid {quote_value(uid)}, expected a name; a box of its size replaces it"
        context.log.warn("uid_invalid", message)
        return None
    if not is_inside(uid):
        message = f"object {instance} has uid {quote_value(uid)}, which leads out of the asset folder; expected a plain name"
        raise context.log.error("uid_path_traversal", message)
    return uid


def _position(entry: Mapping[str, Any], instance: str, context: ReadContext) -> Vec3:
    """Centre of the box, metres, from the zone's corner."""
    value, log = entry.get("position"), context.log
    found = numbers(value, 3)
    if found is None:
        code = "position_missing" if value is None else "position_invalid"
        raise log.error(code, f"object {instance} has position {quote_value(value)}, expected three numbers in centimetres")
    if not are_finite(found):
        code = "position_nan" if any(map(math.isnan, found)) else "position_inf"
        raise log.error(code, f"object {instance} has position {quote_value(value)}, expected finite centimetres")
    x, y = context.origin_cm
    position = ((found[0] - x) / 100, (found[1] - y) / 100, found[2] / 100)
    reach = context.limits.max_reach
    # Largest distance outside of the table along an axis.
    beyond = max(max(-p, p - side) for p, side in zip(position, (*context.size_xy, 0.0), strict=True))
    if beyond > reach:
        message = (
            f"object {instance} has position {quote_value(value)} cm, {beyond:g} m off the table; "
            f"expected {at_most(context.limits, 'max_reach', 'm')}"
        )
        raise log.error("coordinates_huge", message)
    return position


def read_scale(entry: Mapping[str, Any], instance: str, log: ReadLog) -> Vec3 | None:
    """Reads the scale of an object, metres per mesh unit; None, and a notice, if the file's factor is unusable."""
    value = entry.get("scale_factor")
    found = numbers(value, 3)
    if found is not None and are_finite(found) and min(found) > 0:
        return (found[0] / 100, found[1] / 100, found[2] / 100)
    if value is None:
        code = "scale_factor_missing"
    elif found is None or not are_finite(found):
        code = "scale_invalid"
    else:
        code = "scale_negative" if min(found) < 0 else "scale_zero"
    message = (
        f"object {instance} has scale_factor {quote_value(value)}, expected three positive numbers; its mesh is fitted to size"
    )
    log.warn(code, message)
    return None


def _rotation(entry: Mapping[str, Any], instance: str, log: ReadLog) -> tuple[float, QuatXyzw]:
    """Yaw, radians, and tilt. ``rotation`` decides; ``z_rotation`` states to which of its yaw frames ``size`` belongs."""
    z_rotation = entry.get("z_rotation")
    yaw = number(z_rotation)
    if yaw is None or not math.isfinite(yaw):
        yaw = None
    rotation = _unit_rotation(entry, instance, log)
    if rotation is None:
        return (yaw or 0.0), UPRIGHT
    angle = heading(rotation)[0] if heading(rotation)[1] > 0 else 0.0  # a vertical x axis has no heading
    if z_rotation is None:
        return angle, tilt_of(rotation, angle)
    if yaw is None or not (is_yaw_of(yaw, rotation) or entry.get(BOX_YAW) == yaw):
        message = f"object {instance} has z_rotation {quote_value(z_rotation)}, but its rotation is {angle:g} rad about z; rotation is used"
        log.warn("z_rotation_disagrees", message)
        yaw = angle
    return yaw, tilt_of(rotation, yaw)


def _unit_rotation(entry: Mapping[str, Any], instance: str, log: ReadLog) -> QuatXyzw | None:
    """The file's quaternion, normalised; None if it is unusable."""
    value = entry.get("rotation")
    found = numbers(value, 4)
    norm = math.hypot(*found) if found is not None else math.nan
    if found is not None and math.isfinite(norm) and norm > 1e-6:
        if abs(norm - 1) > _UNIT_TOLERANCE:
            log.warn("rotation_not_unit", f"object {instance} has a quaternion of norm {norm:g}, expected 1; it is normalised")
        return normalise_quat((found[0], found[1], found[2], found[3]))
    is_short = isinstance(value, list) and len(value) != 4
    code = "rotation_missing" if value is None else "rotation_wrong_length" if is_short else "rotation_invalid"
    message = f"object {instance} has rotation {quote_value(value)}, expected a quaternion [x, y, z, w]; it is upright, with z_rotation"
    log.warn(code, message)
    return None


def _reply_yaw(entry: Mapping[str, Any], instance: str, log: ReadLog) -> float:
    """Converts a reply's z_rotation from degrees to radians."""
    yaw_deg = number(entry.get("z_rotation"))
    if yaw_deg is not None and math.isfinite(yaw_deg):
        return math.radians(yaw_deg)
    message = f"object {instance} has z_rotation {quote_value(entry.get('z_rotation'))}, expected degrees; it faces the viewer"
    log.warn("z_rotation_invalid", message)
    return 0.0


def _size(entry: Mapping[str, Any], instance: str, scale: Vec3 | None, tilt: QuatXyzw, context: ReadContext) -> Vec3:
    """The box in the yaw frame, metres: the file's size, or the exact product that was rounded to it."""
    value, log, reach = entry.get("size"), context.log, context.limits.max_reach
    found = numbers(value, 3)
    exact = scaled_extents(entry, scale)
    if found is None or not are_finite(found) or min(found) < 0 or max(found) <= 0:
        code = "size_missing" if value is None else "size_invalid"
        if exact is None or math.hypot(*exact) > reach:  # the diagonal bounds the rotated box
            message = f"object {instance} has size {quote_value(value)}, expected three positive numbers in centimetres"
            raise log.error(code, message)
        message = f"object {instance} has size {quote_value(value)}; the rotated box of original_size and scale_factor is used"
        log.warn(code, message)
        return rotated_extents(exact, tilt)
    size = (found[0] / 100, found[1] / 100, found[2] / 100)
    if max(size) > reach:
        most = at_most(context.limits, "max_reach", "m")
        raise log.error("size_huge", f"object {instance} has size {quote_value(value)} cm, expected {most}")
    if exact is None or not is_upright(tilt):  # only upright is the product the box in the yaw frame
        return size
    if max(abs(a - b) for a, b in zip(exact, size, strict=True)) <= _SIZE_ROUNDING:
        return exact
    message = (
        f"object {instance} has size {quote_value(value)} cm, but original_size and scale_factor give {exact} m; size is used"
    )
    log.warn("size_disagrees", message)
    return size


def scaled_extents(entry: Mapping[str, Any], scale: Vec3 | None) -> Vec3 | None:
    """Extents of the scaled mesh along its own axes, metres; None if the file does not give original_size and scale_factor."""
    found = numbers(entry.get("original_size"), 3)
    if scale is None or found is None or not are_finite(found) or min(found) < 0 or max(found) <= 0:
        return None
    extents = (found[0] * scale[0], found[1] * scale[1], found[2] * scale[2])
    return extents if max(extents) > 0 and are_finite(extents) else None


def _annotation(asset_id: str | None, annotations: Mapping[str, AssetAnnotation]) -> AssetAnnotation | None:
    """The annotation of an asset, or of the asset of which it is a rotated variant."""
    return None if asset_id is None else annotations.get(asset_id) or annotations.get(stem_of(asset_id))


def _description(entry: Mapping[str, Any], annotation: AssetAnnotation | None) -> str:
    """The file's own description, else the annotation's."""
    own = entry.get("description")
    if isinstance(own, str) and own.strip():
        return own
    return annotation.words if annotation else ""
