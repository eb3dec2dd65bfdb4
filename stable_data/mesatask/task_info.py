"""The task_info.json that may lie beside a layout: MesaTask's keys, and the two that this project adds."""

from collections.abc import Iterable, Mapping
from typing import Any

from stable_data.errors import SceneError
from stable_data.json_text import ReadLog, parse_object, shown
from stable_data.scene import MAX_INSTRUCTION, Relation, RelationKind, Tabletop, TaskInfo

TASK_INFO_FILE = "task_info.json"


def read_task_info(data: bytes | str, scene_id: str) -> TaskInfo:
    """The task of a scene.

    Args:
        data: The file, UTF-8 where bytes.
        scene_id: The scene, for messages.

    Returns:
        The task; keys that are not known stay in ``source``.

    Raises:
        SceneError: ``task_info_invalid``: not JSON, no task, one longer than MAX_INSTRUCTION, or a field of the wrong type.
    """
    log = ReadLog(scene_id)
    try:
        document = parse_object(data, TASK_INFO_FILE, log)
    except SceneError as error:
        raise SceneError(str(error), "task_info_invalid") from error
    task = document.get("Task")
    if not isinstance(task, str) or not task.strip():
        raise log.error("task_info_invalid", f"{TASK_INFO_FILE} has Task {shown(task)}, expected a sentence")
    if len(task) > MAX_INSTRUCTION:
        found = f"a Task of {len(task):,} characters, expected at most {MAX_INSTRUCTION:,}; shorten it"
        raise log.error("task_info_invalid", f"{TASK_INFO_FILE} has {found}")
    environment = document.get("Environment", "")
    if not isinstance(environment, str):
        raise log.error("task_info_invalid", f"{TASK_INFO_FILE} has Environment {shown(environment)}, expected a sentence")
    return TaskInfo(
        environment,
        task,
        goal=_texts(document, "Goal", log),
        action_sequence=_texts(document, "Action Sequence", log),
        objects_cluster=_texts(document, "Objects cluster", log),
        task_objects=_texts(document, "task_objects", log),
        relations=_relations(document, log),
        origin=_origin(document),
        source=document,
    )


def write_task_info(task: TaskInfo, table: Tabletop) -> dict[str, Any]:
    """The document of a task, lengths in centimetres.

    Args:
        task: Written untouched where it still says what it was read from.
        table: Gives item_placement_zone and sink_zone where the task was not read from a file.
    """
    document = dict(task.source or {})
    zones: dict[str, Any] = {}
    if task.source is None:
        width, depth = table.size_xy
        zones["item_placement_zone"] = [0.0, width * 100, 0.0, depth * 100]
        if table.restricted_zone is not None:
            zones["sink_zone"] = [length * 100 for length in table.restricted_zone]
    fields: dict[str, Any] = {"Environment": task.environment, **zones, "Task": task.task}
    for key, values in (
        ("Goal", task.goal),
        ("Action Sequence", task.action_sequence),
        ("Objects cluster", task.objects_cluster),
    ):
        fields[key] = _kept(document.get(key), values)
    if task.task_objects or "task_objects" in document:
        fields["task_objects"] = _kept(document.get("task_objects"), task.task_objects)
    if task.relations or "relations" in document:
        same = task.source is not None and _relations(task.source, ReadLog("")) == task.relations
        fields["relations"] = document["relations"] if same else [_relation_entry(relation) for relation in task.relations]
    if task.origin != _origin(document):
        fields["origin"] = task.origin
    return document | fields if task.source is None else _updated(document, fields)


def _updated(document: dict[str, Any], fields: Mapping[str, Any]) -> dict[str, Any]:
    """The document with new values; keys that it did not have are added only where they say something."""
    return document | {key: value for key, value in fields.items() if key in document or value}


def _kept(was: object, values: tuple[str, ...]) -> object:
    """What stood there, where it says the same: a lone string stays one."""
    same = was == list(values) or (isinstance(was, str) and values == (was,)) or (was is None and not values)
    return was if same and was is not None else list(values)


def _texts(document: Mapping[str, Any], key: str, log: ReadLog) -> tuple[str, ...]:
    """A list of strings; a lone string is a list of one."""
    value = document.get(key)
    if value is None:
        return ()
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise log.error("task_info_invalid", f"{TASK_INFO_FILE} has {key} {shown(value)}, expected a list of strings")
    return tuple(value)


def _relations(document: Mapping[str, Any], log: ReadLog) -> tuple[Relation, ...]:
    """Relations, each {subject, kind, target} or a list of the three."""
    entries = document.get("relations")
    if entries is None:
        return ()
    relations = []
    for entry in entries if isinstance(entries, list) else [entries]:
        parts: Iterable[Any] = [entry.get(key) for key in ("subject", "kind", "target")] if isinstance(entry, dict) else entry
        parts = parts if isinstance(parts, list) else []
        if len(parts) != 3 or not all(isinstance(part, str) for part in parts) or parts[1] not in list(RelationKind):
            raise log.error(
                "task_info_invalid", f"{TASK_INFO_FILE} has relation {shown(entry)}, expected [subject, kind, target]"
            )
        relations.append(Relation(parts[0], RelationKind(parts[1]), parts[2]))
    return tuple(relations)


def _relation_entry(relation: Relation) -> dict[str, str]:
    return {"subject": relation.subject, "kind": relation.kind.value, "target": relation.target}


def _origin(document: Mapping[str, Any]) -> str:
    """Where the task came from, where the file says so in the words of TaskInfo."""
    origin = document.get("origin")
    return origin if origin in ("file", "template", "model") else "file"
