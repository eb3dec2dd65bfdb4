"""The tables of a run: one Arrow schema each; the metadata of each column give its unit and meaning.

Nested data are plain lists and structs, so that pyarrow, polars, duckdb, Ray Data and Hugging Face ``datasets`` read them
without this library. ``table_rows`` converts objects to rows and back; ``schema_checks`` checks files against the schemas.
"""

from dataclasses import fields
from typing import Any, TypeAlias, get_args, get_type_hints

import pyarrow as pa

from stable_data.errors import ConfigError
from stable_data.metrics.card import MetricCard
from stable_data.metrics.judge_columns import FURTHER, FURTHER_COLUMNS, JUDGES, SHARE, verdict_columns
from stable_data.metrics.reach_columns import GRASPABLE, REACH_COLUMNS, REACHABLE, REASON
from stable_data.rating.criteria import CRITERIA, HIGHEST, LOWEST
from stable_data.rating.rating import PASS_MARK

TABLE_VERSION = 3
"""Increases if a column changes its name, type or meaning, but not for a new column that may be null: older tables are read
with null there, which means unknown."""

Row: TypeAlias = dict[str, Any]

_text, _number, _count, _truth = pa.string(), pa.float64(), pa.int64(), pa.bool_()
_numbers, _texts = pa.list_(_number), pa.list_(_text)
_floats, _halves, _integers = pa.list_(pa.float32()), pa.list_(pa.float16()), pa.list_(pa.int32())

RELATION = pa.struct([("subject", _text), ("kind", _text), ("target", _text)])
CONDITION = pa.struct([("subject", _text), ("kind", _text), ("target", _text), ("distance", _number), ("is_negated", _truth)])

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
        ("conditions", pa.list_(CONDITION)),
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
OBJECT_REACH = pa.struct(
    [
        ("instance", _text),
        ("role", _text),
        ("reachable", _truth),
        ("graspable", _truth),
        ("num_candidates", _count),
        ("num_reachable", _count),
        ("num_out_of_reach", _count),
        ("blocked_by", pa.list_(pa.struct([("name", _text), ("count", _count)]))),
        ("num_tried", _count),
        ("num_grasps", _count),
        ("reason", _text),
    ]
)


def _column(name: str, type_: pa.DataType, meaning: str, unit: str = "") -> pa.Field:
    return pa.field(name, type_, metadata={"meaning": meaning, "unit": unit})


SURFACE = pa.struct(
    [
        ("support", _text),
        ("surface", _text),
        ("origin", _numbers),
        ("yaw", _number),
        ("asset_id", _text),
        ("clearance", _number),
    ]
)
DROPPED = pa.struct([("instance", _text), ("reason", _text)])
POSE = pa.struct([("instance", _text), ("position", _numbers), ("yaw", _number)])
VIEW = pa.struct([("view", _text), ("picture", pa.binary()), ("features", _floats)])
CAMERA = pa.struct([("camera", _text), ("images", pa.list_(pa.binary()))])

_CARD_TYPES: dict[type, pa.DataType] = {int: _count, float: _number, bool: _truth}


def _card_columns() -> list[pa.Field]:
    """One column for each field of the metric card."""
    types = get_type_hints(MetricCard)
    columns = []
    for f in fields(MetricCard):
        base = (get_args(types[f.name]) or (types[f.name],))[0]  # the X of "X | None": every column may be null
        columns.append(_column(f.name, _CARD_TYPES[base], f.metadata["meaning"], f.metadata["unit"]))
    return columns


def _judge_columns() -> list[pa.Field]:
    """The columns of the judges other than MuJoCo, and of robust rest."""
    columns = []
    for name in FURTHER:
        stable, move, turn = verdict_columns(name)
        engine = JUDGES[name].engine
        columns += [
            _column(
                stable,
                _truth,
                f"stable as {engine} simulates the scene, by the same limits; null where not simulated or unknown",
            ),
            _column(move, _number, f"settle_move_max_mm as {engine} simulates the scene; null where not simulated", "mm"),
            _column(turn, _number, f"settle_turn_max_deg as {engine} simulates the scene; null where not simulated", "deg"),
        ]
    share = "share of the repetitions of the verdict with other frictions, masses, steps and a nudge that find the scene stable; null "
    return [*columns, _column(SHARE, _number, f"{share}where not repeated or all unknown")]


def _reach_columns() -> list[pa.Field]:
    """The columns of what a robot reaches and holds."""
    verdict = (
        "true if the robot reaches, without touching anything else, {}; null where no robot was asked, the goal is unknown{}"
    )
    return [
        _column("robot", _text, "the robot of the columns below; null where no robot was asked"),
        _column(
            "robot_mount",
            _text,
            "where it stands: an edge of the table, and the share of its length from its left or front end",
        ),
        _column("task_kind", _text, "kind of the task's goal, such as pick or place_on; null if the goal is unknown"),
        _column(
            REACHABLE,
            _truth,
            verdict.format("a grasp of each object that the task picks up, and from above a place for it", ""),
        ),
        _column(
            GRASPABLE,
            _truth,
            verdict.format(
                "what task_reachable asks for, and a grasp of each object held in a simulated trial", ", or nothing was tried"
            ),
        ),
        _column(REASON, _text, "why not, in one line of codes with details; null if nothing is wrong"),
        _column(
            "reach",
            pa.list_(OBJECT_REACH),
            "the objects that were looked at. role: grasp (the task picks it up), target (reached from above) or other; num_candidates: "
            "poses of the hand that its mesh offers; num_reachable: those that the arm reaches freely; num_out_of_reach: those that it "
            "cannot reach; blocked_by: what is in the way of the others; num_tried, num_grasps: grasps that were tried, and that held",
        ),
    ]


def _rating_columns() -> list[pa.Field]:
    """The columns of a rating by the five criteria."""
    scores = [_column(c.key, _number, f"score by {c.name}, {LOWEST:g} to {HIGHEST:g}; null where unknown") for c in CRITERIA]
    rationales = [
        _column(f"{c.key}_rationale", _text, f"why {c.key} is what it is, or is unknown; null where nobody was asked")
        for c in CRITERIA
    ]
    return [
        *scores,
        _column("average", _number, "mean of the five scores; null if one of them is unknown"),
        _column("clean", _truth, "whether the scene is clean, by the exact audit; null where unknown"),
        _column(
            "quality_pass",
            _truth,
            f"whether the average is above {PASS_MARK:g} and the scene is clean; null if one of the two is unknown",
        ),
        *rationales,
    ]


CARD = pa.struct([(column.name, column.type) for column in _card_columns()])

_scene_head = [
    _column("scene_id", _text, "identifier of the scene, unique in the run"),
    _column("split", _text, "train, validation or test (90/5/5 % of near-duplicate groups), or unseen (held-out table types)"),
    _column("table_type", _text, "type of the table, such as office_table"),
    _column("table_size", _numbers, "table extents along x and y; the origin is the near-left corner, the top is z = 0", "m"),
    _column(
        "restricted_zone", _numbers, "x_min, x_max, y_min, y_max of the area where no object may stand; null without one", "m"
    ),
    _column("task", TASK, "task info with task objects and the relations that the instruction states; null without a task"),
]

_dropped = _column("dropped", pa.list_(DROPPED), "objects that were removed because they could not be placed, with the reason")
_solved_by = _column(
    "solved_by",
    _text,
    "step that made the scene clean: start (it was), flow, refine, certify or post_processing; null if it is not clean",
)
_aspect = _column("aspect", _numbers, "scale divided by its largest component, rounded to steps of 5 %")

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
            _column(
                "fixed",
                _texts,
                "instances of the surroundings: obstacles that do not move and are not judged; null without any",
            ),
            _column(
                "surface",
                SURFACE,
                "the surface of a support that is the table top: name of the support, which scenes on one piece share, name of the "
                "surface, origin and yaw of the scene's frame in that of the support, mesh of the support, free height above it; null "
                "for a table of its own",
                "m, rad",
            ),
            *_card_columns(),
            *_judge_columns(),
            *_reach_columns(),
            _column(
                "pairs",
                pa.list_(PAIR),
                "object pairs that touch or contain each other, with their penetration (null if unknown); all other pairs are apart",
                "mm",
            ),
            _column(
                "verdicts", pa.list_(VERDICT), "audit verdict on each object, in the order of objects, but for fixed ones", "mm"
            ),
            _column("layout_path", _text, "path of the layout file, relative to the dataset"),
            _column("layout_sha256", _text, "SHA-256 of the layout file"),
            _column(
                "duplicate_group",
                _text,
                "near-duplicate group: scenes with the same table type and the same assets have the same group and split",
            ),
            _column("source_json", _text, "top-level entries of the layout file as JSON, for a lossless round trip"),
            _column("variant_of", _text, "scene_id of the scene that this one varies; null if it is no variant"),
            _column("varied", _text, "what differs from that scene: layout, assets, task or clutter; null if it is no variant"),
            _column(
                "num_varied",
                _count,
                "number of objects that differ from that scene: moved or turned (layout), with another asset (assets), new (clutter); "
                "0 for task; null if it is no variant",
            ),
        ]
    ),
    "corrections": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene; infeasible scenes are also in failures"),
            _column(
                "status",
                _text,
                "certified, dropped (clean after objects were removed), infeasible, unclean (not certified), or unknown (a mesh is "
                "missing)",
            ),
            _column("reason", _text, "reason for a status other than certified; empty if certified"),
            _solved_by,
            _dropped,
            _column("start", pa.list_(POSE), "input pose of each object, including removed objects", "m, rad"),
            _column(
                "raw",
                pa.list_(POSE),
                "object poses after the flow and before certification; null without a flow, or if its poses are not finite",
                "m, rad",
            ),
            _column("card_before", CARD, "metric card of the input scene"),
            _column(
                "card_raw",
                CARD,
                "metric card after the flow and before certification; null without a flow, or if its poses are not finite",
            ),
            _column("card_after", CARD, "metric card of the corrected scene; null if infeasible"),
            _column("on_in_held", _count, "number of on and in relations that held in the input"),
            _column("on_in_kept", _count, "number of relations of on_in_held that also hold after the correction"),
            _column("asked_broken", _count, "number of on and in relations of the scene graph that did not hold in the input"),
            _column("asked_restored", _count, "number of relations of asked_broken that hold after the correction"),
            _column("directional_held", _count, "number of directional relations that held in the input"),
            _column("directional_kept", _count, "number of relations of directional_held that also hold after the correction"),
        ]
    ),
    "turns": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene, which may be accepted or rejected"),
            _column("turn", _count, "index of the turn in its scene, from 0"),
            _column("stage", _text, "stage that was requested: task (O^t), important (O^B), secondary (O^b) or whole"),
            _column("tries", _count, "number of requests to the reasoner"),
            _column("refused", pa.list_(_texts), "error codes of each rejected reply, one list for each reply"),
            _column("reply", _text, "accepted reply, in the form that later prompts repeat; null without an accepted reply"),
            _column(
                "prompt_tokens", _count, "number of tokens in the prompts of the turn; null if the engine did not count them"
            ),
            _column(
                "reply_tokens", _count, "number of tokens in the replies of the turn; null if the engine did not count them"
            ),
            _column("cost", _number, "cost of all requests, in the currency of the engine's prices; null if it is not known"),
            _column("unmatched", _texts, "instances without a matching asset"),
            _column("coarse", pa.list_(POSE), "object poses before the correction; null without a correction", "m, rad"),
            _column("corrected", pa.list_(POSE), "object poses after the correction; null if none or infeasible", "m, rad"),
            _solved_by,
            _column("card_before", CARD, "metric card before the correction; null without a correction"),
            _column("card_after", CARD, "metric card after the correction; null without a correction or if it is infeasible"),
            _dropped,
            _column("code", _text, "code of the rejection; empty if the proposal was accepted"),
            _column("reason", _text, "reason for the rejection in one line; empty if the proposal was accepted"),
        ]
    ),
    "settled": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene"),
            _column(
                "poses",
                pa.list_(pa.struct([("instance", _text), ("position", _numbers), ("quat_xyzw", _numbers)])),
                "object poses after settling: box centre in the world frame, and rotation from the yaw frame at yaw 0",
                "m",
            ),
        ]
    ),
    "grasps": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene, which may be accepted or rejected"),
            _column("instance", _text, "the object"),
            _column("number", _count, "rank among the reachable grasps of the object, from 0"),
            _column("robot", _text, "the robot; its place is in the column robot_mount of the scene"),
            _column(
                "position",
                _numbers,
                "origin of the tool frame, between the finger tips, at the grasp, in the frame of the scene; the objects are "
                "where the earlier steps of the task leave them",
                "m",
            ),
            _column(
                "quat_xyzw",
                _numbers,
                "rotation of the tool frame: its z points out of the hand, its y is the direction in which the fingers close",
            ),
            _column("width_m", _number, "width of the object between the fingers", "m"),
            _column("opening_m", _number, "distance of the fingers on the way to the grasp", "m"),
            _column(
                "score", _number, "quality of the grasp from its geometry, larger is better; grasps are tried in its order"
            ),
            _column(
                "outcome",
                _text,
                "outcome of the simulated trial: held (lifted, still in the hand), missed, slipped, disturbed (another object "
                "moved) or diverged",
            ),
        ]
    ),
    "ratings": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene"),
            _column("judge", _text, "who rated it: symbolic (rules), or the name of an engine such as openai:gpt-4o"),
            _column(
                "judge_version", _text, "hash of the prompt, or of the rules; ratings of different versions are not compared"
            ),
            *_rating_columns(),
            _column("code", _text, "short reason why the average is unknown; empty if it is known"),
            _column("reason", _text, "the same in one line; empty if it is known"),
            _column("tries", _count, "how often a model was asked"),
            _column("prompt_tokens", _count, "number of tokens that it read; null if it did not count them"),
            _column("reply_tokens", _count, "number of tokens that it wrote; null if it did not count them"),
            _column("cost", _number, "cost of all requests, in the currency of the engine's prices; null if it is not known"),
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
            _column("objects_in", pa.list_(SAMPLE_OBJECT), "objects before the edit, in the order of the scene", "m, rad"),
            _column("objects_out", pa.list_(SAMPLE_OBJECT), "new objects, and changed objects with their old name", "m, rad"),
            _column("removed", _texts, "instances of objects_in that the edit removes"),
        ]
    ),
    "assets": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset, unique in the run"),
            _column("category", _text, "category of the asset"),
            _column("description", _text, "short description"),
            _column("caption", _text, "detailed caption"),
            _column("licence", _text, "licence; null if unknown"),
            _column("source", _text, "origin of the asset"),
            _column("extents", _numbers, "extents of the mesh's bounding box, z up", "mesh units"),
            _column(
                "typical_scale",
                _numbers,
                "median scale in the scenes, null if no scene has the asset; with mass_source the scale that the import gave it",
                "m per mesh unit",
            ),
            _column("resting_tilts", pa.list_(RESTING_TILT), "tilts of the asset in the scenes, most frequent first"),
            _column("is_container", _truth, "true if other objects can be placed inside; null if unknown"),
            _column("on_table", _truth, "annotation: true if the asset belongs on a table; null if unknown"),
            _column("mark_deletion", _truth, "annotation: true if annotators marked the asset for deletion; null if unknown"),
            _column("is_composite", _truth, "annotation: true if the mesh contains several objects; null if unknown"),
            _column("report", MESH_REPORT, "properties of the mesh and the repairs that were made", "mesh units"),
            _column(
                "mass", _number, "mass from the annotation, or with mass_source at the typical scale; null if unknown", "kg"
            ),
            _column("volume", _number, "enclosed volume at the typical scale", "m^3"),
            _column("center_of_mass", _numbers, "centre of mass relative to the box centre, at the typical scale", "m"),
            _column(
                "inertia_per_mass",
                _numbers,
                "inertia tensor divided by the mass, 3 x 3 about the centre of mass, row-major, at the typical scale",
                "m^2",
            ),
            _column("points", _floats, "surface points (P, 3), in farthest-point order, row-major", "mesh units"),
            _column("normals", _floats, "outward surface normals (P, 3) at the points, row-major"),
            _column("text_embedding", _floats, "text embedding of the dataset, of unit length; null if it has none"),
            _column("mesh_sha256", _text, "SHA-256 of the mesh file"),
            _column("author", _text, "who made the asset; null if unknown"),
            _column("source_url", _text, "where the asset comes from; null if unknown"),
            _column("source_set", _text, "set that the asset belongs to, such as YCB; null if unknown"),
            _column("source_path", _text, "main file of the asset in its source folder"),
            _column("licence_text", _text, "licence as the source states it"),
            _column(
                "licence_where", _text, "where the source states the licence: a file, the manifest, or an option of the import"
            ),
            _column(
                "scale_source",
                _text,
                "what the scale rests on: given, stated_size, category, set (the other assets of its set), or option",
            ),
            _column("scale_inferred", _truth, "true if the scale is estimated; null if no import made the asset"),
            _column(
                "scale_confidence",
                _number,
                "estimated probability that the scale is right within a factor of 1.5; 1 if it is given",
            ),
            _column("size_low", _number, "smallest longest side that the asset may have in a scene", "m"),
            _column("size_high", _number, "largest longest side that the asset may have in a scene", "m"),
            _column(
                "category_source", _text, "what the category rests on: given, name, or encoder (the nearest known category)"
            ),
            _column("description_source", _text, "what the description rests on: given or name"),
            _column(
                "mass_source",
                _text,
                "what the mass rests on: given, material, category, or default; null if no import made the asset",
            ),
            _column(
                "inertia",
                _numbers,
                "inertia tensor that the source gives, 3 x 3 about center_of_mass, row-major, axes of the mesh, at the typical scale; null "
                "if it gives none",
                "kg m^2",
            ),
            _column(
                "friction",
                _numbers,
                "sliding, torsional and rolling friction as MuJoCo defines them; null if unknown",
                "1, m, m",
            ),
            _column("material", _text, "main material; null if unknown"),
            _column("front", _numbers, "unit vector of the mesh that faces the user; null if unknown"),
            _column(
                "rest_source", _text, "what the resting tilts rest on: given, up_axis, or physics; null if scenes show them"
            ),
            _column("is_graspable", _truth, "true if the smallest side of the box is at most 8 cm; null if unknown"),
            _column("is_static", _truth, "true if the source fixes the asset to the world, as furniture; null if unknown"),
            _column(
                "geometry_hash", _text, "hash of the shape, equal for copies of one mesh whatever their order, scale and place"
            ),
            _column("sentence_embedding", _halves, "embedding of the asset's sentence for retrieval, of unit length"),
            _column("sentence_encoder", _text, "fingerprint of the encoder of sentence_embedding"),
        ]
    ),
    "sdf": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset"),
            _aspect,
            _column("values", pa.list_(pa.float16()), "signed distance at the nodes, negative inside, x slowest", "extent"),
            _column("shape", _integers, "number of grid nodes along x, y and z"),
            _column("origin", _numbers, "position of the first grid node", "extent"),
            _column("spacing", _number, "distance between neighbouring grid nodes", "extent"),
            _column("extent", _number, "length unit of the grid: largest extent of the mesh at its aspect", "mesh units"),
            _column("shell_thickness", _number, "thickness of the shell around an open surface; 0 for a solid", "extent"),
            _column("wall_thickness", _number, "estimated wall thickness of the mesh", "extent"),
            _column("mean_error", _number, "measured mean error within one spacing of the surface", "extent"),
            _column("max_error", _number, "measured maximum error within one spacing of the surface", "extent"),
            _column("far_error", _number, "measured maximum error in the rest of the grid", "extent"),
            _column("sign_error", _number, "measured share of wrong signs at half a spacing or more from the surface"),
            _column(
                "sdf_agreement",
                _number,
                "share of random points at which pysdf's distance differs by less than a spacing; null for sheets and without pysdf",
            ),
            _column(
                "sign_disagreement",
                _number,
                "share of random points, farther than a spacing from the surface, at which pysdf's sign differs; null likewise",
            ),
        ]
    ),
    "features": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset"),
            _aspect,
            _column(
                "tilt_quat_xyzw",
                _numbers,
                "rotation before yaw; tilts within about one degree share one row, which has the first of them in the scenes",
            ),
            _column("feature", _floats, "64-d feature of the normalised point cloud"),
            _column(
                "log_extents",
                _numbers,
                "natural logarithm of the box extents in the yaw frame, in metres, at the median scale of the objects of this row",
            ),
            _column(
                "encoder_fingerprint", _text, "fingerprint of the encoder's weights; a run contains features of one encoder"
            ),
        ]
    ),
    "meshes": pa.schema(
        [
            _column("asset_id", _text, "identifier of the asset"),
            _column("glb", pa.binary(), "repaired mesh as binary glTF, y up, with at most eight face colours", "mesh units"),
            _column("parts", pa.list_(PART), "convex decomposition of the mesh, z up; null: not computed yet", "mesh units"),
            _column("parts_method", _text, "method of the convex decomposition; hull: one convex hull is used instead"),
            _column("parts_overfill_max", _number, "maximum distance by which the parts extend beyond the mesh", "mesh units"),
            _column(
                "parts_overfill_mean",
                _number,
                "mean distance by which the parts extend beyond the mesh, over the parts' surface",
                "mesh units",
            ),
            _column(
                "parts_uncovered_max", _number, "maximum distance by which the mesh extends beyond the parts", "mesh units"
            ),
            _column(
                "parts_uncovered_mean",
                _number,
                "mean distance by which the mesh extends beyond the parts, over the mesh surface",
                "mesh units",
            ),
            _column(
                "hull_distance", _number, "maximum distance by which the convex hull extends beyond the mesh", "mesh units"
            ),
            _column("sha256", _text, "SHA-256 of glb"),
            _column(
                "look",
                pa.binary(),
                "surface with materials and texture coordinates as binary glTF, y up, in the frame of glb; its images are the addresses "
                "texture:SHA-256 of the table textures; null: the face colours of glb are its look",
                "mesh units",
            ),
            _column(
                "look_distance",
                _number,
                "maximum distance by which look was moved when it was reduced; 0 if it was not",
                "mesh units",
            ),
            _column(
                "parts_source",
                _text,
                "where parts come from: given by the source, or computed; null if no import made the asset",
            ),
            _column("source_faces", _count, "triangles of the source; null if no import made the asset"),
            _column(
                "source_reduction",
                _number,
                "maximum distance between the mesh and the source; 0 if it was not reduced",
                "mesh units",
            ),
        ]
    ),
    "measured": pa.schema(
        [
            _column(
                "asset_id",
                _text,
                "identifier of an asset whose file states no unit; they give the unit of the set",
            ),
            _column("category", _text, "category of the asset"),
            _column("extents", _numbers, "extents of the asset's bounding box, z up", "units of the file"),
        ]
    ),
    "textures": pa.schema(
        [
            _column("sha256", _text, "SHA-256 of image"),
            _column("image", pa.binary(), "image file, decoded and encoded again, at most 1,024 pixels a side"),
            _column("mime", _text, "format of image: image/png or image/jpeg"),
            _column("width", _count, "width", "pixels"),
            _column("height", _count, "height", "pixels"),
        ]
    ),
    "episodes": pa.schema(
        [
            _column("episode_id", _text, "identifier of the episode, scene_id/number"),
            _column("scene_id", _text, "identifier of the scene; a scene may have several episodes"),
            _column("split", _text, "split of the scene; null if it has none"),
            _column("number", _count, "number of the episode of this scene, from 0"),
            _column("seed", _count, "seed of the episode"),
            _column("robot", _text, "name of the robot"),
            _column("task_kind", _text, "kind of the task, such as pick, place_on or stack"),
            _column("instruction", _text, "instruction of the task"),
            _column("success", _truth, "whether the task was done at the end"),
            _column("reason", _text, "why the task was not done; null if it was"),
            _column("num_steps", _count, "number of actions T"),
            _column("fps", _number, "actions a second", "1/s"),
            _column("control", _text, "meaning of an action, such as joint or ee"),
            _column("state_names", _texts, "names of the S numbers of a state of the robot"),
            _column("environment_state_names", _texts, "names of the E numbers of a state of the environment"),
            _column("action_names", _texts, "names of the A numbers of an action"),
            _column("states", _floats, "states of the robot before each action (T, S), row-major", "as state_names say"),
            _column(
                "environment_states",
                _floats,
                "states of the environment before each action (T, E), row-major",
                "as environment_state_names say",
            ),
            _column("actions", _floats, "actions (T, A), row-major", "as action_names say"),
            _column("rewards", _floats, "reward of each action (T)"),
            _column("instances", _texts, "names of the N objects of object_poses"),
            _column(
                "object_poses",
                _floats,
                "position and quaternion x, y, z, w of each object, before the first action and after each one (T + 1, N, 7), "
                "row-major, in the frame of the scene",
                "m",
            ),
            _column("image_size", pa.list_(_count), "height and width of the pictures; null without pictures", "pixels"),
            _column(
                "pictures",
                pa.list_(CAMERA),
                "pictures of each camera before each action, T PNG files of 8-bit RGB; null if they were not kept",
            ),
            _column("randomization", _text, "what the domain randomisation drew, as JSON; null without one"),
            _column("policy", _text, "name of the policy that acted; null: the scripted expert"),
            _column(
                "lead",
                _text,
                "name of the policy that acted before the first action; null: none, the episode begins at the reset",
            ),
            _column("asset_ids", _texts, "asset of each of the instances, empty for one that has none; null: not known"),
            _column("subjects", _texts, "instances that the steps of the goal act on; null: not known"),
        ]
    ),
    "views": pa.schema(
        [
            _column("scene_id", _text, "identifier of the scene; a scene that could not be drawn is in failures"),
            _column("extractor", _text, "name of what computed the features"),
            _column(
                "extractor_fingerprint", _text, "hash of all that determines the features; only equal ones can be compared"
            ),
            _column(
                "views",
                pa.list_(VIEW),
                "the pictures of the scene: view (front or perspective), the picture as a PNG file of 8-bit RGB, and its features (D)",
            ),
        ]
    ),
    "warnings": pa.schema(
        [
            _column("id", _text, "identifier of the scene or asset, which is in the run"),
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
            "code of the rejection: rejected if the acceptance condition is not met, else the code of the failure",
        )
    )
    .append(_column("reason", _text, "reason for the rejection in one line"))
)


def _versioned(name: str, schema: pa.Schema) -> pa.Schema:
    return schema.with_metadata({"stable_data.table": name, "stable_data.version": str(TABLE_VERSION)})


SCHEMAS = {name: _versioned(name, schema) for name, schema in SCHEMAS.items()}
"""Name of a table -> its schema."""

NONE_IF_NULL = frozenset(
    {"fixed", "surface", "task.conditions", "variant_of", "varied", "num_varied", *FURTHER_COLUMNS, *REACH_COLUMNS}
)
"""Columns of which null says that there is none, also in runs that are older than they are."""

_TABLETOP = ("table_type", "table_size", "restricted_zone")
REQUIRED: dict[str, tuple[str, ...]] = {
    **{name: tuple(schema.names[:1]) for name, schema in SCHEMAS.items()},
    "scenes": ("scene_id", *_TABLETOP, "objects"),
    "rejected": ("scene_id", *_TABLETOP, "objects"),
    "samples": ("scene_id", *_TABLETOP, "stage", "objects_in", "objects_out"),
    "edits": ("edit_id", "scene_id", *_TABLETOP, "kind", "instruction", "objects_in", "objects_out", "removed"),
    "turns": ("scene_id", "turn"),
    "settled": ("scene_id", "poses"),
    "ratings": ("scene_id", "judge", "judge_version"),
    "grasps": ("scene_id", "instance", "position", "quat_xyzw", "outcome"),
    "sdf": tuple(SCHEMAS["sdf"].names[:7]),
    "features": ("asset_id", "aspect", "tilt_quat_xyzw", "feature", "encoder_fingerprint"),
    "meshes": ("asset_id", "glb", "sha256"),
    "measured": ("asset_id", "category", "extents"),
    "textures": ("sha256", "image"),
    "episodes": tuple(
        name
        for name in SCHEMAS["episodes"].names
        if name not in ("split", "reason", "image_size", "pictures", "randomization", "policy", "lead", "asset_ids", "subjects")
    ),
}
"""Name of a table -> the columns that every file needs. Any other column may be missing: it is read as null."""


def add_table(name: str, schema: pa.Schema) -> None:
    """Adds the table of a custom job to SCHEMAS and REQUIRED in this process.

    Args:
        name: Name of the table.
        schema: Columns of the table; the first one is required.

    Raises:
        ConfigError: Another table has this name (``table_known``).
    """
    added = _versioned(name, schema)
    if not SCHEMAS.setdefault(name, added).equals(added):
        raise ConfigError(f"table {name} exists with other columns, expected a new name; choose another name", "table_known")
    REQUIRED.setdefault(name, tuple(schema.names[:1]))
