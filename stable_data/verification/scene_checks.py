"""Checks rows of ``scenes`` and ``rejected``: names within a scene, and every column that follows from others."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa

from stable_data.errors import SceneError, StableDataError
from stable_data.json_text import ReadLog
from stable_data.mesatask.dataset_split import SplitShares, split_of
from stable_data.mesatask.layout import ZONE, read_table
from stable_data.mesatask.near_duplicates import duplicate_group
from stable_data.metrics.card import add_counts
from stable_data.metrics.judge_columns import FURTHER, verdict_columns
from stable_data.metrics.reach_columns import GRASPABLE, REACHABLE
from stable_data.metrics.verdicts import audit_of_row
from stable_data.position_convention import has_size
from stable_data.rotations import rotated_extents
from stable_data.scene import TABLE, UPRIGHT, FloatArray, RelationKind, Scene, SceneObject, TaskInfo
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import VARIANT_COLUMNS, scene_from_row
from stable_data.verification.asset_checks import AssetFacts
from stable_data.verification.findings import Findings
from stable_data.verification.known_ids import KnownIds
from stable_data.verification.shard_files import ShardFile

_LIMITS = {"settle_move_max_mm": 10.0, "settle_turn_max_deg": 5.0, "drift_mm": 50.0}
"""Columns of MuJoCo's verdict -> their largest values in a stable scene (:mod:`stable_data.simulation.settling`)."""

_DERIVED = (
    *("num_objects", "num_stacked", "num_contained", "num_tilted", "num_without_mesh", "num_unknown_pairs", "num_collisions"),
    *("oc", "oc_0mm", "oc_1mm", "oc_10mm", "max_penetration_mm", "table_penetration_mm", "float_rate", "float_gap"),
    *("max_gap_mm", "out_of_bounds_rate", "clean"),
)
"""Columns that follow from the verdicts on objects and pairs, and from the relations."""

_OF_POSES = tuple(name for name in _DERIVED if name not in ("num_stacked", "num_contained"))
"""Those of them that follow from the poses of the objects alone."""

_LATER = frozenset({"float_gap"})
"""Those of them that are younger than the oldest runs: null, unknown, where the rows come from such a run."""

_NO_INSTANCES = frozenset({RelationKind.FACE_TO, RelationKind.IS_AT, RelationKind.EQUALLY_SPACED})
"""Relations whose target is no instance."""

UNRESOLVED = "assets without mesh"
"""Name of a set of :class:`KnownIds`: assets of objects that have no mesh, which need not be in the run."""


@dataclass(frozen=True, slots=True)
class SplitRule:
    """How the splits of the scenes of a run follow from their content.

    Attributes:
        shares: The shares of the splits.
        source: Only rows with this ``source`` follow it; None: all do.
    """

    shares: SplitShares
    source: str | None = None


class SceneCheck:
    """Checks rows of ``scenes`` or ``rejected``.

    Args:
        known: Ids of assets and meshes; ids of scenes are added by whoever reads the rows.
        facts: What the run says of its meshes.
        splits: How splits follow from scenes; None if the run does not say.
        findings: Where damage is noted.
        needs_assets: Whether the run must have the assets of its scenes; a corrected folder has them beside its tables, and a run
            that is not finished may not have them yet.
        is_finished: Whether the run is finished: then an asset of its tables is one of its own.
        may_be_older: Whether rows may come from a run that is older than some columns.
        unasked: Column that is null in every row -> the setting that would fill it.
    """

    def __init__(
        self,
        known: KnownIds,
        facts: AssetFacts,
        splits: SplitRule | None,
        findings: Findings,
        *,
        needs_assets: bool,
        may_be_older: bool,
        is_finished: bool = True,
        unasked: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._unasked = unasked
        self._known, self._facts, self._splits, self._findings = known, facts, splits, findings
        self._split_of_group: dict[str, str] = {}
        self._has_assets = is_finished and "assets" in known.there
        self._needs_assets, self._may_be_older = needs_assets, may_be_older

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            try:
                scene = scene_from_row(row)
                for what in self._faults(row, scene):
                    self._findings.damage(file.name, f"{scene.scene_id}: {what}", number)
            except (StableDataError, ValueError, TypeError, KeyError, ArithmeticError) as error:
                self._findings.damage(file.name, f"is no scene: {error or type(error).__name__}", number)

    def _faults(self, row: Row, scene: Scene) -> Iterator[str]:
        yield from names_faults(row, scene)
        names = [o.instance for o in scene.movable]
        if [verdict["instance"] for verdict in row["verdicts"] or ()] != names:
            yield "verdicts are not on its objects in their order, expected one for each"
        else:
            yield from derived_faults(row, scene, may_be_older=self._may_be_older)
        yield from rest_faults(row)
        yield from _table_faults(scene)
        for name, setting in self._unasked.items():
            if row.get(name) is not None:
                yield f"{name} is {row[name]!r:.60}, expected null: by the settings of the run, {setting} was not asked"
        mean, most = row.get("move_mean_mm"), row.get("move_max_mm")
        if (mean is None) != (most is None) or (mean is not None and most is not None and mean > most * (1 + 1e-9)):
            yield f"move_mean_mm is {mean}, expected at most move_max_mm, which is {most}"
        yield from self._split_faults(row, scene)
        yield from self._asset_faults(row, scene)
        if len({row.get(name) is None for name in VARIANT_COLUMNS if name in row}) > 1:
            yield f"{', '.join(VARIANT_COLUMNS)} are null in part, expected all or none"
        yield from _reach_faults(row, scene)

    def _split_faults(self, row: Row, scene: Scene) -> Iterator[str]:
        group, split, rule = row.get("duplicate_group"), row.get("split"), self._splits
        if group is not None and split is not None:
            first = self._split_of_group.setdefault(f"{group} {scene.table.table_type}", split)
            if first != split:
                yield f"split is {split}, expected {first} as of other scenes of its near-duplicate group"
        if rule is None or row.get("variant_of") is not None or rule.source not in (None, row["source"]):
            return
        if (expected := duplicate_group(scene)) != group:
            yield f"duplicate_group is {group}, expected {expected} by its table type and assets"
        elif (right := split_of(group, scene.table.table_type, rule.shares)) != split:
            yield f"split is {split}, expected {right} by its near-duplicate group"

    def _asset_faults(self, row: Row, scene: Scene) -> Iterator[str]:
        """Assets that the run does not have although their objects have a mesh, and sizes that their meshes do not have."""
        has_mesh = {v["instance"]: v["has_mesh"] for v in row["verdicts"] or ()}
        named = [(o.instance, o.asset_id) for o in scene.objects if o.asset_id is not None]
        if not self._has_assets and self._needs_assets and (lost := [name for name, _ in named if has_mesh.get(name)]):
            yield f"{lost[0]} has a mesh, but the run has no table assets"
        if self._has_assets and named:
            is_missing = self._known.missing(pa.array([asset_id for _, asset_id in named], pa.string()), ["assets"])
            for (instance, asset_id), missing in zip(named, is_missing.tolist(), strict=True):
                if missing and has_mesh.get(instance, True):
                    yield f"asset {asset_id} of {instance} is in no row of assets"
                elif missing:
                    self._known.add(UNRESOLVED, pa.array([asset_id], pa.string()))
        for o in scene.objects:
            extents = None if o.asset_id is None else self._facts.extents(o.asset_id)
            category = None if o.asset_id is None else self._facts.category(o.asset_id)
            if category is not None and category != o.category:
                yield f"{o.instance} is of category {o.category}, expected {category} as of its asset"
            if extents is not None and o.scale is not None:
                yield from _size_faults(o, extents * o.scale)
            if extents is None and self._has_assets and has_mesh.get(o.instance) and o.asset_id is None:
                yield f"{o.instance} has a mesh by its verdict, but names no asset"


def _table_faults(scene: Scene) -> Iterator[str]:
    """A table that is not the one of the layout that a scene was read from, of which the scene has the entries."""
    if not isinstance(scene.source, Mapping) or ZONE not in scene.source:
        return
    try:
        stated, _ = read_table(scene.source, scene.table.table_type, ReadLog(scene.scene_id))
    except SceneError as error:
        yield f"source_json: {error}"
        return
    for name, found, expected in (
        ("table_size", scene.table.size_xy, stated.size_xy),
        ("restricted_zone", scene.table.restricted_zone, stated.restricted_zone),
    ):
        is_same = found == expected if found is None or expected is None else all(map(is_close, found, expected))
        if not is_same:
            yield f"{name} is {found}, expected {expected} as its layout file says, whose entries are in source_json"


def _size_faults(o: SceneObject, box: FloatArray) -> Iterator[str]:
    """A size that the mesh of an object cannot have, whose box before the tilt is known, (3,), metres.

    Of a tilted object only bounds follow from the box; the verdicts look at the mesh itself.
    """
    if o.tilt_quat_xyzw == UPRIGHT:
        if not has_size(box, o.size):
            yield f"{o.instance} has size {list(o.size)}, expected {box.round(4).tolist()}: its mesh at its scale"
        return
    x, y, z = box.tolist()
    size, most, longest = np.array(o.size), np.array(rotated_extents((x, y, z), o.tilt_quat_xyzw)), float(box.max())
    least = size * max(1.0, longest / max(float(np.linalg.norm(size)), 1e-9))
    if not (has_size(np.minimum(most, size), o.size) and has_size(least, o.size)):
        yield (
            f"{o.instance} has size {list(o.size)}, expected at most {most.round(4).tolist()} and {longest:.4g} across: its mesh at its "
            "scale and tilt"
        )


def names_faults(row: Row, scene: Scene) -> Iterator[str]:
    """Yields names of instances that no object has."""
    names = {o.instance for o in scene.objects}
    places = names | {TABLE}

    yield from _odd("fixed", scene.fixed, names)
    yield from _odd("support", (o.support for o in scene.objects if o.support is not None), places)
    yield from _odd("pairs", (p[key] for p in row["pairs"] or () for key in ("first", "second")), names)
    yield from _odd("verdicts", (name for v in row["verdicts"] or () for name in v["supports"]), places)
    pairs = [frozenset((p["first"], p["second"])) for p in row["pairs"] or ()]
    if len(set(pairs)) < len(pairs) or any(len(pair) == 1 for pair in pairs):
        yield "pairs has a pair twice, or an object with itself"
    for relation in scene.relations:
        ends = set(relation.subject.split(", "))
        ends |= set() if relation.kind in _NO_INSTANCES else set(relation.target.split(", "))
        yield from _odd(f"relation {relation}", ends, places)
    if scene.task is not None:
        yield from task_faults(scene.task, names)


def task_faults(task: TaskInfo, names: Set[str]) -> Iterator[str]:
    """Yields names in a task that no object of its scene has, of which the names are given."""
    yield from _odd("task_objects", task.task_objects, names)
    stated = [each.subject for each in task.relations] + [each.subject for each in task.conditions]
    yield from _odd("task", (name for subject in stated for name in subject.split(", ")), names | {TABLE})


def _odd(what: str, found: Iterable[str], known: Set[str]) -> Iterator[str]:
    for name in dict.fromkeys(found):
        if name not in known:
            yield f"{what} names {name}, expected one of its objects"


def derived_faults(row: Row, scene: Scene, *, may_be_older: bool = False) -> Iterator[str]:
    """Yields columns that do not follow from the verdicts and relations of a row."""
    audit = audit_of_row(row, scene)
    card = add_counts(audit.card(), scene)
    for name in _DERIVED:
        if name not in row or (scene.fixed and name == "num_without_mesh"):  # verdicts on fixed objects are not stored
            continue
        found, expected = row[name], getattr(card, name)
        if found is None and may_be_older and name in _LATER:
            continue
        if name in ("num_stacked", "num_contained") and found is None and not scene.relations:
            continue  # nobody asked for its relations
        if name == "clean" and scene.fixed and expected and found is None:
            continue  # a fixed object without mesh leaves it open
        if not is_close(found, expected):
            yield f"{name} is {found}, expected {expected} by its verdicts and relations"


def rest_faults(row: Mapping[str, Any]) -> Iterator[str]:
    """Yields verdicts on stability that do not follow from the movements of a row."""
    known = {name: row.get(name) for name in _LIMITS}
    moved = any(value is not None and value > _LIMITS[name] for name, value in known.items())
    stable = row.get("stable")
    if stable is None and any(value is not None for value in known.values()):
        yield "stable is null, but its movements are known"
    if stable is True and (moved or known["settle_move_max_mm"] is None):
        yield f"stable is true, expected false by its movements {known}"
    if stable is False and not moved and known["settle_move_max_mm"] is not None:
        yield f"stable is false, expected true by its movements {known}"
    for judge in FURTHER:
        name, move, turn = verdict_columns(judge)
        values = {move: row.get(move), turn: row.get(turn)}
        limits = dict(zip(values, _LIMITS.values(), strict=False))
        if row.get(name) is True and any(value is not None and value > limits[key] for key, value in values.items()):
            yield f"{name} is true, expected false by its movements {values}"


def _reach_faults(row: Row, scene: Scene) -> Iterator[str]:
    reach = row.get("reach")
    if "robot" in row and (row["robot"] is None) != (reach is None):
        yield "robot and reach are null in part, expected both or none"
    if row.get(GRASPABLE) and not row.get(REACHABLE):
        yield f"{GRASPABLE} is true, but {REACHABLE} is not"
    names = {o.instance for o in scene.objects}
    for one in reach or ():
        if one["instance"] not in names:
            yield f"reach names {one['instance']}, expected one of its objects"


def card_faults(found: Mapping[str, Any], scene_row: Mapping[str, Any]) -> Iterator[str]:
    """Yields columns of the metric card of a correction that differ from those of its scene, which has the same poses."""
    for name in _OF_POSES:
        if name in found and name in scene_row and not is_close(found[name], scene_row[name]):
            yield f"card_after.{name} is {found[name]}, expected {scene_row[name]} as of its scene"


def is_close(found: object, expected: object) -> bool:
    """Whether two values are equal but for the rounding of the last digits; null equals null alone."""
    if isinstance(found, bool) or isinstance(expected, bool) or not (is_number(found) and is_number(expected)):
        return found == expected
    return math.isclose(float(str(found)), float(str(expected)), rel_tol=1e-9, abs_tol=1e-9)


def is_number(value: object) -> bool:
    """Whether a value is a number and no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool)
