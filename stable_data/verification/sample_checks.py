"""Checks rows of ``samples``: what each stage of a scene is given and what it adds follow from the scene and its stages."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from stable_data.errors import StableDataError
from stable_data.scene import Scene, SceneObject, Stage
from stable_data.scene_graph.stage_samples import samples_of
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, task_from_row
from stable_data.verification.findings import Findings
from stable_data.verification.joined_checks import ScenesOfShards, ShardMates
from stable_data.verification.scene_checks import task_faults
from stable_data.verification.shard_files import ShardFile

_AS_SCENE = ("split", "table_type", "table_size", "restricted_zone")
_STAGES = list(map(str, Stage))


class SampleCheck:
    """Checks rows of ``samples``.

    A task of a scene has one row for each stage, one after the other. The stages that their objects have are those of the scene, for the
    scene's own task; with them, the objects of each row and their order follow from the scene.

    Args:
        scenes: The scenes.
        findings: Where damage is noted.
        mates: Set if the scenes must be in the shards of the rows, with all of their rows; otherwise each row is checked by itself.
        may_be_older: Whether the rows may be older than the order of generation.
    """

    TABLE = "samples"

    def __init__(
        self, scenes: ScenesOfShards, findings: Findings, mates: ShardMates | None = None, *, may_be_older: bool = False
    ) -> None:
        self._scenes, self._findings, self._mates, self._may_be_older = scenes, findings, mates, may_be_older
        self._file: ShardFile | None = None
        self._here: Mapping[str, tuple[Row, Scene | None]] = {}  # the scenes of its shard
        self._of_task: list[tuple[int, Row]] = []  # the last rows, of one task of one scene, with their numbers
        self._told = set[str]()  # the scenes with rows of their own task
        self._objects: tuple[str, dict[str, SceneObject]] = ("", {})  # of the last scene, without stages

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks rows of a file, of which the first has a number; the rows of a scene are in one shard."""
        if self._file is not None and self._file.shard_id != file.shard_id:
            self.close()
        self._file, self._here = file, self._scenes.of(file.shard_id)
        for number, row in enumerate(rows, start):
            scene_row, scene = self._here.get(row["scene_id"], (None, None))
            if scene_row is None or scene is None:
                continue
            if self._objects[0] != row["scene_id"]:
                self._objects = row["scene_id"], {o.instance: replace(o, stage=None) for o in scene.objects}
            for what in _row_faults(row, scene_row, scene, self._objects[1]):
                self._damage(row, what, number)
            if self._mates is not None:
                self._note_row(row, number)
        if self._mates is not None:
            self._mates.check([row["scene_id"] for row in rows], start, file)

    def _note_row(self, row: Row, number: int) -> None:
        """Keeps a row until those of its task are there."""
        if self._of_task and (len(self._of_task) == len(_STAGES) or _task_of(self._of_task[0][1]) != _task_of(row)):
            self._close_task()
        self._of_task.append((number, row))

    def close(self) -> None:
        """Looks for scenes of a shard that have no samples of their own task."""
        self._close_task()
        if self._file is not None and self._mates is not None:
            for name, (row, scene) in self._here.items():
                if scene is not None and name not in self._told:
                    self._damage(row, "has no samples of its own task, expected one for each stage", None)
        self._told.clear()
        self._file, self._objects = None, ("", {})

    def _close_task(self) -> None:
        """Compares the rows of a task with their scene."""
        rows, self._of_task = self._of_task, []
        if not rows:
            return
        (number, first), (scene_row, scene) = rows[0], self._here[rows[0][1]["scene_id"]]
        assert scene is not None
        if first["task"] == scene_row["task"]:
            self._told.add(first["scene_id"])
        if (stages := [row["stage"] for _, row in rows]) != _STAGES:
            what = f"the samples of a task are of the stages {', '.join(stages)}, expected {', '.join(_STAGES)}"
            self._damage(first, what, number)
            return
        for number, what in _task_row_faults(rows, scene_row, scene, has_order=not self._may_be_older):
            self._damage(first, what, number)

    def _damage(self, row: Row, what: str, number: int | None) -> None:
        assert self._file is not None
        self._findings.damage(self._file.name, f"{row['scene_id']}: {what}", number)


def _task_of(row: Row) -> tuple[str, str]:
    """The scene and the instruction of a row: no two tasks of a scene have the same."""
    return row["scene_id"], row["task"]["task"]


def _row_faults(row: Row, scene_row: Row, scene: Scene, there: Mapping[str, SceneObject]) -> Iterator[str]:
    """Yields what contradicts between a row and its scene, whose objects are given without stages, whichever other rows there are."""
    for column in ("objects_in", "objects_out"):
        for each in row[column]:
            o = object_from_row(each)
            if there.get(o.instance) != replace(o, stage=None):
                yield f"{column}: {o.instance} is not as in its scene"
            if column == "objects_out" and each["stage"] != row["stage"]:
                yield f"objects_out: {o.instance} is of stage {each['stage']}, expected {row['stage']}"
    for name in _AS_SCENE:
        if row.get(name) != scene_row.get(name):
            yield f"{name} is {row.get(name)}, expected {scene_row.get(name)} as of its scene"
    task, own = task_from_row(row["task"]), scene.task
    if task is not None:
        yield from task_faults(task, there.keys())
    if task is not None and own is not None and task.task == own.task and row["task"] != scene_row["task"]:
        name = next(name for name, value in row["task"].items() if value != scene_row["task"][name])
        yield f"task.{name} is not as in its scene, which has the same task"


def _task_row_faults(
    rows: Sequence[tuple[int, Row]], scene_row: Row, scene: Scene, *, has_order: bool
) -> Iterator[tuple[int, str]]:
    """Yields what contradicts between the rows of the stages of a task and their scene, each with the number of its row."""
    (number, first), names = rows[0], {o.instance for o in scene.movable}
    stage_of = {each["instance"]: Stage(each["stage"]) for _, row in rows for each in row["objects_out"]}
    if odd := names ^ stage_of.keys():
        yield number, f"objects_out of its stages lack or add {min(odd)}, expected each of its objects once"
        return
    if first["task"] == scene_row["task"]:
        staged = scene
    else:
        staged = replace(scene, objects=tuple(replace(o, stage=stage_of.get(o.instance)) for o in scene.objects))
    if late := {name for name in first["task"]["task_objects"] if stage_of.get(name, Stage.TASK) is not Stage.TASK}:
        yield number, f"{min(late)} is of stage {stage_of[min(late)]}, expected {Stage.TASK}: the task names it"
    try:
        expected = samples_of(staged)
    except StableDataError as error:
        yield number, f"cannot be compared with its scene: {error}"
        return
    for (number, row), sample in zip(rows, expected, strict=True):
        for column, objects in (("objects_in", sample.objects_in), ("objects_out", sample.objects_out)):
            stated = tuple(map(object_from_row, row[column]))
            is_same = stated == objects if has_order else _by_name(stated) == _by_name(objects)
            if not is_same:
                found = [o.instance for o in stated]
                yield number, f"{column} is {found}, expected {[o.instance for o in objects]} with their stages, in this order"


def _by_name(objects: Sequence[SceneObject]) -> list[SceneObject]:
    return sorted(objects, key=lambda o: o.instance)
