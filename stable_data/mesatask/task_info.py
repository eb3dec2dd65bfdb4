"""Reads and writes the task_info.json of a scene; :mod:`stable_data.task_info` defines what is valid."""

from typing import Any

from stable_data.condition import condition_document
from stable_data.errors import SceneError
from stable_data.json_text import ReadLog, parse_object
from stable_data.scene import Relation, Tabletop, TaskInfo
from stable_data.task_info import LISTS, conditions_in, origin_in, parse_task_info, relations_in

TASK_INFO_FILE = "task_info.json"


def read_task_info(data: bytes | str, scene_id: str) -> TaskInfo:
    """Reads the task of a scene from its file (bytes are UTF-8); unknown keys stay in ``source``.

    Raises:
        SceneError: ``task_info_invalid``: not JSON, no task, one that is too long, or a field of the wrong type.
    """
    log = ReadLog(scene_id)
    try:
        document = parse_object(data, TASK_INFO_FILE, log)
    except SceneError as error:
        raise SceneError(str(error), "task_info_invalid") from error
    return parse_task_info(document, log, TASK_INFO_FILE)


def write_task_info(task: TaskInfo, table: Tabletop) -> dict[str, Any]:
    """Returns the document of a task, lengths in centimetres. A field that is unchanged since it was read is written as it was.

    The table gives item_placement_zone and sink_zone if the task was not read from a file.
    """
    document = dict(task.source or {})
    zones: dict[str, Any] = {}
    if task.source is None:
        width, depth = table.size_xy
        zones["item_placement_zone"] = [0.0, width * 100, 0.0, depth * 100]
        if table.restricted_zone is not None:
            zones["sink_zone"] = [length * 100 for length in table.restricted_zone]
    fields: dict[str, Any] = {"Environment": task.environment, **zones, "Task": task.task}
    for field, key in LISTS.items():
        fields[key] = _list_entry(document.get(key), getattr(task, field))
    if task.task_objects or "task_objects" in document:
        fields["task_objects"] = _list_entry(document.get("task_objects"), task.task_objects)
    if task.relations or "relations" in document:
        same = task.source is not None and relations_in(task.source, ReadLog("")) == task.relations
        fields["relations"] = document["relations"] if same else [_relation_entry(relation) for relation in task.relations]
    if task.conditions or "conditions" in document:
        same = task.source is not None and conditions_in(task.source, ReadLog("")) == task.conditions
        fields["conditions"] = document["conditions"] if same else [condition_document(c) for c in task.conditions]
    if task.origin != origin_in(document):
        fields["origin"] = task.origin
    if task.source is not None:  # a key that the file did not have is added only if it has a value
        fields = {key: value for key, value in fields.items() if key in document or value}
    return document | fields


def _list_entry(was: object, values: tuple[str, ...]) -> object:
    """Returns the file's value if it is unchanged (a single string stays one), else the new list."""
    same = was == list(values) or (isinstance(was, str) and values == (was,))
    return was if same else list(values)


def _relation_entry(relation: Relation) -> dict[str, str]:
    return {"subject": relation.subject, "kind": relation.kind.value, "target": relation.target}
