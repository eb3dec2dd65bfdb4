"""What holds of the columns of every table, whatever the run."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from stable_data.scene import RelationKind, Stage
from stable_data.storage.row_groups import SPLITS
from stable_data.storage.schemas import REQUIRED, SCHEMAS


@dataclass(frozen=True, slots=True)
class ColumnRules:
    """What holds of the columns of a table. A dot leads to a field of a struct, or of the structs of a list.

    Attributes:
        given: Columns without null; a field of a struct that is null itself is not meant.
        lengths: List columns with a fixed number of elements.
        words: Columns with these values alone, or null.
        shares: Columns with numbers from 0 to 1, or null.
        counts: Columns with numbers from 0, or null.
        units: Columns with unit quaternions.
    """

    given: tuple[str, ...]
    lengths: Mapping[str, int] = field(default_factory=dict)
    words: Mapping[str, frozenset[str]] = field(default_factory=dict)
    shares: tuple[str, ...] = ()
    counts: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


def _below(name: str, *fields: str) -> tuple[str, ...]:
    return tuple(f"{name}.{each}" for each in fields)


_OBJECT = ("instance", "category", "description", "position", "yaw", "tilt_quat_xyzw", "size")
_OBJECT_LENGTHS = {"position": 3, "tilt_quat_xyzw": 4, "scale": 3, "size": 3}
_POSE = ("instance", "position", "yaw")
_TASK = (
    *_below("task", "environment", "task", "goal", "action_sequence", "objects_cluster", "task_objects", "relations", "origin"),
    *_below("task.relations", "subject", "kind", "target"),
    *_below("task.conditions", "subject", "kind", "target", "is_negated"),
)
_HEAD = ("scene_id", "table_type", "table_size")
_HEAD_LENGTHS = {"table_size": 2, "restricted_zone": 4}
_RELATIONS = frozenset(map(str, RelationKind))
_STAGES = frozenset(map(str, Stage))
_SPLITS = {"split": frozenset(SPLITS)}
_SOLVED = frozenset({"start", "flow", "refine", "certify", "post_processing"})
_CARD_GIVEN = ("num_objects", "num_tilted", "num_without_mesh", "num_unknown_pairs", "num_collisions", "table_penetration_mm")
_CARD_SHARES = (
    *("oc", "oc_0mm", "oc_1mm", "oc_10mm", "oc_sdf", "float_rate", "float_gap", "out_of_bounds_rate", "distractor_rate"),
    *("relations_kept_on_in", "relations_kept_directional", "awt", "aws", "awt_annotated", "aws_graph"),
    *("awt_understood", "aws_understood"),
)
_CARD_COUNTS = (
    *("num_objects", "num_stacked", "num_contained", "num_tilted", "num_without_mesh", "num_unknown_pairs", "num_collisions"),
    *("max_penetration_mm", "table_penetration_mm", "max_gap_mm", "move_mean_mm", "move_max_mm", "turn_max_deg"),
    *("engine_penetration_mm", "settle_move_max_mm", "settle_turn_max_deg", "drift_mm", "jitter_mm"),
)


def _with_objects(*columns: str) -> tuple[tuple[str, ...], dict[str, int], dict[str, frozenset[str]], tuple[str, ...]]:
    """The rules of columns that are lists of objects: given, lengths, words, units."""
    given = tuple(name for column in columns for name in (column, *_below(column, *_OBJECT)))
    lengths = {f"{column}.{name}": count for column in columns for name, count in _OBJECT_LENGTHS.items()}
    words = {f"{column}.stage": _STAGES for column in columns}
    return given, lengths, words, tuple(f"{column}.tilt_quat_xyzw" for column in columns)


def _cards(*names: str) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """The rules of columns that are metric cards: given, shares, counts."""
    found = [tuple(f"{name}.{each}" for name in names for each in of) for of in (_CARD_GIVEN, _CARD_SHARES, _CARD_COUNTS)]
    return found[0], found[1], found[2]


def _scene_rules() -> ColumnRules:
    given, lengths, words, units = _with_objects("objects")
    return ColumnRules(
        given=(
            *(*_HEAD, *given, *_TASK, *_CARD_GIVEN, "source", "relations", "pairs", "verdicts"),
            *_below("relations", "subject", "kind", "target"),
            *_below("pairs", "first", "second"),
            *_below("verdicts", "instance", "supports", "table_penetration_mm", "has_mesh"),
            *_below("reach", "instance", "role", "reachable"),
            *_below("reach.blocked_by", "name", "count"),
        ),
        lengths={**_HEAD_LENGTHS, **lengths, "surface.origin": 3},
        words={
            **(words | _SPLITS),
            "relations.kind": _RELATIONS,
            "task.relations.kind": _RELATIONS,
            "reach.role": frozenset({"grasp", "target", "other"}),
            "varied": frozenset({"layout", "assets", "task", "clutter"}),
        },
        shares=(*_CARD_SHARES, "stable_share"),
        counts=(*_CARD_COUNTS, "verdicts.table_penetration_mm", "verdicts.gap_mm", "pairs.penetration_mm", "num_varied"),
        units=units,
    )


def _rules() -> dict[str, ColumnRules]:
    scenes = _scene_rules()
    in_out = _with_objects("objects_in", "objects_out")
    of_turns, of_corrections = _cards("card_before", "card_after"), _cards("card_before", "card_raw", "card_after")
    notices = ColumnRules(("id", "step", "code", "message"))
    return {
        "scenes": scenes,
        "rejected": ColumnRules(
            (*scenes.given, "code", "reason"), scenes.lengths, scenes.words, scenes.shares, scenes.counts, scenes.units
        ),
        "corrections": ColumnRules(
            (
                *("scene_id", "status", "reason", "start", "dropped", *_below("dropped", "instance", "reason")),
                *(*_below("start", *_POSE), *_below("raw", *_POSE), *of_corrections[0]),
            ),
            {"start.position": 3, "raw.position": 3},
            {
                "status": frozenset({"certified", "dropped", "infeasible", "unclean", "unknown"}),
                "solved_by": _SOLVED,
            },
            of_corrections[1],
            (
                *(*of_corrections[2], "on_in_held", "on_in_kept", "asked_broken", "asked_restored"),
                *("directional_held", "directional_kept"),
            ),
        ),
        "turns": ColumnRules(
            (
                *("scene_id", "turn", "stage", "tries", "refused", "unmatched"),
                *("code", "reason", "dropped", *_below("dropped", "instance", "reason")),
                *(*_below("coarse", *_POSE), *_below("corrected", *_POSE), *of_turns[0]),
            ),
            {"coarse.position": 3, "corrected.position": 3},
            {"stage": _STAGES | {"whole"}, "solved_by": _SOLVED},
            of_turns[1],
            (*of_turns[2], "turn", "tries", "prompt_tokens", "reply_tokens", "cost"),
        ),
        "settled": ColumnRules(
            ("scene_id", "poses", *_below("poses", "instance", "position", "quat_xyzw")),
            {"poses.position": 3, "poses.quat_xyzw": 4},
            units=("poses.quat_xyzw",),
        ),
        "grasps": ColumnRules(
            tuple(SCHEMAS["grasps"].names),
            {"position": 3, "quat_xyzw": 4},
            {"outcome": frozenset({"held", "missed", "slipped", "disturbed", "diverged"})},
            counts=("number", "width_m", "opening_m"),
            units=("quat_xyzw",),
        ),
        "ratings": ColumnRules(
            ("scene_id", "judge", "judge_version", "code", "reason", "tries"),
            counts=("tries", "prompt_tokens", "reply_tokens", "cost"),
        ),
        "samples": ColumnRules(
            (*_HEAD, *_TASK, "task", "stage", *in_out[0]),
            _HEAD_LENGTHS | in_out[1],
            _SPLITS | in_out[2] | {"stage": _STAGES, "task.relations.kind": _RELATIONS},
            units=in_out[3],
        ),
        "edits": ColumnRules(
            ("edit_id", *_HEAD, "kind", "instruction", "removed", *in_out[0]),
            _HEAD_LENGTHS | in_out[1],
            _SPLITS | in_out[2],
            units=in_out[3],
        ),
        "assets": ColumnRules(
            (
                *("asset_id", "category", "description", "extents", "resting_tilts", "report", "points", "normals"),
                *_below("resting_tilts", "tilt_quat_xyzw", "count"),
                *_below("report", *(each.name for each in SCHEMAS["assets"].field("report").type)),
            ),
            {
                "extents": 3,
                "typical_scale": 3,
                "center_of_mass": 3,
                "inertia_per_mass": 9,
                "inertia": 9,
                "friction": 3,
                "front": 3,
            }
            | {"resting_tilts.tilt_quat_xyzw": 4},
            shares=("scale_confidence",),
            counts=("mass", "friction", "resting_tilts.count", "report.num_vertices", "report.num_faces", "report.area"),
            units=("resting_tilts.tilt_quat_xyzw",),
        ),
        "sdf": ColumnRules(
            tuple(name for name in SCHEMAS["sdf"].names if name not in ("sdf_agreement", "sign_disagreement")),
            {"aspect": 3, "shape": 3, "origin": 3},
            shares=("sign_error", "sdf_agreement", "sign_disagreement"),
            counts=("spacing", "extent", "shell_thickness", "mean_error", "max_error", "far_error"),
        ),
        "features": ColumnRules(
            tuple(SCHEMAS["features"].names),
            {"aspect": 3, "tilt_quat_xyzw": 4, "feature": 64, "log_extents": 3},
            units=("tilt_quat_xyzw",),
        ),
        "meshes": ColumnRules(
            ("asset_id", "glb", "sha256", *_below("parts", "vertices", "faces")), counts=("look_distance", "hull_distance")
        ),
        "measured": ColumnRules(tuple(SCHEMAS["measured"].names), {"extents": 3}),
        "textures": ColumnRules(
            tuple(SCHEMAS["textures"].names), words={"mime": frozenset({"image/png", "image/jpeg"})}, counts=("width", "height")
        ),
        "episodes": ColumnRules(
            tuple(n for n in SCHEMAS["episodes"].names if n in REQUIRED["episodes"] and n != "reason"),
            {"image_size": 2},
            _SPLITS,
            counts=("number", "seed", "num_steps", "fps"),
        ),
        "views": ColumnRules(
            ("scene_id", "extractor", "extractor_fingerprint", "views", *_below("views", "view", "picture", "features"))
        ),
        "warnings": notices,
        "failures": notices,
    }


RULES: Mapping[str, ColumnRules] = _rules()
"""Name of a table -> what holds of its columns."""
