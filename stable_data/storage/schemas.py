"""The tables of a run: one Arrow schema each, and rows to and from dataclasses without loss.

Nested data are plain lists and structs, so that pyarrow, polars, duckdb, Ray Data and Hugging Face ``datasets`` read them
with no code of ours. Every column's metadata says its unit and meaning.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, TypeAlias, get_args, get_type_hints

import pyarrow as pa

from stable_data.errors import ConfigError, Notice
from stable_data.json_text import json_text
from stable_data.metrics.card import MetricCard
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Stage, Tabletop, TaskInfo

TABLE_VERSION = 3
"""Raised whenever a column changes its name, type or meaning."""

Row: TypeAlias = dict[str, Any]

_text, _number, _count, _truth = pa.string(), pa.float64(), pa.int64(), pa.bool_()
_numbers, _texts = pa.list_(_number), pa.list_(_text)

RELATION = pa.struct([("subject", _text), ("kind", _text), ("target", _text)])

_object_fields = [
    ("instance", _text),
    ("category", _text),
    ("description", _text),
    ("asset_id", _text),
    ("position", _numbers),
    ("yaw", _number),
    ("tilt_quat_xyzw", _numbers),
    ("scale", _numbers),
    ("size", _numbers),
    ("stage", _text),
    ("support", _text),
]
SAMPLE_OBJECT = pa.struct(_object_fields)
OBJECT = pa.struct([*_object_fields, ("source_json", _text)])

TASK = pa.struct(
    [
        ("environment", _text),
        ("task", _text),
        ("goal", _texts),
        ("action_sequence", _texts),
        ("objects_cluster", _texts),
        ("task_objects", _texts),
        ("relations", pa.list_(RELATION)),
        ("origin", _text),
        ("source_json", _text),
    ]
)
PAIR = pa.struct([("first", _text), ("second", _text), ("penetration_mm", _number)])
VERDICT = pa.struct(
    [
        ("instance", _text),
        ("floats", _truth),
        ("supports", _texts),
        ("gap_mm", _number),
        ("table_penetration_mm", _number),
        ("leaves_table", _truth),
        ("enters_restricted_zone", _truth),
        ("has_mesh", _truth),
    ]
)
PART = pa.struct([("vertices", _numbers), ("faces", pa.list_(pa.int32()))])
RESTING_TILT = pa.struct([("tilt_quat_xyzw", _numbers), ("count", _count)])
MESH_REPORT = pa.struct(
    [
        ("num_vertices", _count),
        ("num_faces", _count),
        ("is_watertight", _truth),
        ("was_watertight", _truth),
        ("is_solid", _truth),
        ("is_sheet", _truth),
        ("num_components", _count),
        ("num_boundary_edges", _count),
        ("num_nonmanifold_edges", _count),
        ("num_flipped_faces", _count),
        ("volume", _number),
        ("area", _number),
        ("actions", _texts),
    ]
)


def _column(name: str, type_: pa.DataType, meaning: str, unit: str = "") -> pa.Field:
    return pa.field(name, type_, metadata={"meaning": meaning, "unit": unit})


DROPPED = pa.struct([("instance", _text), ("reason", _text)])
POSE = pa.struct([("instance", _text), ("position", _numbers), ("yaw", _number)])

_CARD_TYPES: dict[type, pa.DataType] = {int: _count, float: _number, bool: _truth}


def _card_columns() -> list[pa.Field]:
    """One column for each field of the metric card; its docstring is where they are explained."""
    meanings = dict(
        line.strip().split(": ", 1)
        for line in (MetricCard.__doc__ or "").splitlines()
        if line.startswith("        ") and ": " in line
    )
    types = get_type_hints(MetricCard)
    return [
        _column(
            f.name,
            _CARD_TYPES[(get_args(types[f.name]) or (types[f.name],))[0]],
            meanings[f.name],
            "mm" if f.name.endswith("_mm") else "deg" if f.name.endswith("_deg") else "",
        )
        for f in fields(MetricCard)
    ]


CARD = pa.struct([(column.name, column.type) for column in _card_columns()])

_scene_head = [
    _column("scene_id", _text, "unique in the run"),
    _column("split", _text, "train, validation or test: 90/5/5 by near-duplicate group; unseen: tables of other kinds"),
    _column("table_type", _text, "such as office_table"),
    _column("table_size", _numbers, "extent along x and y; the near-left corner is the origin, the top is z = 0", "m"),
    _column("restricted_zone", _numbers, "x_min, x_max, y_min, y_max where nothing may stand, or null", "m"),
    _column("task", TASK, "task info with task objects and entailed relations"),
]

SCHEMAS: dict[str, pa.Schema] = {
    "scenes": pa.schema(
        [
            *_scene_head[:1],
            _column("source", _text, "the dataset that the scene was read from"),
            *_scene_head[1:],
            _column("objects", pa.list_(OBJECT), "objects; position is the centre of the box in the yaw frame", "m, rad"),
            _column("relations", pa.list_(RELATION), "scene graph"),
            *_card_columns(),
            _column(
                "pairs", pa.list_(PAIR), "pairs that touch, nest or could not be judged (null); all others are apart", "mm"
            ),
            _column("verdicts", pa.list_(VERDICT), "one an object, in the order of objects", "mm"),
            _column("layout_path", _text, "where the layout was read, relative to the dataset"),
            _column("layout_sha256", _text, "content of that file"),
            _column("duplicate_group", _text, "scenes on the same table type with the same assets share it, and their split"),
            _column("source_json", _text, "top-level entries of the file, so that nothing is lost"),
        ]
    ),
    "corrections": pa.schema(
        [
            _column("scene_id", _text, "the scene, also where its correction is infeasible and it is in failures"),
            _column(
                "status", _text, "certified, dropped (clean after dropping objects), infeasible, or unknown (a mesh is missing)"
            ),
            _column("reason", _text, "why nothing better was possible; empty where certified"),
            _column("dropped", pa.list_(DROPPED), "objects that found no place, with the reason"),
            _column("start", pa.list_(POSE), "where all objects were, dropped ones included", "m, rad"),
            _column(
                "raw", pa.list_(POSE), "where the flow put them, before they were certified; null without a flow", "m, rad"
            ),
            _column("card_before", CARD, "metric card of the input"),
            _column("card_raw", CARD, "metric card of the raw flow, null without one"),
            _column("card_after", CARD, "metric card of the corrected scene, null where infeasible"),
            _column("on_in_held", _count, "on and in relations that held in the input"),
            _column("on_in_kept", _count, "of them, those that still hold"),
            _column("asked_broken", _count, "on and in relations that the scene graph asks for and the input broke"),
            _column("asked_restored", _count, "of them, those that hold now"),
            _column("directional_held", _count, "directional relations that held in the input"),
            _column("directional_kept", _count, "of them, those that still hold"),
        ]
    ),
    "turns": pa.schema(
        [
            _column("scene_id", _text, "the scene, also where nothing came of it"),
            _column("turn", _count, "number of the turn in its scene, from 0"),
            _column("stage", _text, "what was asked for: task (O^t), important (O^B), secondary (O^b) or whole"),
            _column("tries", _count, "how often the reasoner was asked"),
            _column("refused", pa.list_(_texts), "codes of the faults of each answer that was not taken"),
            _column("reply", _text, "the answer that was taken, as it is said to the reasoner; null where none was"),
            _column("prompt_tokens", _count, "read by the reasoner"),
            _column("reply_tokens", _count, "written by it"),
            _column("cost", _number, "of the tries, in the currency of the engine's prices"),
            _column("unmatched", _texts, "instances for which no asset was found"),
            _column("coarse", pa.list_(POSE), "all objects before the correction; null without one", "m, rad"),
            _column("corrected", pa.list_(POSE), "and after it; null where there was none or no place was found", "m, rad"),
            _column("card_before", CARD, "metric card before the correction; null without one"),
            _column("card_after", CARD, "and after it; null likewise"),
            _column("dropped", pa.list_(DROPPED), "objects that found no place, with the reason"),
            _column("code", _text, "why what was proposed is not in the scene, in short; empty where it is"),
            _column("reason", _text, "the same in one line"),
        ]
    ),
    "settled": pa.schema(
        [
            _column("scene_id", _text, "the scene"),
            _column(
                "poses",
                pa.list_(pa.struct([("instance", _text), ("position", _numbers), ("quat_xyzw", _numbers)])),
                "where the physics engine left each object: the centre of its box, and the rotation from its frame at yaw 0",
                "m",
            ),
        ]
    ),
    "samples": pa.schema(
        [
            *_scene_head,
            _column("stage", _text, "task (O^t), important (O^B) or secondary (O^b)"),
            _column("objects_in", pa.list_(SAMPLE_OBJECT), "objects of all earlier stages", "m, rad"),
            _column(
                "objects_out",
                pa.list_(SAMPLE_OBJECT),
                "objects of this stage, large to small, each followed by what it carries",
                "m, rad",
            ),
        ]
    ),
    "edits": pa.schema(
        [
            _column("edit_id", _text, "unique in the run"),
            *_scene_head[:-1],
            _column("kind", _text, "add, remove, replace, move or restyle"),
            _column("instruction", _text, "what is asked for"),
            _column("objects_in", pa.list_(SAMPLE_OBJECT), "the scene as it was, in its order", "m, rad"),
            _column(
                "objects_out", pa.list_(SAMPLE_OBJECT), "objects that are new, and changed ones under their names", "m, rad"
            ),
            _column("removed", _texts, "instances of objects_in that go"),
        ]
    ),
    "assets": pa.schema(
        [
            _column("asset_id", _text, "unique"),
            _column("category", _text, "kind of thing"),
            _column("description", _text, "short words"),
            _column("caption", _text, "detailed caption"),
            _column("licence", _text, "licence where known"),
            _column("source", _text, "where it comes from"),
            _column("extents", _numbers, "box of the mesh, z up", "mesh units"),
            _column("typical_scale", _numbers, "median scale over the scenes that use it, or null", "m per mesh unit"),
            _column("resting_tilts", pa.list_(RESTING_TILT), "tilts seen in the scenes, most frequent first"),
            _column("is_container", _truth, "may hold things; null where unknown"),
            _column("on_table", _truth, "belongs on a table, as annotated; null in runs that did not keep it"),
            _column("mark_deletion", _truth, "the annotators wanted it removed; null in runs that did not keep it"),
            _column("is_composite", _truth, "several things in one mesh, as annotated; null in runs that did not keep it"),
            _column("report", MESH_REPORT, "what the mesh is and what repair did", "mesh units"),
            _column("mass", _number, "as annotated, or null", "kg"),
            _column("volume", _number, "enclosed, at the typical scale", "m^3"),
            _column("center_of_mass", _numbers, "of the mesh, centred on its box, at the typical scale", "m"),
            _column("inertia_per_mass", _numbers, "3 x 3 about the centre of mass, row by row, at the typical scale", "m^2"),
            _column(
                "points", pa.list_(pa.float32()), "(P, 3) on the surface, farthest-point ordered, row by row", "mesh units"
            ),
            _column("normals", pa.list_(pa.float32()), "(P, 3) outward at the points, row by row"),
            _column("text_embedding", pa.list_(pa.float32()), "unit row of the library's text features, or null"),
            _column("mesh_sha256", _text, "content of the mesh file"),
        ]
    ),
    "sdf": pa.schema(
        [
            _column("asset_id", _text, "the asset"),
            _column("aspect", _numbers, "scale over its largest component, snapped to 5 %"),
            _column("values", pa.list_(pa.float16()), "signed distance at the nodes, negative inside, x slowest", "extent"),
            _column("shape", pa.list_(pa.int32()), "nodes along x, y, z"),
            _column("origin", _numbers, "place of the first node", "extent"),
            _column("spacing", _number, "between nodes", "extent"),
            _column("extent", _number, "the grid's unit: largest extent of the mesh at its aspect", "mesh units"),
            _column("shell_thickness", _number, "of an open sheet's shell; 0 for a solid", "extent"),
            _column("wall_thickness", _number, "of the mesh, estimated", "extent"),
            _column("mean_error", _number, "within one spacing of the surface, measured", "extent"),
            _column("max_error", _number, "the largest of them", "extent"),
            _column("far_error", _number, "largest in the rest of the box, measured", "extent"),
            _column("sign_error", _number, "share of wrong signs half a spacing or more from the surface, measured"),
        ]
    ),
    "features": pa.schema(
        [
            _column("asset_id", _text, "the asset"),
            _column("aspect", _numbers, "scale over its largest component, snapped to 5 %"),
            _column("tilt_quat_xyzw", _numbers, "rotation before yaw; of tilts within about a degree the first in the scenes"),
            _column("feature", pa.list_(pa.float32()), "64-d feature of the normalised cloud"),
            _column(
                "log_extents",
                _numbers,
                "natural logarithm of the box in the yaw frame, metres, at the median scale of such uses",
            ),
            _column("encoder_fingerprint", _text, "weights that made it; rows of different encoders are never mixed"),
        ]
    ),
    "meshes": pa.schema(
        [
            _column("asset_id", _text, "the asset"),
            _column(
                "glb",
                pa.binary(),
                "the repaired mesh as binary glTF, y up, with up to eight colours of its faces",
                "mesh units",
            ),
            _column("parts", pa.list_(PART), "convex parts, z up", "mesh units"),
            _column("parts_method", _text, "hull or the decomposition used"),
            _column("parts_overfill_max", _number, "how far the parts stand out of the mesh at most", "mesh units"),
            _column("parts_overfill_mean", _number, "the same, mean over the parts' surface", "mesh units"),
            _column("parts_uncovered_max", _number, "how far the mesh stands out of the parts at most", "mesh units"),
            _column("parts_uncovered_mean", _number, "the same, mean over the mesh's surface", "mesh units"),
            _column("hull_distance", _number, "parts_overfill_max of the convex hull", "mesh units"),
            _column("sha256", _text, "content of glb"),
        ]
    ),
    "warnings": pa.schema(
        [
            _column("id", _text, "scene or asset that was kept"),
            _column("step", _text, "step that noticed"),
            _column("code", _text, "short reason"),
            _column("message", _text, "one line for a person"),
        ]
    ),
}
SCHEMAS["failures"] = SCHEMAS["warnings"].set(0, _column("id", _text, "scene or asset that could not be used"))
SCHEMAS["rejected"] = (
    SCHEMAS["scenes"]
    .append(_column("code", _text, "the rule that it broke: accept, or the code of what went wrong"))
    .append(_column("reason", _text, "one line for a person"))
)
SCHEMAS = {
    name: schema.with_metadata({"stable_data.table": name, "stable_data.version": str(TABLE_VERSION)})
    for name, schema in SCHEMAS.items()
}
"""Name of a table -> its schema."""


def arrow_table(name: str, rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Rows as an Arrow table.

    Args:
        name: One of SCHEMAS.
        rows: Column -> value; every column must be there.

    Returns:
        The table; an empty one for no rows.
    """
    schema = SCHEMAS[name]
    for row in rows:
        assert row.keys() == set(schema.names), (name, row.keys() ^ set(schema.names))
    return pa.Table.from_pylist(list(rows), schema=schema)


def check_version(schema: pa.Schema, where: str) -> None:
    """Refuses a table that was written by another version.

    Raises:
        ConfigError: The table's version is not TABLE_VERSION.
    """
    found = (schema.metadata or {}).get(b"stable_data.version", b"none").decode()
    if found != str(TABLE_VERSION):
        raise ConfigError(
            f"{where}: written as table version {found}, expected {TABLE_VERSION}; preprocess the dataset again into a new folder",
            "table_version",
        )


def _json(source: Mapping[str, Any] | None) -> str | None:
    return None if source is None else json_text(source, separators=(",", ":"))


def _relation_rows(relations: Iterable[Relation]) -> list[Row]:
    return [{"subject": r.subject, "kind": str(r.kind), "target": r.target} for r in relations]


def _relations(rows: Sequence[Mapping[str, str]]) -> tuple[Relation, ...]:
    return tuple(Relation(r["subject"], RelationKind(r["kind"]), r["target"]) for r in rows)


def object_row(o: SceneObject, *, with_source: bool = True) -> Row:
    """An object as a row of OBJECT, or of SAMPLE_OBJECT without its source."""
    row: Row = {f.name: getattr(o, f.name) for f in SAMPLE_OBJECT}
    row["stage"] = None if o.stage is None else str(o.stage)
    return row | {"source_json": _json(o.source)} if with_source else row


def object_from_row(row: Mapping[str, Any]) -> SceneObject:
    """The object that :func:`object_row` wrote."""
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
        source=None if source is None else json.loads(source),
    )


def task_row(task: TaskInfo | None) -> Row | None:
    """A task info as a row of TASK."""
    if task is None:
        return None
    row = {f.name: getattr(task, f.name) for f in TASK if f.name not in ("relations", "source_json")}
    return row | {"relations": _relation_rows(task.relations), "source_json": _json(task.source)}


def task_from_row(row: Mapping[str, Any] | None) -> TaskInfo | None:
    """The task info that :func:`task_row` wrote."""
    if row is None:
        return None
    return TaskInfo(
        environment=row["environment"],
        task=row["task"],
        goal=tuple(row["goal"]),
        action_sequence=tuple(row["action_sequence"]),
        objects_cluster=tuple(row["objects_cluster"]),
        task_objects=tuple(row["task_objects"]),
        relations=_relations(row["relations"]),
        origin=row["origin"],
        source=None if row["source_json"] is None else json.loads(row["source_json"]),
    )


def scene_row(scene: Scene) -> Row:
    """A scene as the columns of ``scenes`` that describe the scene itself."""
    return {
        "scene_id": scene.scene_id,
        "table_type": scene.table.table_type,
        "table_size": scene.table.size_xy,
        "restricted_zone": scene.table.restricted_zone,
        "task": task_row(scene.task),
        "objects": [object_row(o) for o in scene.objects],
        "relations": _relation_rows(scene.relations),
        "source_json": _json(scene.source),
    }


def scene_from_row(row: Mapping[str, Any]) -> Scene:
    """The scene that :func:`scene_row` wrote; columns that do not describe it are left alone."""
    zone, source = row["restricted_zone"], row["source_json"]
    size_x, size_y = row["table_size"]
    return Scene(
        scene_id=row["scene_id"],
        table=Tabletop(row["table_type"], (size_x, size_y), None if zone is None else tuple(zone)),
        objects=tuple(object_from_row(o) for o in row["objects"]),
        task=task_from_row(row["task"]),
        relations=_relations(row["relations"]),
        source=None if source is None else json.loads(source),
    )


def card_from_row(row: Mapping[str, Any]) -> MetricCard:
    """The metric card of a row of ``scenes``."""
    return MetricCard(**{f.name: row[f.name] for f in fields(MetricCard)})


def card_row(card: MetricCard) -> Row:
    """A metric card as columns of ``scenes``."""
    return asdict(card)


def notice_row(notice: Notice) -> Row:
    """A notice as a row of ``warnings`` or ``failures``."""
    return {"id": notice.item_id, "step": notice.step, "code": notice.code, "message": notice.message}
