"""Reads a layout: the dataset's layout.json, or the JSON of a language model's reply.

The dataset's form has ``rotation``, ``scale_factor`` and ``z_rotation`` in radians; the form of a reply has ``description`` and
``z_rotation`` in degrees. The keys of the objects show which form a file has. Lengths are centimetres in both.

A defect without a safe fallback raises SceneError, every other defect is a Notice; in both cases ``code`` names the defect.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from stable_data.assets.annotation import AssetAnnotation
from stable_data.errors import Notice
from stable_data.json_text import ReadLog, are_finite, numbers, parse_object, quote_value
from stable_data.limits import LIMITS, LayoutLimits, at_most
from stable_data.mesatask.entry import MAX_NAME_LENGTH, POSE_KEYS, ReadContext, read_object
from stable_data.scene import TABLE, Rectangle, Scene, Tabletop

LAYOUT_FILE = "layout.json"
ZONE = "item_placement_zone"
"""Entry of a layout: the rectangle of the table."""

_FINAL_ANSWER = "**Final Answer**"


def read_layout(
    data: bytes | str | Mapping[str, Any],
    scene_id: str,
    table_type: str,
    *,
    annotations: Mapping[str, AssetAnnotation] | None = None,
    limits: LayoutLimits | None = None,
) -> tuple[Scene, tuple[Notice, ...]]:
    """Reads a scene from a layout of either form.

    Args:
        data: layout.json (bytes are UTF-8), or its content.
        scene_id: Id of the scene.
        table_type: Type of its table, which the file does not state.
        annotations: By uid; they give categories and descriptions.
        limits: Limits beyond which the layout is refused.

    Returns:
        The scene in SI units with the origin at the zone's corner, and notices about it. Every entry is stored as ``source``.

    Raises:
        SceneError: The layout cannot be used; ``code`` gives the reason.
    """
    log = ReadLog(scene_id)
    limits = limits or LIMITS.layout
    document = _document(data, limits, log)
    scene = _read(document, table_type, ReadContext(log, (0, 0), (0, 0), is_reply_form(document), annotations or {}, limits))
    return scene, tuple(log.notices)


def read_reply_layout(
    reply: str | bytes | Mapping[str, Any],
    scene_id: str = "reply",
    *,
    table: Tabletop | None = None,
    annotations: Mapping[str, AssetAnnotation] | None = None,
    limits: LayoutLimits | None = None,
) -> Scene:
    """Reads a scene from a language model's reply, which may have reasoning, code fences and end marks around the JSON.

    Args:
        reply: The reply, or its JSON as text or content.
        scene_id: Id of the scene.
        table: The table of the request, which a reply may omit and cannot change; None: use the table in the reply.
        annotations: As for :func:`read_layout`.
        limits: As for :func:`read_layout`.

    Returns:
        The scene, possibly without objects. If two objects have the same instance, one is renamed.

    Raises:
        SceneError: The reply cannot be used.
    """
    if isinstance(reply, bytes):
        reply = reply.decode("utf-8", errors="replace")
    if isinstance(reply, str):
        reply = _json_of_reply(reply)
    log = ReadLog(scene_id)
    limits = limits or LIMITS.layout
    document = _document(reply, limits, log)
    context = ReadContext(log, (0, 0), (0, 0), not _has_key(document, POSE_KEYS), annotations or {}, limits)
    return _read(document, TABLE, context, table)


def is_reply_form(document: Mapping[str, Any]) -> bool:
    """Whether a layout is a language model's: an object has a description, and none has a rotation or scale."""
    return not _has_key(document, POSE_KEYS) and _has_key(document, ("description",))


def read_table(document: Mapping[str, Any], table_type: str, log: ReadLog) -> tuple[Tabletop, tuple[float, float]]:
    """Reads the table of a layout, and the corner of its zone that becomes the origin (x_min, y_min, centimetres)."""
    zone = _zone(document, ZONE, log)
    if zone is None:
        raise log.error("zone_missing", f"{ZONE} is missing, expected [x_min, x_max, y_min, y_max]")
    if not (zone[0] < zone[1] and zone[2] < zone[3]):
        raise log.error("zone_max_below_min", f"{ZONE} is {list(zone)}: a maximum is not above its minimum")
    x, y = zone[0], zone[2]  # the new origin
    restricted = _restricted_zone(document, log)
    if restricted is not None:
        x_min, x_max, y_min, y_max = restricted
        restricted = ((x_min - x) / 100, (x_max - x) / 100, (y_min - y) / 100, (y_max - y) / 100)
    return Tabletop(table_type, ((zone[1] - x) / 100, (zone[3] - y) / 100), restricted), (x, y)


def _document(data: bytes | str | Mapping[str, Any], limits: LayoutLimits, log: ReadLog) -> Mapping[str, Any]:
    """Returns the content of a layout of limited size."""
    if isinstance(data, Mapping):
        return data
    if len(data) > limits.max_bytes:
        raise log.error("file_too_big", f"{LAYOUT_FILE} is larger, expected {at_most(limits, 'max_bytes', 'bytes')}")
    return parse_object(data, LAYOUT_FILE, log)


def _read(document: Mapping[str, Any], table_type: str, context: ReadContext, asked: Tabletop | None = None) -> Scene:
    """Converts a document whose form is known; notices go to the context's log."""
    log = context.log
    _check_settings(document, log)
    if asked is not None and document.get(ZONE) is None:
        table, origin_cm = asked, (0.0, 0.0)
    else:
        table, origin_cm = read_table(document, table_type, log)
        table = asked or table
    entries = _entries(document, context)
    context = replace(context, origin_cm=origin_cm, size_xy=table.size_xy)
    objects = tuple(read_object(entry, name, context) for entry, name in zip(entries, _instances(entries, log), strict=True))
    source = {key: value for key, value in document.items() if key != "objects"}
    return Scene(log.item_id, table, objects, source=source)


def _has_key(document: Mapping[str, Any], keys: tuple[str, ...]) -> bool:
    """Whether any object has any of the keys."""
    entries = document.get("objects")
    return isinstance(entries, list) and any(isinstance(e, Mapping) and any(key in e for key in keys) for e in entries)


def _json_of_reply(reply: str) -> str:
    """Extracts the JSON of a reply: after the last final-answer mark, between the outermost braces."""
    answer = reply.rpartition(_FINAL_ANSWER)[2].replace("<|im_end|>", "")
    first, last = answer.find("{"), answer.rfind("}")
    return answer[first : last + 1] if 0 <= first < last else answer


def _check_settings(document: Mapping[str, Any], log: ReadLog) -> None:
    """Refuses another unit, up axis or order of quaternions; a missing setting has the value of the format."""
    settings = document.get("scene_settings", {})
    if not isinstance(settings, Mapping):
        raise log.error("scene_settings_invalid", f"scene_settings is {quote_value(settings)}, expected an object")
    expected = {
        "units": ("centimeters", "centimetres", "cm"),
        "up_axis": ("z", "+z"),
        "rotation_convention": ("absolute_quaternion_xyzw",),
    }
    for key, values in expected.items():
        found = settings.get(key, values[0])
        if not isinstance(found, str) or found.lower() not in values:
            message = f"scene_settings.{key} is {quote_value(found)}, expected {values[0]!r}; convert the file"
            raise log.error(f"{key}_unknown", message)


def _entries(document: Mapping[str, Any], context: ReadContext) -> list[dict[str, Any]]:
    """Returns the entries of the objects: not too many, all JSON objects; an empty list only in a reply, whose stage may be empty."""
    entries, limits, log = document.get("objects"), context.limits, context.log
    if not isinstance(entries, list):
        raise log.error("objects_invalid", f"objects is {quote_value(entries)}, expected a list")
    if not entries and not context.is_reply:
        raise log.error("objects_empty", "objects is an empty list, expected at least one object; nothing to load")
    if len(entries) > limits.max_objects:
        message = f"{len(entries)} objects, expected {at_most(limits, 'max_objects')}; raise it if the scene is correct"
        raise log.error("too_many_objects", message)
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            message = f"objects[{index}] is {quote_value(entry)}, expected an object with instance and position"
            raise log.error("object_invalid", message)
    return entries


def _instances(entries: list[dict[str, Any]], log: ReadLog) -> list[str]:
    """Gives every object a unique name; the first of several with one name keeps it."""
    # Names of later objects are reserved, so that only a repeated name changes.
    taken = {entry.get("instance") for entry in entries if isinstance(entry.get("instance"), str)} | {TABLE}
    names: list[str] = []
    for index, entry in enumerate(entries):
        name = entry.get("instance")
        if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME_LENGTH:
            free = _free_name(f"{index + 1}_object_0", taken)
            message = f"objects[{index}] has instance {quote_value(name)}, expected a name; it is renamed to {free}"
            log.warn("instance_missing", message)
        elif name in names or name == TABLE:
            free = _free_name(name, taken)
            reason = "reserved for the table" if name == TABLE else "used before"
            log.warn("duplicate_instance", f"objects[{index}] has instance {name}, which is {reason}; it is renamed to {free}")
        else:
            free = name
        names.append(free)
        taken.add(free)
    return names


def _free_name(name: str, taken: set[Any]) -> str:
    """Returns the name with the next free counter."""
    match = re.fullmatch(r"(.*)_(\d{1,9})", name, re.DOTALL)
    stem, count = (match[1], int(match[2])) if match else (name, 0)
    while name in taken:
        count += 1
        name = f"{stem}_{count}"
    return name


def _zone(document: Mapping[str, Any], key: str, log: ReadLog) -> Rectangle | None:
    """Returns a rectangle of the file, centimetres; None if it is missing."""
    value = document.get(key)
    if value is None:
        return None
    zone = numbers(value, 4)
    if zone is None or not are_finite(zone) or max(map(abs, zone)) > 1e5:  # 1e5 cm are 1 km
        raise log.error("zone_invalid", f"{key} is {quote_value(value)}, expected [x_min, x_max, y_min, y_max] in centimetres")
    return (zone[0], zone[1], zone[2], zone[3])


def _restricted_zone(document: Mapping[str, Any], log: ReadLog) -> Rectangle | None:
    """Returns the restricted zone, under either of its names, centimetres."""
    for key in ("restricted_zone", "sink_zone"):
        zone = _zone(document, key, log)
        if zone is None:
            continue
        if zone[0] > zone[1] or zone[2] > zone[3]:
            raise log.error("restricted_zone_inverted", f"{key} is {list(zone)}: a maximum is below its minimum")
        if zone[0] < zone[1] and zone[2] < zone[3]:
            return zone
        log.warn("restricted_zone_empty", f"{key} is {list(zone)}, which has no area; it is ignored")
    return None
