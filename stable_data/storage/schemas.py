"""The tables of a run: one Arrow schema each, and rows to and from dataclasses without loss.

Nested data are plain lists and structs, so that pyarrow, polars, duckdb, Ray Data and Hugging Face ``datasets`` read them
with no code of ours. Every column's metadata says its unit and meaning.
"""

import json
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, TypeAlias, get_args, get_type_hints

import pyarrow as pa

from stable_data.errors import ConfigError, MissingColumnsWarning, Notice
from stable_data.json_text import json_text
from stable_data.metrics.card import MetricCard
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Stage, Tabletop, TaskInfo

TABLE_VERSION = 3
"""Raised whenever a column changes its name, type or meaning. A new column that may be null does not raise it: tables that
were written before it existed are read with null, which is unknown."""

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
    """One column for each field of the metric card, with the field's meaning and unit."""
    types = get_type_hints(MetricCard)
    return [
        _column(
            f.name,
            _CARD_TYPES[(get_args(types[f.name]) or (types[f.name],))[0]],
            f.metadata["meaning"],
            f.metadata["unit"],
        )
        for f in fields(MetricCard)
    ]


CARD = pa.struct([(column.name, column.type) for column in _card_columns()])

_scene_head = [
    _column("scene_id", _text, "identifier of the scene, unique in the run"),
    _column("split", _text, "train, validation or test (90/5/5 by near-duplicate group), or unseen (held-out table types)"),
    _column("table_type", _text, "type of the table, such as office_table"),
    _column(
        "table_size", _numbers, "extent of the table along x and y; the origin is its near-left corner, its top is z = 0", "m"
    ),
    _column(
        "restricted_zone", _numbers, "x_min, x_max, y_min, y_max of the area where no object may stand; null without one", "m"
    ),
    _column("task", TASK, "task info with task objects and the relations that the instruction states; null without a task"),
]

SCHEMAS: dict[str, pa.Schema] = {
    "scenes": pa.schema(
        [
            *_scene_head[:1],
            _column("source", _text, "name of the dataset that the scene was read from"),
            *_scene_head[1:],
            _column(
                "objects",
                pa.list_(OBJECT),
                "objects of the scene; position is the centre of the bounding box in the yaw frame",
                "m, rad",
            ),
            _column("relations", pa.list_(RELATION), "scene graph: spatial relations between objects"),
            *_card_columns(),
            _column(
                "pairs",
                pa.list_(PAIR),
                "object pairs that touch or contain each other, with their penetration, null where unknown; all other pairs are apart",
                "mm",
            ),
            _column("verdicts", pa.list_(VERDICT), "verdict on each object, in the order of objects", "mm"),
            _column("layout_path", _text, "path of the layout file, relative to the dataset"),
            _column("layout_sha256", _text, "SHA-256 of the layout file"),
            _column(
                "duplicate_group",
                _text,
                "near-duplicate group: scenes with the same table type and the same assets share it, and share the split",
            ),
            _column("source_json", _text, "top-level entries of the layout file as JSON, so that a round trip loses nothing"),
        ]
    ),
    "corrections": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene; an infeasible scene is here and in failures"),
            _column(
                "status",
                _text,
                "certified, dropped (clean after objects were removed), infeasible, or unknown (a mesh is missing)",
            ),
            _column("reason", _text, "reason for a status other than certified; empty where certified"),
            _column(
                "dropped", pa.list_(DROPPED), "objects that were removed because they could not be placed, with the reason"
            ),
            _column("start", pa.list_(POSE), "input pose of each object, removed objects included", "m, rad"),
            _column(
                "raw",
                pa.list_(POSE),
                "pose of each object after the flow and before certification; null without a flow",
                "m, rad",
            ),
            _column("card_before", CARD, "metric card of the input scene"),
            _column("card_raw", CARD, "metric card after the flow and before certification; null without a flow"),
            _column("card_after", CARD, "metric card of the corrected scene; null where infeasible"),
            _column("on_in_held", _count, "number of on and in relations that held in the input"),
            _column("on_in_kept", _count, "number of those relations that hold after the correction"),
            _column("asked_broken", _count, "number of on and in relations of the scene graph that did not hold in the input"),
            _column("asked_restored", _count, "number of those relations that hold after the correction"),
            _column("directional_held", _count, "number of directional relations that held in the input"),
            _column("directional_kept", _count, "number of those relations that hold after the correction"),
        ]
    ),
    "turns": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene, accepted or not"),
            _column("turn", _count, "index of the turn in its scene, from 0"),
            _column("stage", _text, "stage that was requested: task (O^t), important (O^B), secondary (O^b) or whole"),
            _column("tries", _count, "number of requests to the reasoner"),
            _column("refused", pa.list_(_texts), "error codes of each rejected reply, one list a reply"),
            _column("reply", _text, "accepted reply, in the form in which later turns repeat it; null without one"),
            _column("prompt_tokens", _count, "number of tokens in the prompts of the turn"),
            _column("reply_tokens", _count, "number of tokens in the replies of the turn"),
            _column("cost", _number, "cost of all requests, in the currency of the engine's prices"),
            _column("unmatched", _texts, "instances without a matching asset"),
            _column("coarse", pa.list_(POSE), "pose of each object before the correction; null without a correction", "m, rad"),
            _column(
                "corrected",
                pa.list_(POSE),
                "pose of each object after the correction; null without a correction or where it is infeasible",
                "m, rad",
            ),
            _column("card_before", CARD, "metric card before the correction; null without a correction"),
            _column(
                "card_after", CARD, "metric card after the correction; null without a correction or where it is infeasible"
            ),
            _column(
                "dropped", pa.list_(DROPPED), "objects that were removed because they could not be placed, with the reason"
            ),
            _column("code", _text, "short code of why the proposal was rejected; empty where it was accepted"),
            _column("reason", _text, "reason for the rejection in one line; empty where the proposal was accepted"),
        ]
    ),
    "settled": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene"),
            _column(
                "poses",
                pa.list_(pa.struct([("instance", _text), ("position", _numbers), ("quat_xyzw", _numbers)])),
                "pose of each object after physical settling: the centre of its box, and the rotation from its frame at yaw 0",
                "m",
            ),
        ]
    ),
    "samples": pa.schema(
        [
            *_scene_head,
            _column("stage", _text, "stage of objects_out: task (O^t), important (O^B) or secondary (O^b)"),
            _column("objects_in", pa.list_(SAMPLE_OBJECT), "objects of all earlier stages", "m, rad"),
            _column(
                "objects_out",
                pa.list_(SAMPLE_OBJECT),
                "objects of this stage, from large to small, each followed by the objects that it supports",
                "m, rad",
            ),
        ]
    ),
    "edits": pa.schema(
        [
            _column("edit_id", _text, "identifier of the edit, unique in the run"),
            *_scene_head[:-1],
            _column("kind", _text, "kind of the edit: add, remove, replace, move or restyle"),
            _column("instruction", _text, "instruction of the edit"),
            _column(
                "objects_in",
                pa.list_(SAMPLE_OBJECT),
                "objects of the scene before the edit, in the order of the scene",
                "m, rad",
            ),
            _column(
                "objects_out", pa.list_(SAMPLE_OBJECT), "new objects, and changed objects under their old instance", "m, rad"
            ),
            _column("removed", _texts, "instances of objects_in that the edit removes"),
        ]
    ),
    "assets": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset, unique in the run"),
            _column("category", _text, "category of the asset"),
            _column("description", _text, "short description"),
            _column("caption", _text, "detailed caption"),
            _column("licence", _text, "licence; null where unknown"),
            _column("source", _text, "origin of the asset"),
            _column("extents", _numbers, "extents of the mesh's bounding box, z up", "mesh units"),
            _column(
                "typical_scale",
                _numbers,
                "median scale over the scenes that use the asset; null where no scene does",
                "m per mesh unit",
            ),
            _column("resting_tilts", pa.list_(RESTING_TILT), "tilts of the asset in the scenes, most frequent first"),
            _column("is_container", _truth, "true where other objects can be placed inside; null where unknown"),
            _column("on_table", _truth, "annotation: true where the asset belongs on a table; null where unknown"),
            _column(
                "mark_deletion",
                _truth,
                "annotation: true where the annotators marked the asset for deletion; null where unknown",
            ),
            _column("is_composite", _truth, "annotation: true where the mesh contains several objects; null where unknown"),
            _column("report", MESH_REPORT, "properties of the mesh and the repairs that were made", "mesh units"),
            _column("mass", _number, "mass as annotated; null where unknown", "kg"),
            _column("volume", _number, "enclosed volume at the typical scale", "m^3"),
            _column(
                "center_of_mass",
                _numbers,
                "centre of mass relative to the centre of the bounding box, at the typical scale",
                "m",
            ),
            _column(
                "inertia_per_mass",
                _numbers,
                "inertia tensor divided by the mass, 3 x 3 about the centre of mass, row-major, at the typical scale",
                "m^2",
            ),
            _column(
                "points", pa.list_(pa.float32()), "surface points (P, 3), in farthest-point order, row-major", "mesh units"
            ),
            _column("normals", pa.list_(pa.float32()), "outward surface normals (P, 3) at the points, row-major"),
            _column(
                "text_embedding",
                pa.list_(pa.float32()),
                "text embedding of unit length from the library's text features; null without one",
            ),
            _column("mesh_sha256", _text, "SHA-256 of the mesh file"),
        ]
    ),
    "sdf": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset"),
            _column("aspect", _numbers, "scale divided by its largest component, rounded to steps of 5 %"),
            _column(
                "values",
                pa.list_(pa.float16()),
                "signed distance at the grid nodes, negative inside, x varies slowest",
                "extent",
            ),
            _column("shape", pa.list_(pa.int32()), "number of grid nodes along x, y and z"),
            _column("origin", _numbers, "position of the first grid node", "extent"),
            _column("spacing", _number, "distance between neighbouring grid nodes", "extent"),
            _column("extent", _number, "length unit of the grid: largest extent of the mesh at its aspect", "mesh units"),
            _column(
                "shell_thickness", _number, "thickness of the shell that is put around an open surface; 0 for a solid", "extent"
            ),
            _column("wall_thickness", _number, "estimated wall thickness of the mesh", "extent"),
            _column("mean_error", _number, "measured mean error within one spacing of the surface", "extent"),
            _column("max_error", _number, "measured largest error within one spacing of the surface", "extent"),
            _column("far_error", _number, "measured largest error in the rest of the grid", "extent"),
            _column("sign_error", _number, "measured share of wrong signs at half a spacing or more from the surface"),
        ]
    ),
    "features": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset"),
            _column("aspect", _numbers, "scale divided by its largest component, rounded to steps of 5 %"),
            _column(
                "tilt_quat_xyzw",
                _numbers,
                "rotation before yaw; tilts within about one degree share one row, with the first of them in the scenes",
            ),
            _column("feature", pa.list_(pa.float32()), "64-d feature of the normalised point cloud"),
            _column(
                "log_extents",
                _numbers,
                "natural logarithm of the bounding box in the yaw frame, in metres, at the median scale of these uses",
            ),
            _column(
                "encoder_fingerprint", _text, "fingerprint of the encoder's weights; one run holds features of one encoder"
            ),
        ]
    ),
    "meshes": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset"),
            _column(
                "glb",
                pa.binary(),
                "repaired mesh as binary glTF, y up, with at most eight face colours",
                "mesh units",
            ),
            _column("parts", pa.list_(PART), "convex decomposition of the mesh, z up", "mesh units"),
            _column("parts_method", _text, "method of the decomposition, or hull"),
            _column("parts_overfill_max", _number, "largest distance by which the parts extend beyond the mesh", "mesh units"),
            _column(
                "parts_overfill_mean",
                _number,
                "mean distance by which the parts extend beyond the mesh, over the surface of the parts",
                "mesh units",
            ),
            _column(
                "parts_uncovered_max", _number, "largest distance by which the mesh extends beyond the parts", "mesh units"
            ),
            _column(
                "parts_uncovered_mean",
                _number,
                "mean distance by which the mesh extends beyond the parts, over the surface of the mesh",
                "mesh units",
            ),
            _column(
                "hull_distance", _number, "largest distance by which the convex hull extends beyond the mesh", "mesh units"
            ),
            _column("sha256", _text, "SHA-256 of glb"),
        ]
    ),
    "warnings": pa.schema(
        [
            _column("id", _text, "identifier of the scene or asset, which was kept"),
            _column("step", _text, "step of the pipeline that reported it"),
            _column("code", _text, "short code of the reason"),
            _column("message", _text, "explanation in one line"),
        ]
    ),
}
SCHEMAS["failures"] = SCHEMAS["warnings"].set(
    0, _column("id", _text, "identifier of the scene or asset, which could not be used")
)
SCHEMAS["rejected"] = (
    SCHEMAS["scenes"]
    .append(
        _column(
            "code",
            _text,
            "code of the rejection: rejected where the acceptance condition is not met, else the code of the failure",
        )
    )
    .append(_column("reason", _text, "reason for the rejection in one line"))
)


def _versioned(name: str, schema: pa.Schema) -> pa.Schema:
    return schema.with_metadata({"stable_data.table": name, "stable_data.version": str(TABLE_VERSION)})


SCHEMAS = {name: _versioned(name, schema) for name, schema in SCHEMAS.items()}
"""Name of a table -> its schema."""

_PLACE = ("table_type", "table_size", "restricted_zone")
REQUIRED: dict[str, tuple[str, ...]] = {
    **{name: tuple(schema.names[:1]) for name, schema in SCHEMAS.items()},
    "scenes": ("scene_id", *_PLACE, "objects"),
    "rejected": ("scene_id", *_PLACE, "objects"),
    "samples": ("scene_id", *_PLACE, "stage", "objects_in", "objects_out"),
    "edits": ("edit_id", "scene_id", *_PLACE, "kind", "instruction", "objects_in", "objects_out", "removed"),
    "turns": ("scene_id", "turn"),
    "settled": ("scene_id", "poses"),
    "sdf": tuple(SCHEMAS["sdf"].names[:7]),
    "features": ("asset_id", "aspect", "tilt_quat_xyzw", "feature", "encoder_fingerprint"),
    "meshes": ("asset_id", "glb", "sha256"),
}
"""Name of a table -> the columns without which its rows say nothing. Any other column may be missing: it reads as null."""


def add_table(name: str, schema: pa.Schema) -> None:
    """Makes a table of a job of one's own known to this process.

    Args:
        name: Its name.
        schema: Its columns.

    Raises:
        ConfigError: The name is that of another table (``table_known``).
    """
    added = _versioned(name, schema)
    if not SCHEMAS.setdefault(name, added).equals(added):
        raise ConfigError(f"table {name} has other columns, expected a name that no table has; choose another", "table_known")
    REQUIRED.setdefault(name, tuple(schema.names[:1]))


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


def check_schema(schema: pa.Schema, table: str, where: str) -> None:
    """Refuses a table that cannot be read as one of the current version.

    Args:
        schema: Of a file of the table.
        table: Name in SCHEMAS.
        where: The file or table, for the message.

    Raises:
        ConfigError: Its version is not TABLE_VERSION (``table_version``), or it has no column of a REQUIRED name
            (``column_missing``).
    """
    found = (schema.metadata or {}).get(b"stable_data.version", b"none").decode()
    if found != str(TABLE_VERSION):
        remedy = (
            "install the version of stable-data that wrote it, or a newer one"
            if found.isdigit() and int(found) > TABLE_VERSION
            else "run the job again into a new folder, or read it with the version of stable-data that wrote it"
        )
        raise ConfigError(f"{where}: written as table version {found}, expected {TABLE_VERSION}; {remedy}", "table_version")
    missing = [name for name in REQUIRED[table] if name not in schema.names]
    if missing:
        raise ConfigError(
            f"{where}: has no column {', '.join(missing)}, expected it in every table {table}; run the job again into a new folder",
            "column_missing",
        )


def add_schema_metadata(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """A table with the columns of a schema, in its order and types; columns and fields that the table lacks are null."""
    columns = [
        table[column.name].cast(column.type) if column.name in table.column_names else pa.nulls(len(table), column.type)
        for column in schema
    ]
    return pa.Table.from_arrays(columns, schema=schema)


def missing_columns(found: Iterable[pa.Field], expected: Iterable[pa.Field]) -> list[str]:
    """Names of the columns, and dotted names of the fields of structs, that are expected and not found."""
    types, names = {column.name: column.type for column in found}, list[str]()
    for column in expected:
        if column.name not in types:
            names.append(column.name)
        else:
            names += (f"{column.name}.{name}" for name in missing_columns(_struct(types[column.name]), _struct(column.type)))
    return names


def _struct(type_: pa.DataType) -> Sequence[pa.Field]:
    """The fields of a struct or of a list of structs; none of another type."""
    while pa.types.is_list(type_):
        type_ = type_.value_type
    return list(type_) if pa.types.is_struct(type_) else []


def warn_of_missing_columns(where: str, table: str, missing: Iterable[str], condition: Iterable[str] = ()) -> None:
    """Says in one line which columns a run lacks because it was made before they existed; says nothing where it lacks none.

    Args:
        where: The run.
        table: Name in SCHEMAS.
        missing: What :func:`missing_columns` gives.
        condition: Columns that a condition on the rows names.
    """
    missing = list(dict.fromkeys(missing))
    if not missing:
        return
    message = f"{where}: table {table} was written before {', '.join(missing)} existed; they are read as null (unknown)"
    unknown = [name for name in dict.fromkeys(condition) if name in missing]
    if unknown:
        message += (
            f"; the condition names {', '.join(unknown)}, and unknown is not a pass: "
            f'run the job again into a new folder, or write "{unknown[0]} is None or ..."'
        )
    warnings.warn(message, MissingColumnsWarning, stacklevel=3)


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
