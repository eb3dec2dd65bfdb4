"""Checks rows that say something of a scene in another table, together with that scene.

The tables of a step of a job have shards of the same ids, so that the scenes of a shard are read once for all of its rows. Where scenes
may be in other shards, as in a selection, their ids alone can be compared.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from stable_data.errors import ConfigError, StableDataError
from stable_data.json_text import json_value
from stable_data.metrics.movement import movement
from stable_data.rotations import yaw_quat
from stable_data.scene import Scene, Stage
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, scene_from_row
from stable_data.verification.findings import Findings
from stable_data.verification.known_ids import KnownIds
from stable_data.verification.scene_checks import card_faults, is_close
from stable_data.verification.shard_files import ShardFile

_COLUMNS = ("move_mean_mm", "move_max_mm", "turn_max_deg")
_SCENES = ("scenes", "rejected")
_STAGES = frozenset(map(str, Stage))
_KEPT = (
    ("on_in_held", "on_in_kept", "relations_kept_on_in"),
    ("directional_held", "directional_kept", "relations_kept_directional"),
)
"""Columns of a correction with the number of relations that held before and after it, and the column of its scene with their share."""


class ScenesOfShards:
    """The scenes of the shards of a run; those of one shard are in memory.

    Args:
        folder: The run.
        files: All of its files.
    """

    def __init__(self, folder: RunFolder, files: Sequence[ShardFile]) -> None:
        self._folder = folder
        self._files = [file for file in files if file.table in _SCENES]
        self._read: tuple[str, dict[str, tuple[Row, Scene | None]]] | None = None

    def of(self, shard_id: str) -> Mapping[str, tuple[Row, Scene | None]]:
        """The rows of a shard by id, each with its scene, which is None if the row is damaged; empty without such a shard."""
        if self._read is None or self._read[0] != shard_id:
            found = dict[str, tuple[Row, Scene | None]]()
            for file in self._files:
                if file.shard_id == shard_id:
                    found |= self._scenes_of(file)
            self._read = shard_id, found
        return self._read[1]

    def _scenes_of(self, file: ShardFile) -> dict[str, tuple[Row, Scene | None]]:
        try:
            rows = self._folder.read_file(file.table, file.path).to_pylist()
        except (ConfigError, UnicodeDecodeError):  # its own check reports it
            return {}
        found = dict[str, tuple[Row, Scene | None]]()
        for row in rows:
            try:
                found[row["scene_id"]] = row, scene_from_row(row)
            except (StableDataError, ValueError, TypeError, KeyError):
                found[row["scene_id"]] = row, None
        return found


class ShardMates:
    """Looks for rows whose scenes are in another shard, although their job writes both in one.

    Args:
        scenes: The scenes.
        known: Ids of all of them.
        findings: Where damage is noted.
    """

    def __init__(self, scenes: ScenesOfShards, known: KnownIds, findings: Findings) -> None:
        self._scenes, self._known, self._findings = scenes, known, findings

    def check(self, names: Sequence[str], start: int, file: ShardFile) -> None:
        """Checks the names of the scenes of rows of a file, of which the first has a number."""
        here = self._scenes.of(file.shard_id)
        others = [(number, name) for number, name in enumerate(names, start) if name not in here]
        is_unknown = self._known.missing(pa.array([name for _, name in others], pa.string()), _SCENES)
        for (number, name), unknown in zip(others, is_unknown.tolist(), strict=True):
            if not unknown:
                self._findings.damage(file.name, f"{name}: its scene is in another shard, expected in that of its row", number)


class JoinedCheck:
    """Checks rows of a table together with the scenes that they name.

    Args:
        table: The table: settled, grasps, corrections or edits.
        scenes: The scenes.
        key: Column of the id of the scene.
        findings: Where damage is noted.
        mates: Set if the scenes must be in the shards of the rows.
    """

    def __init__(
        self, table: str, scenes: ScenesOfShards, key: str, findings: Findings, mates: ShardMates | None = None
    ) -> None:
        self._faults = _FAULTS[table]
        self._scenes, self._key, self._findings, self._mates = scenes, key, findings, mates

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number."""
        scenes = self._scenes.of(file.shard_id)
        for number, row in enumerate(rows, start):
            scene_row, scene = scenes.get(row[self._key], (None, None))
            if scene_row is not None and scene is not None:
                for what in self._faults(row, scene_row, scene):
                    self._findings.damage(file.name, f"{row[self._key]}: {what}", number)
        if self._mates is not None:
            self._mates.check([row[self._key] for row in rows], start, file)


@dataclass(frozen=True, slots=True)
class _Turn:
    """What is looked at of a row of ``turns``.

    Attributes:
        number: Number of the row in its file.
        stage: The stage that was asked for.
        is_accepted: Whether its proposal is in the scene.
        proposed: The instances of its reply; empty without one.
        unmatched: Those of them that got no asset.
        coarse: Poses before its correction; None without one.
        corrected: Poses after it; None without one.
        dropped: Instances that it dropped.
        card: The metric card after it.
    """

    number: int
    stage: str
    is_accepted: bool
    proposed: frozenset[str]
    unmatched: frozenset[str]
    coarse: Sequence[Row] | None
    corrected: Sequence[Row] | None
    dropped: frozenset[str]
    card: Row

    @classmethod
    def of(cls, row: Row, number: int) -> "_Turn":
        """Reads a row.

        Raises:
            ValueError: Its reply is none of objects.
        """
        return cls(
            number,
            row["stage"],
            not row.get("code"),
            _instances_of_reply(row.get("reply")),
            frozenset(row.get("unmatched") or ()),
            row.get("coarse"),
            row.get("corrected"),
            frozenset(each["instance"] for each in row.get("dropped") or ()),
            row.get("card_after") or {},
        )

    def faults(self) -> Iterator[str]:
        """Yields what is wrong with the correction of the turn by itself."""
        if self.corrected is None:
            return
        names, after = ({pose["instance"] for pose in poses or ()} for poses in (self.coarse, self.corrected))
        if both := after & self.dropped:
            yield f"dropped names {min(both)}, which is in corrected"
        if names and names != after | self.dropped:
            yield (
                f"coarse has poses of {min(names ^ (after | self.dropped))} alone, expected of what was corrected or dropped"
            )


class TurnCheck:
    """Checks rows of ``turns``.

    The turns of a scene are numbered from 0; its last correction has its poses and its card; each object has a pose in the correction of
    the turn that proposed it, and is of its stage.

    Args:
        scenes: The scenes.
        findings: Where damage is noted.
        mates: Set if the scenes must be in the shards of the rows.
    """

    TABLE = "turns"

    def __init__(self, scenes: ScenesOfShards, findings: Findings, mates: ShardMates | None = None) -> None:
        self._scenes, self._findings, self._mates = scenes, findings, mates
        self._file: ShardFile | None = None
        self._here: Mapping[str, tuple[Row, Scene | None]] = {}  # the scenes of its shard
        self._next, self._turns = dict[str, int](), dict[str, list[_Turn]]()

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number; the turns of a scene are in one shard."""
        if self._file is not None and self._file.shard_id != file.shard_id:
            self.close()
        self._file, self._here = file, self._scenes.of(file.shard_id)
        for number, row in enumerate(rows, start):
            name = row["scene_id"]
            if (expected := self._next.get(name, 0)) != row["turn"]:
                self._findings.damage(
                    file.name, f"{name}: turn is {row['turn']}, expected {expected}: each turn once, in order", number
                )
            self._next[name] = row["turn"] + 1
            try:
                turn = _Turn.of(row, number)
            except ValueError as error:
                self._findings.damage(file.name, f"{name}: reply is no JSON with a list of objects ({error})", number)
                continue
            self._turns.setdefault(name, []).append(turn)
            for what in turn.faults():
                self._findings.damage(file.name, f"{name}: {what}", number)
        if self._mates is not None:
            self._mates.check([row["scene_id"] for row in rows], start, file)

    def close(self) -> None:
        """Compares the turns of the scenes of a shard with the scenes."""
        if self._file is not None:
            for name, turns in self._turns.items():
                row, scene = self._here.get(name, (None, None))
                if row is not None and scene is not None:
                    for number, what in _turn_faults(turns, row, scene):
                        self._findings.damage(self._file.name, f"{name}: {what}", number)
        self._next.clear()
        self._turns.clear()


def _instances_of_reply(reply: str | None) -> frozenset[str]:
    """The instances of the objects of a reply.

    Raises:
        ValueError: The text is no JSON, or has no list of objects with names.
    """
    if reply is None:
        return frozenset()
    document = json_value(reply)
    objects = document.get("objects") if isinstance(document, dict) else None
    names = (
        [each.get("instance") if isinstance(each, dict) else None for each in objects] if isinstance(objects, list) else [None]
    )
    if not all(isinstance(name, str) for name in names):
        raise ValueError("an object has no instance" if isinstance(objects, list) else "it has no objects")
    return frozenset(map(str, names))


def _turn_faults(turns: Sequence[_Turn], row: Row, scene: Scene) -> Iterator[tuple[int, str]]:
    """Yields what contradicts between the turns of a scene and the scene, each with the row of the turn."""
    corrections = [turn for turn in turns if turn.is_accepted and turn.corrected is not None]
    # A last stage that is left out is followed by a correction of its own, which is in no turn.
    if corrections and corrections[-1].stage == turns[-1].stage:
        last = corrections[-1]
        if fault := _other_poses(last.corrected or (), scene):
            yield last.number, f"{fault} after its last correction"
        for fault in card_faults(last.card, row):
            yield last.number, fault
    yield from _far_poses(turns, scene)
    if row.get("variant_of") is None:  # the first objects of a variant are those of another scene
        yield from _proposal_faults(turns, scene)


def _proposal_faults(turns: Sequence[_Turn], scene: Scene) -> Iterator[tuple[int, str]]:
    """Yields what contradicts between the replies of the turns of a scene, their corrections and the scene."""
    stage_of, accepted, objects = dict[str, _Turn](), frozenset[str](), {o.instance: o for o in scene.movable}
    for number, turn in enumerate(turns):
        if turn.coarse is not None:
            there = {pose["instance"] for pose in turn.coarse}
            if strange := there - accepted - turn.proposed:
                yield turn.number, f"coarse has a pose of {min(strange)}, which no reply up to this turn proposes"
            if not turn.unmatched and (lost := turn.proposed - there):
                yield turn.number, f"coarse has no pose of {min(lost)}, which the reply proposes"
        if not turn.is_accepted:
            continue
        accepted |= turn.proposed
        stage_of |= dict.fromkeys(turn.proposed, turn)
        later = frozenset[str]().union(*(each.proposed for each in turns[number + 1 :]))
        if turn.corrected is not None and (again := (turn.dropped & objects.keys()) - later):
            yield turn.number, f"dropped names {min(again)}, which is in its scene"
    for name, turn in stage_of.items():
        if name in objects and turn.stage in _STAGES and objects[name].stage != turn.stage:
            yield (
                turn.number,
                f"{name} is of stage {objects[name].stage}, expected {turn.stage} as of the turn that proposed it",
            )


def _far_poses(turns: Sequence[_Turn], scene: Scene) -> Iterator[tuple[int, str]]:
    """Yields poses of objects of a scene that are further beside its table, or below it, than the table is long."""
    names, width, depth = {o.instance for o in scene.movable}, *scene.table.size_xy
    far = max(width, depth)
    for turn in turns:
        for column, poses in (("coarse", turn.coarse), ("corrected", turn.corrected)):
            for pose in poses or ():
                x, y, z = pose["position"]
                beside = max(-x, x - width, -y, y - depth, -z)
                if pose["instance"] in names and beside > far:
                    yield (
                        turn.number,
                        f"{column} has {pose['instance']} {beside:.3g} m off the table, expected on it or near it",
                    )


def _other_poses(poses: Sequence[Row], scene: Scene) -> str:
    """What differs between poses and those of the movable objects of a scene; empty if nothing does."""
    stated = {pose["instance"]: (tuple(pose["position"]), pose["yaw"]) for pose in poses}
    there = {o.instance: (o.position, o.yaw) for o in scene.movable}
    if stated == there:
        return ""
    name = min(name for name in stated.keys() | there.keys() if stated.get(name) != there.get(name))
    return f"{name} is at {there.get(name)}, expected {stated.get(name)} as it was"


def _settled_faults(row: Row, scene_row: Row, scene: Scene) -> Iterator[str]:
    before, found = {o.instance: o for o in scene.objects}, [pose["instance"] for pose in row["poses"]]
    if set(found) != before.keys() or len(found) != len(before):
        yield f"poses are of {len(found)} objects, expected of each of its {len(before)} objects"
        return
    most = {name: scene_row.get(name) for name in ("settle_move_max_mm", "settle_turn_max_deg")}
    for pose in row["poses"]:
        o = before[pose["instance"]]
        cosine = min(1.0, abs(float(np.dot(pose["quat_xyzw"], yaw_quat(o.yaw)))))
        moved = 1e3 * math.dist(pose["position"], o.position), math.degrees(2 * math.acos(cosine))
        for (name, limit), value in zip(most.items(), moved, strict=True):
            if limit is not None and value > limit + _SETTLED_SLACK:
                yield f"{o.instance} settled {value:.4g} from its start, expected at most {limit:.4g} as {name} of its scene says"


def _grasp_faults(row: Row, _: Row, scene: Scene) -> Iterator[str]:
    if row["instance"] not in {o.instance for o in scene.objects}:
        yield f"instance is {row['instance']}, expected one of its objects"


def _correction_faults(row: Row, scene_row: Row, scene: Scene) -> Iterator[str]:
    if row["status"] == "infeasible":
        yield "status is infeasible, expected no scene"
    gone = {each["instance"] for each in row["dropped"]} & {o.instance for o in scene.objects}
    if gone:
        yield f"dropped names {min(gone)}, which is in its scene"
    start = {pose["instance"]: pose for pose in row["start"]}
    if strange := {o.instance for o in scene.objects} - start.keys():
        yield f"start has no pose of {min(strange)}"
        return
    objects = [o.moved(tuple(start[o.instance]["position"]), start[o.instance]["yaw"]) for o in scene.objects]
    for name, expected in zip(_COLUMNS, movement(replace(scene, objects=tuple(objects)), scene), strict=True):
        found = scene_row.get(name)
        if found is not None and not (is_close(found, expected) or abs(found - expected) < _SMALL):
            yield f"{name} of its scene is {found}, expected {expected} by its poses before and after"
    yield from card_faults(row.get("card_after") or {}, scene_row)
    yield from _kept_faults(row, scene_row)


def _kept_faults(row: Row, scene_row: Row) -> Iterator[str]:
    """Numbers of relations of a correction that contradict each other, or the shares of its scene."""
    for before, after, share in _KEPT:
        held, kept = row.get(before), row.get(after)
        if held is None or kept is None:
            continue
        if kept > held:
            yield f"{after} is {kept}, expected at most {before}, which is {held}"
        elif share in scene_row and not is_close(scene_row[share], expected := kept / held if held else None):
            yield f"{share} of its scene is {scene_row[share]}, expected {expected} by {after} and {before}"
    broken, restored = row.get("asked_broken"), row.get("asked_restored")
    if broken is not None and restored is not None and restored > broken:
        yield f"asked_restored is {restored}, expected at most asked_broken, which is {broken}"


def _edit_faults(row: Row, scene_row: Row, scene: Scene) -> Iterator[str]:
    there = {o.instance: replace(o, stage=None, support=None) for o in scene.objects}
    for each in row["objects_out"]:
        o = object_from_row(each)
        if there.get(o.instance) != replace(o, stage=None, support=None):
            yield f"objects_out: {o.instance} is not as in its scene"
    if gone := set(row["removed"]) & there.keys():
        yield f"removed names {min(gone)}, which is in its scene"


_SMALL = 1e-6  # millimetres and degrees
_SETTLED_SLACK = 0.01  # millimetres and degrees: an angle near zero follows from its cosine to no more
_FAULTS = {
    "settled": _settled_faults,
    "grasps": _grasp_faults,
    "corrections": _correction_faults,
    "edits": _edit_faults,
}

JOINED = frozenset({"turns", "samples", *_FAULTS})
"""Tables whose rows are checked together with their scenes."""
