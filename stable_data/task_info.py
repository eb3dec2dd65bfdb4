"""The task info of a scene as JSON: its keys, its validation, and its conversion to :class:`TaskInfo`.

The keys are MesaTask's, with ``task_objects``, ``relations``, ``conditions`` and ``origin`` added. A file of a dataset is read leniently
(:func:`parse_task_info`): the instruction is enough. An answer of a model must be complete (:func:`validate_task_info`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from stable_data.condition import ConditionKind, GoalCondition, condition_of
from stable_data.errors import GoalError, SceneError
from stable_data.json_text import ReadLog, are_finite, is_unicode, numbers, quote_value
from stable_data.limits import LIMITS, at_most
from stable_data.scene import Relation, RelationKind, TaskInfo

LISTS = {"goal": "Goal", "action_sequence": "Action Sequence", "objects_cluster": "Objects cluster"}
"""Field of TaskInfo -> key, for the lists of strings that every task info has."""

ORIGINS = ("file", "template", "model")
"""Values of ``origin``; a missing key means the first one."""

_TEXT = {"type": "string"}
_TEXTS = {"type": "array", "items": _TEXT}
_ZONE = {
    "type": "array",
    "items": {"type": "number"},
    "minItems": 4,
    "maxItems": 4,
    "description": "x_min, x_max, y_min, y_max, centimetres",
}

TASK_INFO_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "Task info",
    "type": "object",
    "required": ["Environment", "item_placement_zone", "Task", *LISTS.values()],
    "properties": {
        "Environment": _TEXT,
        "item_placement_zone": _ZONE,
        "sink_zone": _ZONE,
        "Task": {**_TEXT, "description": "the instruction"},
        "Goal": _TEXTS,
        "Action Sequence": _TEXTS,
        "Objects cluster": {**_TEXTS, "description": "types of the task objects"},
        "task_objects": {**_TEXTS, "description": "instances of O^t"},
        "relations": {
            "type": "array",
            "description": "what the instruction entails of the scene it starts from",
            "items": {
                "type": "object",
                "required": ["subject", "kind", "target"],
                "properties": {"subject": _TEXT, "kind": {"enum": [str(k) for k in RelationKind]}, "target": _TEXT},
            },
        },
        "conditions": {
            "type": "array",
            "description": "what holds when the task is done, between instances",
            "items": {
                "type": "object",
                "required": ["subject", "kind", "target"],
                "properties": {
                    "subject": _TEXT,
                    "kind": {"enum": [str(k) for k in ConditionKind]},
                    "target": _TEXT,
                    "distance": {"type": ["number", "null"], "description": "metres"},
                    "is_negated": {"type": ["boolean", "null"]},
                },
            },
        },
    },
}
"""JSON Schema of a complete task info: MesaTask's keys plus ``task_objects``, ``relations`` and ``conditions``."""


def validate_task_info(data: Mapping[str, Any]) -> None:
    """Refuses the content of a ``task_info.json`` that MesaTask's own validator would refuse.

    Raises:
        SceneError: ``task_info_invalid``: a key is missing or of the wrong type, or the task is too long.
    """
    try:
        is_readable = is_unicode(dict(data))
    except (TypeError, ValueError, RecursionError):
        is_readable = False
    if not is_readable:
        raise SceneError("task info: contains values that JSON in UTF-8 cannot represent; write it again", "task_info_invalid")
    for key in ("Environment", "Task"):
        if not isinstance(data.get(key), str) or not data[key].strip():
            raise _invalid(key, data.get(key), "a sentence")
    if len(data["Task"]) > LIMITS.text.max_instruction:
        raise _invalid("Task", data["Task"], at_most(LIMITS.text, "max_instruction", "characters"))
    for key in LISTS.values():
        if not _are_texts(data.get(key)):
            raise _invalid(key, data.get(key), "a list of strings")
    zone = data.get("item_placement_zone")
    if not isinstance(zone, list) or not are_finite(numbers(zone, 4)):
        raise _invalid("item_placement_zone", zone, "[x_min, x_max, y_min, y_max] in centimetres")


def _invalid(key: str, found: Any, expected: str) -> SceneError:
    return SceneError(
        f"task info: {key!r} is {quote_value(found)}, expected {expected}; write the key again", "task_info_invalid"
    )


def task_info_of(data: Mapping[str, Any], origin: str = "file") -> TaskInfo:
    """Parses the complete content of a ``task_info.json``; ``origin`` is one of ORIGINS.

    Its task objects, relations and conditions are omitted: they must be resolved in the scene.

    Raises:
        SceneError: See :func:`validate_task_info`.
    """
    validate_task_info(data)
    known = {key: value for key, value in data.items() if key not in ("task_objects", "relations", "conditions")}
    return replace(parse_task_info(known, ReadLog("task info")), origin=origin, source=data)


def parse_task_info(document: Mapping[str, Any], log: ReadLog, what: str = "task info") -> TaskInfo:
    """Parses the content of a ``task_info.json`` that may lack keys; unknown keys stay in ``source``.

    Args:
        document: The content.
        log: Names the scene in errors.
        what: Name of the document in errors.

    Raises:
        SceneError: ``task_info_invalid``: there is no task, it is too long, or a field has the wrong type.
    """
    task, environment = document.get("Task"), document.get("Environment", "")
    if not isinstance(task, str) or not task.strip():
        raise log.error("task_info_invalid", f"{what} has Task {quote_value(task)}, expected a sentence")
    if len(task) > LIMITS.text.max_instruction:
        most = at_most(LIMITS.text, "max_instruction", "characters")
        found = f"a Task of {len(task):,} characters, expected {most}; shorten it"
        raise log.error("task_info_invalid", f"{what} has {found}")
    if not isinstance(environment, str):
        raise log.error("task_info_invalid", f"{what} has Environment {quote_value(environment)}, expected a sentence")
    lists = {field: _texts(document, key, log, what) for field, key in {**LISTS, "task_objects": "task_objects"}.items()}
    relations = relations_in(document, log, what)
    conditions = conditions_in(document, log, what)
    origin = origin_in(document)
    return TaskInfo(environment, task, **lists, relations=relations, conditions=conditions, origin=origin, source=document)


def _are_texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _texts(document: Mapping[str, Any], key: str, log: ReadLog, what: str) -> tuple[str, ...]:
    """Reads a list of strings; a single string is a list of one."""
    value = document.get(key)
    if value is None:
        return ()
    if isinstance(value, str):
        return (value,)
    if not _are_texts(value):
        raise log.error("task_info_invalid", f"{what} has {key} {quote_value(value)}, expected a list of strings")
    return tuple(value)


def relations_in(document: Mapping[str, Any], log: ReadLog, what: str = "task info") -> tuple[Relation, ...]:
    """Reads the relations of a document, each {subject, kind, target} or a list of these three.

    Raises:
        SceneError: ``task_info_invalid``: a relation has another form.
    """
    entries = document.get("relations")
    if entries is None:
        return ()
    relations = []
    for entry in entries if isinstance(entries, list) else [entries]:
        # A relation of any other type becomes an empty list, which the check below refuses.
        parts: Iterable[Any] = [entry.get(key) for key in ("subject", "kind", "target")] if isinstance(entry, dict) else entry
        parts = parts if isinstance(parts, list) else []
        if len(parts) != 3 or not all(isinstance(part, str) for part in parts) or parts[1] not in list(RelationKind):
            raise log.error("task_info_invalid", f"{what} has relation {quote_value(entry)}, expected [subject, kind, target]")
        relations.append(Relation(parts[0], RelationKind(parts[1]), parts[2]))
    return tuple(relations)


def conditions_in(document: Mapping[str, Any], log: ReadLog, what: str = "task info") -> tuple[GoalCondition, ...]:
    """Reads the conditions of a document.

    Raises:
        SceneError: ``task_info_invalid``: a condition has another form.
    """
    entries = document.get("conditions")
    if entries is None:
        return ()
    try:
        return tuple(map(condition_of, entries if isinstance(entries, list) else [entries]))
    except GoalError as error:
        raise log.error("task_info_invalid", f"{what}: {error}") from error


def origin_in(document: Mapping[str, Any]) -> str:
    """Reads the origin of a document, one of ORIGINS."""
    origin = document.get("origin")
    return origin if origin in ORIGINS else ORIGINS[0]
