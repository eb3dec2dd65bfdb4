"""Rows of tables from scenes, tasks, cards and notices, and back, without loss."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

import pyarrow as pa

from stable_data.condition import condition_document, condition_of
from stable_data.errors import Notice, SceneError
from stable_data.json_text import json_text, json_value, quote_value
from stable_data.limits import LIMITS, at_most
from stable_data.metrics.card import MetricCard
from stable_data.metrics.judge_columns import FURTHER_COLUMNS
from stable_data.metrics.reach_columns import REACH_COLUMNS
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Stage, SupportFrame, Tabletop, TaskInfo
from stable_data.storage.schemas import SAMPLE_OBJECT, SCHEMAS, TASK, Row

VARIANT_COLUMNS = ("variant_of", "varied", "num_varied")
"""Columns of ``scenes`` that state of which scene a row is a variant."""

ROW_ERRORS = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""What a value causes that no job has written: a run may come from anywhere."""


def arrow_table(name: str, rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Returns rows as an Arrow table; the table is empty if there are no rows.

    Args:
        name: Name in SCHEMAS.
        rows: Column -> value; every row has every column.
    """
    schema = SCHEMAS[name]
    for row in rows:
        assert row.keys() == set(schema.names), (name, row.keys() ^ set(schema.names))
    return pa.Table.from_pylist(list(rows), schema=schema)


def _json(source: Mapping[str, Any] | None) -> str | None:
    return None if source is None else json_text(source, separators=(",", ":"))


def _source(text: str | None) -> dict[str, Any] | None:
    """What :func:`_json` wrote, read with limits: what a file of others has there is written again by jobs that copy a scene.

    Raises:
        ValueError: It is no JSON object, or no file could be written with it, such as half of a surrogate pair.
    """
    found = None if text is None else json_value(text)
    if not isinstance(found, dict | None):
        raise ValueError(f"source_json is {quote_value(found)}, expected a JSON object")
    return found


def _relation_rows(relations: Iterable[Relation]) -> list[Row]:
    return [{"subject": r.subject, "kind": str(r.kind), "target": r.target} for r in relations]


def _relations(rows: Sequence[Mapping[str, str]]) -> tuple[Relation, ...]:
    return tuple(Relation(r["subject"], RelationKind(r["kind"]), r["target"]) for r in rows)


def object_row(o: SceneObject, *, with_source: bool = True) -> Row:
    """Returns an object as a value of type OBJECT, or of type SAMPLE_OBJECT without its source."""
    row: Row = {f.name: getattr(o, f.name) for f in SAMPLE_OBJECT}
    row["stage"] = None if o.stage is None else str(o.stage)
    return row | {"source_json": _json(o.source)} if with_source else row


def object_from_row(row: Mapping[str, Any]) -> SceneObject:
    """Returns the object of a value that :func:`object_row` made."""
    source = row.get("source_json")
    return SceneObject(
        instance=row["instance"],
        category=row["category"],
        description=row["description"],
        asset_id=row["asset_id"],
        position=tuple(row["position"]),
        yaw=row["yaw"],
        tilt_quat_xyzw=tuple(row["tilt_quat_xyzw"]),
        scale=None if row["scale"] is None else tuple(row["scale"]),
        size=tuple(row["size"]),
        stage=None if row["stage"] is None else Stage(row["stage"]),
        support=row["support"],
        source=_source(source),
    )


def task_row(task: TaskInfo | None) -> Row | None:
    """Returns a task info as a value of type TASK."""
    if task is None:
        return None
    row = {f.name: getattr(task, f.name) for f in TASK if f.name not in ("relations", "conditions", "source_json")}
    return row | {
        "relations": _relation_rows(task.relations),
        "conditions": [condition_document(c) for c in task.conditions] or None,
        "source_json": _json(task.source),
    }


def task_from_row(row: Mapping[str, Any] | None) -> TaskInfo | None:
    """Returns the task info of a value that :func:`task_row` made."""
    if row is None:
        return None
    _check((row["environment"], row["task"]), ())
    return TaskInfo(
        environment=row["environment"],
        task=row["task"],
        goal=tuple(row["goal"]),
        action_sequence=tuple(row["action_sequence"]),
        objects_cluster=tuple(row["objects_cluster"]),
        task_objects=tuple(row["task_objects"]),
        relations=_relations(row["relations"]),
        conditions=tuple(map(condition_of, row.get("conditions") or ())),
        origin=row["origin"],
        source=_source(row["source_json"]),
    )


def scene_row(scene: Scene) -> Row:
    """Returns a scene as the columns of ``scenes`` that describe the scene itself, which is no variant of another one."""
    return {
        "scene_id": scene.scene_id,
        "table_type": scene.table.table_type,
        "table_size": scene.table.size_xy,
        "restricted_zone": scene.table.restricted_zone,
        "task": task_row(scene.task),
        "objects": [object_row(o) for o in scene.objects],
        "relations": _relation_rows(scene.relations),
        "fixed": sorted(scene.fixed) or None,
        "surface": _surface_row(scene),
        "source_json": _json(scene.source),
        **dict.fromkeys(VARIANT_COLUMNS),
    }


def scene_from_row(row: Mapping[str, Any]) -> Scene:
    """Returns the scene of a row that :func:`scene_row` made; other columns are ignored.

    Raises:
        SceneError: ``row_invalid``: a value is missing or none of a scene. A run may come from anywhere.
    """
    try:
        _check_size(row)
        scene = _scene_of(row)
        _check_scene(scene)
    except ROW_ERRORS as error:
        reason = f"{type(error).__name__}: {error}"
        message = f"{quote_value(row.get('scene_id'))}: the row of its scene cannot be used ({reason:.200})"
        raise SceneError(f"{message}, expected what a job writes; make the run again", "row_invalid") from error
    return scene


def _check_size(row: Mapping[str, Any]) -> None:
    """Refuses a row of too many objects, or of more JSON than a layout file may have: rows of a small file may share the same text.

    Raises:
        ValueError: See above.
    """
    objects = row["objects"]
    if len(objects) > LIMITS.table.max_objects:
        raise ValueError(f"{len(objects):,} objects, expected {at_most(LIMITS.table, 'max_objects')}")
    if (
        size := sum(len(part.get("source_json") or "") for part in (row, row["task"] or {}, *objects))
    ) > LIMITS.layout.max_bytes:
        raise ValueError(f"source_json of {size:,} characters, expected {at_most(LIMITS.layout, 'max_bytes')}")


def _check_scene(scene: Scene) -> None:
    """Refuses values that no scene has.

    Raises:
        TypeError, ValueError: See above.
    """
    texts = [scene.scene_id, scene.table.table_type]
    width, depth = scene.table.size_xy
    numbers = [width, depth, *_several(scene.table.restricted_zone, 4)]
    for o in scene.objects:
        texts += (o.instance, o.category, o.description)
        numbers += (*_several(o.position, 3), *_several(o.size, 3), o.yaw)
        numbers += (*_several(o.scale, 3), *_several(o.tilt_quat_xyzw, 4))
    _check(texts, numbers)
    if not (width > 0 and depth > 0):
        raise ValueError("the table has no extents")


def _check(texts: Sequence[str], numbers: Iterable[float]) -> None:
    if not all(type(text) is str for text in texts):
        raise TypeError("a text is null")
    if not all(map(math.isfinite, numbers)):
        raise ValueError("a number is not finite")


def _several(values: Sequence[float] | None, count: int) -> Sequence[float]:
    if values is not None and len(values) != count:
        raise ValueError(f"a list of {len(values)} numbers, expected {count}")
    return values or ()


def _scene_of(row: Mapping[str, Any]) -> Scene:
    zone, source = row["restricted_zone"], row["source_json"]
    frame, clearance = surface_from_row(row.get("surface"))
    size_x, size_y = row["table_size"]
    return Scene(
        scene_id=row["scene_id"],
        table=Tabletop(row["table_type"], (size_x, size_y), None if zone is None else tuple(zone), clearance),
        objects=tuple(object_from_row(o) for o in row["objects"]),
        task=task_from_row(row["task"]),
        relations=_relations(row["relations"]),
        source=_source(source),
        fixed=frozenset(row.get("fixed") or ()),
        frame=frame,
    )


def _surface_row(scene: Scene) -> Row | None:
    frame, clearance = scene.frame, scene.table.clearance
    if frame is None and clearance is None:
        return None
    return ({} if frame is None else asdict(frame)) | {"clearance": clearance}


def surface_from_row(row: Mapping[str, Any] | None) -> tuple[SupportFrame | None, float | None]:
    """Returns the frame and the clearance of a value of the column ``surface``; raises one of :data:`ROW_ERRORS`."""
    if row is None or row["support"] is None:
        return None, None if row is None else row["clearance"]
    frame = SupportFrame(row["support"], row["surface"], tuple(row["origin"]), row["yaw"], row["asset_id"])
    _check((frame.support, frame.surface), (*_several(frame.origin, 3), frame.yaw))
    return frame, row["clearance"]


def card_from_row(row: Mapping[str, Any]) -> MetricCard:
    """Returns the metric card of a row of ``scenes``."""
    return MetricCard(**{f.name: row[f.name] for f in fields(MetricCard)})


def card_columns(row: Mapping[str, Any]) -> Row:
    """Returns the verdicts in a row of ``scenes``: the metric card, and what further judges said of it, if they were asked."""
    card = {f.name: row.get(f.name) for f in fields(MetricCard)}
    return card | {name: row[name] for name in FURTHER_COLUMNS if row.get(name) is not None}


def card_row(card: MetricCard) -> Row:
    """Returns a metric card as columns of ``scenes``; the columns of judges other than MuJoCo, and of a robot, are null."""
    return asdict(card) | dict.fromkeys((*FURTHER_COLUMNS, *REACH_COLUMNS))


def notice_row(notice: Notice) -> Row:
    """Returns a notice as a row of ``warnings`` or ``failures``."""
    return {"id": notice.item_id, "step": notice.step, "code": notice.code, "message": notice.message}
