"""What the generate job is asked for: tasks of a file, of scenes that are there, of a command line, or drawn where they are needed."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from models.semantic_reasoner.staged_layout import LayoutTask, task_of_scene
from pipelines.sources.tasks import STEP, read_tasks, task_of
from stable_data.embedded_world.sampling import sample_task
from stable_data.embedded_world.scenes import plan_of, scene_id_of
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage import schemas
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.run_folder import RunFolder


@dataclass(frozen=True, slots=True)
class SampledTask:
    """A task that is drawn where it is needed, so that a million of them weigh nothing.

    Attributes:
        number: Which.
        seed: Of which set.
        tables: Kinds of table that take turns; all of them where empty.
    """

    number: int
    seed: int
    tables: tuple[str, ...] = ()

    @property
    def scene_id(self) -> str:
        """Names the scene; of runs with other seeds no two scenes have one name, so that they can be joined."""
        return scene_id_of(self.number, self.tables) + (f"_seed{self.seed}" if self.seed else "")

    def drawn(self) -> LayoutTask:
        """The task.

        Raises:
            SceneError: None could be drawn (``synth_failed``).
        """
        table, instruction = sample_task(self.number, self.seed, self.tables)
        return LayoutTask(self.scene_id, instruction, table)


Task: TypeAlias = LayoutTask | SampledTask


@dataclass(frozen=True, slots=True)
class TaskSource:
    """What is asked for.

    Attributes:
        name: Where it comes from.
        tasks: The tasks.
        lost: What could not be read as one.
    """

    name: str
    tasks: Sequence[Task]
    lost: Sequence[Notice] = ()

    @classmethod
    def of(cls, name: str, found: Iterable[LayoutTask | Notice]) -> "TaskSource":
        """What was found, tasks and what is none apart."""
        both = list(found)
        return cls(name, [t for t in both if isinstance(t, LayoutTask)], [n for n in both if isinstance(n, Notice)])

    def __post_init__(self) -> None:
        """Refuses what asks for nothing."""
        if not self.tasks:
            why = f"; {len(self.lost)} are none, such as {self.lost[0].message}" if self.lost else ""
            raise ConfigError(f"{self.name}: holds no task that can be used, expected one at least{why}", "tasks_invalid")


def sample_tasks(count: int, seed: int = 0, kinds: Sequence[str] = ()) -> TaskSource:
    """So many tasks of the embedded world, that none of its scenes has.

    Args:
        count: How many.
        seed: Task k depends on the seed and k alone.
        kinds: Kinds of table that take turns; all of them where empty.

    Raises:
        ConfigError: ``invalid_count`` or ``unknown_table``.
    """
    if count < 1 or seed < 0:
        raise ConfigError(f"count is {count} and seed {seed}, expected at least 1 and 0", "invalid_count")
    for kind in kinds:
        plan_of(kind)
    return TaskSource(f"{count} sampled tasks", [SampledTask(number, seed, tuple(kinds)) for number in range(count)])


def tasks_of_file(path: Path) -> TaskSource:
    """The tasks of a file, see :func:`pipelines.sources.tasks.read_tasks`, whose error it raises."""
    return TaskSource.of(path.name, read_tasks(path))


def task_of_instruction(instruction: str, table_type: str, size_cm: object, restricted_cm: object = None) -> TaskSource:
    """The one task of a command line; its scene is called ``task``.

    Args:
        instruction: What is to be done on the table.
        table_type: Kind of table.
        size_cm: Its width and depth.
        restricted_cm: x_min, x_max, y_min, y_max where nothing may stand, or None.

    Raises:
        ConfigError: It is none (``tasks_invalid``).
    """
    row = {"instruction": instruction, "table_type": table_type, "table_size_cm": size_cm, "restricted_zone_cm": restricted_cm}
    try:
        return TaskSource("one instruction", [task_of(row, "task")])
    except SceneError as error:
        raise ConfigError(f"the task's {error}", "tasks_invalid") from error


def tasks_of_scenes(place: str, where: str = "") -> TaskSource:
    """The tasks of scenes that are there: their instructions and tables, and nothing else of them.

    Args:
        place: A run with a table ``scenes``, or a folder in the MesaTask-10K format.
        where: Of a run, which scenes: a condition, see :mod:`stable_data.storage.filter_expression`.

    Raises:
        ConfigError: It is neither, or ``where`` is no condition on a run.
    """
    if "://" in place or RunFolder(place).files("scenes"):
        return TaskSource.of(Path(place).name, _of_run(RunFolder(place), where))
    if where:
        raise ConfigError(f"{place}: has no table scenes, expected a run where there is a condition", "not_a_run")
    dataset = MesaTaskDataset(Path(place).expanduser().resolve())
    return TaskSource.of(dataset.root.name, _of_dataset(dataset))


def _of_run(run: RunFolder, where: str) -> Iterator[LayoutTask | Notice]:
    query = parse_filter(where, schemas.SCHEMAS["scenes"]) if where.strip() else None
    for batch in run.batches("scenes", where=None if query is None else query.expression):
        for row in batch.to_pylist():
            scene = schemas.scene_from_row(row)
            yield task_of_scene(scene) if scene.task is not None else _without_task(scene.scene_id)


def _of_dataset(dataset: MesaTaskDataset) -> Iterator[LayoutTask | Notice]:
    for scene_id in dataset.scene_ids:
        try:
            scene = dataset.read(scene_id)[0]
        except SceneError as error:
            yield Notice(scene_id, STEP, error.code, str(error))
        else:
            yield task_of_scene(scene) if scene.task is not None else _without_task(scene_id)


def _without_task(scene_id: str) -> Notice:
    return Notice(
        scene_id, STEP, "task_missing", f"{scene_id}: has no task info, expected its instruction; preprocess writes one"
    )
