"""Checks rows that say something of a scene in another table, together with that scene.

The tables of a step of a job have shards of the same ids, so that the scenes of a shard are read once for all of its rows. Where scenes
may be in other shards, as in a selection, their ids alone can be compared.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from stable_data.errors import ConfigError, StableDataError
from stable_data.metrics.movement import movement
from stable_data.rotations import yaw_quat
from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, scene_from_row
from stable_data.verification.findings import Findings
from stable_data.verification.known_ids import KnownIds
from stable_data.verification.scene_checks import card_faults, is_close
from stable_data.verification.shard_files import ShardFile

_COLUMNS = ("move_mean_mm", "move_max_mm", "turn_max_deg")
_SCENES = ("scenes", "rejected")


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
        except ConfigError:  # its own check reports it
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
        table: The table: turns, settled, grasps, samples, corrections or edits.
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


class TurnCheck:
    """Checks rows of ``turns``: the turns of a scene are numbered from 0, and its last correction has its poses and its card.

    Args:
        scenes: The scenes.
        findings: Where damage is noted.
        mates: Set if the scenes must be in the shards of the rows.
    """

    def __init__(self, scenes: ScenesOfShards, findings: Findings, mates: ShardMates | None = None) -> None:
        self._scenes, self._findings, self._mates = scenes, findings, mates
        self._file: ShardFile | None = None
        self._turns = dict[str, int]()
        self._last = dict[str, tuple[int, Any, Any]]()

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number; the turns of a scene are in one shard."""
        if self._file is not None and self._file.shard_id != file.shard_id:
            self.close()
        self._file = file
        for number, row in enumerate(rows, start):
            name = row["scene_id"]
            if (expected := self._turns.get(name, 0)) != row["turn"]:
                self._findings.damage(
                    file.name, f"{name}: turn is {row['turn']}, expected {expected}: each turn once, in order", number
                )
            self._turns[name] = row["turn"] + 1
            if row.get("corrected") is not None:
                self._last[name] = number, row["corrected"], row.get("card_after")
                names = [pose["instance"] for pose in row.get("coarse") or ()]
                after = [each["instance"] for column in ("corrected", "dropped") for each in row.get(column) or ()]
                if names and set(names) != set(after):
                    what = (
                        f"coarse has poses of {min(set(names) ^ set(after))} alone, expected of what was corrected or dropped"
                    )
                    self._findings.damage(file.name, f"{name}: {what}", number)
        if self._mates is not None:
            self._mates.check([row["scene_id"] for row in rows], start, file)

    def close(self) -> None:
        """Compares the last corrections of the scenes of a shard with their poses and their cards."""
        if self._file is not None:
            scenes = self._scenes.of(self._file.shard_id)
            for name, (number, corrected, card) in self._last.items():
                row, scene = scenes.get(name, (None, None))
                if row is None or scene is None:
                    continue
                if fault := _other_poses(corrected, scene):
                    self._findings.damage(self._file.name, f"{name}: {fault} after its last correction", number)
                for fault in card_faults(card or {}, row):
                    self._findings.damage(self._file.name, f"{name}: {fault}", number)
        self._turns.clear()
        self._last.clear()


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


def _sample_faults(row: Row, scene_row: Row, scene: Scene) -> Iterator[str]:
    there = {o.instance: replace(o, stage=None) for o in scene.objects}
    for column in ("objects_in", "objects_out"):
        for each in row[column]:
            o = object_from_row(each)
            if there.get(o.instance) != replace(o, stage=None):
                yield f"{column}: {o.instance} is not as in its scene"
            if column == "objects_out" and each["stage"] != row["stage"]:
                yield f"objects_out: {o.instance} is of stage {each['stage']}, expected {row['stage']}"
    if row.get("split") != scene_row.get("split"):
        yield f"split is {row.get('split')}, expected {scene_row.get('split')} as of its scene"


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
    "samples": _sample_faults,
    "corrections": _correction_faults,
    "edits": _edit_faults,
}
