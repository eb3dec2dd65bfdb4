"""The task sources of the generate job: a file, existing scenes, one instruction, or sampled tasks."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

from models.semantic_reasoner.staged_layout import LayoutTask, table_with_zone, task_of_scene
from pipelines.sources.scene_variants import SceneVariant, read_variants
from pipelines.sources.tasks import STEP, read_tasks, task_of
from stable_data.content_id import content_id
from stable_data.embedded_world.plans import TABLES, UNSEEN_TABLES
from stable_data.embedded_world.sampling import sample_task
from stable_data.embedded_world.scenes import plan_of, scene_id_of
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import SceneObject, SupportFrame, Tabletop
from stable_data.storage import schemas
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.run_folder import RunFolder, absolute_uri
from stable_data.storage.table_rows import scene_from_row

_REDRAWS = 50  # of a task whose objects the libraries lack
# Tasks of the first 50 of a table type that must be served; of a thousand more tasks one then has no served draw.
_FEWEST_SERVED = 8


@dataclass(frozen=True, slots=True)
class SupportPlace:
    """A surface of a support, on which a task is laid out.

    Attributes:
        table: Its table.
        surroundings: What is in the way there.
        frame: Where the table lies on the support; None if that is not known.
    """

    table: Tabletop
    surroundings: tuple[SceneObject, ...]
    frame: SupportFrame | None

    def holds(self, task: LayoutTask) -> LayoutTask:
        """Returns a task on this surface, whose table and surroundings replace its own."""
        return replace(task, table=self.table, surroundings=self.surroundings, frame=self.frame)


@dataclass(frozen=True, slots=True)
class SampledTask:
    """A task that a worker samples when it needs it, so that a million of them need no memory.

    Attributes:
        number: The index of the task.
        seed: The seed of the set.
        tables: Table types to alternate; empty uses all types.
        is_served: Whether the task is drawn again, up to 50 times, until the libraries have its objects.
        place: The surface of a support that is its table; None draws a table.
    """

    number: int
    seed: int
    tables: tuple[str, ...] = ()
    is_served: bool = False
    place: SupportPlace | None = None

    @property
    def scene_id(self) -> str:
        """The id of the scene. It contains the seed, so that runs with different seeds can be joined."""
        return scene_id_of(self.number, self.tables) + (f"_seed{self.seed}" if self.seed else "")

    def sample(self, serves: Callable[[str], bool]) -> LayoutTask:
        """Samples the task; it depends on its number, the seed and what is served alone.

        Args:
            serves: Whether the libraries have a wanted thing, by its category.

        Raises:
            SceneError: No task could be sampled (``synth_failed``), or the libraries lack an object of each one that was drawn
                (``task_not_served``).
        """
        lacking: Counter[str] = Counter()
        table = None if self.place is None else table_with_zone(self.place.table, self.place.surroundings)
        for draw in range(_REDRAWS + 1):
            task = task_of_scene(sample_task(self.number, self.seed, self.tables, draw, table))
            missing = _missing(task, serves) if self.is_served else []
            if not missing:
                task = replace(task, scene_id=self.scene_id)
                return task if self.place is None else self.place.holds(task)
            lacking.update(missing)
        names = ", ".join(name for name, _ in lacking.most_common(3))
        raise SceneError(
            f"task {self.number} of seed {self.seed}: the libraries lack an object of each of {_REDRAWS + 1} drawn tasks, such as "
            f"{names}; name more libraries, or set only_served=never",
            "task_not_served",
        )


def _missing(task: LayoutTask, serves: Callable[[str], bool]) -> list[str]:
    """The required objects of a task that the libraries lack."""
    required = task.reference.required if task.reference is not None else ()
    return [str(r) for r in required if r.categories and not any(map(serves, r.categories))]


Task: TypeAlias = LayoutTask | SampledTask | SceneVariant


_SAMPLED = tuple(one.name for one in fields(SampledTask))


def fingerprints_of_tasks(tasks: Iterable[Task]) -> Iterator[dict[str, Any]]:
    """Yields what the scenes of tasks depend on; surroundings, which many tasks share, are named by a hash."""
    hashes: dict[int, str] = {}

    def named(surroundings: tuple[SceneObject, ...]) -> dict[str, str]:
        if id(surroundings) not in hashes:
            hashes[id(surroundings)] = content_id([asdict(o) for o in surroundings])
        return {"surroundings_id": hashes[id(surroundings)]}

    for task in tasks:
        if isinstance(task, SampledTask) and task.place is not None:
            bare = replace(task, place=replace(task.place, surroundings=()))
            yield asdict(bare) | named(task.place.surroundings)
        elif isinstance(task, SampledTask):
            yield {name: getattr(task, name) for name in _SAMPLED}  # as asdict, which takes five times as long
        elif isinstance(task, LayoutTask) and task.surroundings:
            yield asdict(replace(task, surroundings=())) | named(task.surroundings)
        else:
            yield asdict(task)


@dataclass(frozen=True, slots=True)
class TaskSource:
    """The tasks of a run.

    Attributes:
        name: The name of the source.
        tasks: The tasks.
        lost: One notice for each input that is not a valid task.
        odd: Notices about the source as a whole.
        supports: The run with the supports on which the tasks stand, or with the scenes that are varied, an absolute path or URI;
            None: each task has a table of its own.
        inputs: Hashes of further inputs, by name.
    """

    name: str
    tasks: Sequence[Task]
    lost: Sequence[Notice] = ()
    odd: Sequence[Notice] = ()
    supports: str | None = None
    inputs: Mapping[str, str] = field(default_factory=dict)

    @property
    def varies(self) -> bool:
        """Whether the tasks are variants of scenes."""
        return isinstance(self.tasks[0], SceneVariant)

    @classmethod
    def of(cls, name: str, found: Iterable[LayoutTask | Notice]) -> "TaskSource":
        """Separates tasks from notices."""
        both = list(found)
        return cls(name, [t for t in both if isinstance(t, LayoutTask)], [n for n in both if isinstance(n, Notice)])

    def __post_init__(self) -> None:
        """Refuses a source without tasks."""
        if not self.tasks:
            why = f"; {len(self.lost)} are invalid, such as {self.lost[0].message}" if self.lost else ""
            raise ConfigError(f"{self.name}: contains no usable task, expected at least one{why}", "tasks_invalid")


def tasks_on_supports(source: TaskSource, supports: str) -> TaskSource:
    """Returns a source whose tasks stand on the surfaces of supports, in turn.

    Tasks that follow one another stand on the same pieces: with three surfaces the first three tasks are one of each.

    Args:
        source: The tasks.
        supports: A run whose scenes are the surfaces, as ``supports`` and ``import-scenes`` write it; only their tables and fixed
            objects are used.

    Raises:
        ConfigError: It is no run, or has no scenes (``no_surface``); or the tasks are variants of scenes (``usage``).
    """
    if not ("://" in supports or RunFolder(supports).files("scenes")):
        raise ConfigError(f"{supports}: has no table scenes, expected a run that supports or import-scenes made", "no_surface")
    scenes = [scene for batch in RunFolder(supports).batches("scenes") for scene in map(scene_from_row, batch.to_pylist())]
    if not scenes:
        raise ConfigError(f"{supports}: its table scenes is empty, expected at least one surface", "no_surface")
    places = [
        SupportPlace(scene.table, tuple(replace(o, source=None) for o in scene.surroundings), scene.frame) for scene in scenes
    ]
    tasks: list[Task] = []
    for number, task in enumerate(source.tasks):
        place = places[number % len(places)]
        if place.frame is not None:
            seed = f"_seed{task.seed}" if isinstance(task, SampledTask) and task.seed else ""  # as in the id of its scene
            piece = f"{place.frame.support}_{number // len(places):05d}{seed}"
            place = replace(place, frame=replace(place.frame, support=piece))
        if isinstance(task, SampledTask):
            kind = place.table.table_type
            tables = task.tables or ((kind,) if kind in TABLES or kind in UNSEEN_TABLES else ())
            tasks.append(replace(task, tables=tables, place=place))
        elif isinstance(task, LayoutTask):
            tasks.append(place.holds(task))
        else:
            raise ConfigError(f"{task.scene_id}: a variant has the table of its scene; leave out the supports", "usage")
    return replace(source, tasks=tasks, supports=absolute_uri(supports))


def served_tasks(source: TaskSource, serves: Callable[[str], bool], advice: str) -> TaskSource:
    """Returns a source whose sampled tasks ask only for objects that the libraries have, with its other tasks as they are.

    Table types are left out of which fewer than eight of 50 tasks are served, each with a notice.

    Args:
        source: The tasks.
        serves: Whether a library other than ``embedded`` has a wanted thing, by its category.
        advice: What a user may do if no table type is served.

    Raises:
        ConfigError: The libraries serve no table type (``tasks_not_served``).
    """
    sampled = [task for task in source.tasks if isinstance(task, SampledTask)]
    if not sampled:
        return source
    asked, seed = tuple(dict.fromkeys(t for task in sampled for t in task.tables or TABLES)), sampled[0].seed
    kinds = tuple(kind for kind in asked if _is_served(kind, seed, serves))
    if not kinds:
        raise ConfigError(
            f"the libraries other than embedded have the objects of hardly any task of {', '.join(asked)}, expected a table type with "
            f"tasks that they can serve; {advice}",
            "tasks_not_served",
        )
    notices = [
        Notice(
            kind, STEP, "table_not_served", f"no task of {kind} is drawn, because the libraries lack the objects of nearly all"
        )
        for kind in asked
        if kind not in kinds
    ]
    tasks = [replace(t, tables=_served_of(t, kinds), is_served=True) if isinstance(t, SampledTask) else t for t in source.tasks]
    return replace(source, tasks=tasks, odd=[*source.odd, *notices])


def _served_of(task: SampledTask, kinds: tuple[str, ...]) -> tuple[str, ...]:
    """The kinds of table of a task that are served; all served ones if none of its own is."""
    return tuple(kind for kind in kinds if kind in task.tables) or kinds


def _is_served(kind: str, seed: int, serves: Callable[[str], bool]) -> bool:
    """Whether the libraries have the objects of enough tasks of a table type."""
    drawn = (task_of_scene(sample_task(0, seed, (kind,), draw)) for draw in range(_REDRAWS))
    served = (task for task in drawn if not _missing(task, serves))
    return len(list(islice(served, _FEWEST_SERVED))) == _FEWEST_SERVED


def sample_tasks(count: int, seed: int = 0, kinds: Sequence[str] = ()) -> TaskSource:
    """Sampled tasks of the embedded world, different from the tasks of its scenes.

    Args:
        count: Number of tasks.
        seed: Task k depends on the seed and k alone.
        kinds: Table types to alternate; empty uses all types.

    Raises:
        ConfigError: ``invalid_count`` or ``unknown_table``.
    """
    if count < 1 or seed < 0:
        raise ConfigError(f"count is {count} and seed {seed}, expected at least 1 and 0", "invalid_count")
    for kind in kinds:
        plan_of(kind)
    return TaskSource(f"{count} sampled tasks", [SampledTask(number, seed, tuple(kinds)) for number in range(count)])


def tasks_of_file(path: Path) -> TaskSource:
    """The tasks of a file; format and errors are those of :func:`pipelines.sources.tasks.read_tasks`."""
    return TaskSource.of(path.name, read_tasks(path))


def task_of_instruction(instruction: str, table_type: str, size_cm: object, restricted_cm: object = None) -> TaskSource:
    """One task from a command line; the id of its scene is ``task``.

    Args:
        instruction: The instruction.
        table_type: The table type.
        size_cm: Width and depth of the table, cm.
        restricted_cm: x_min, x_max, y_min, y_max of the restricted zone, cm, or None.

    Raises:
        ConfigError: The task is invalid (``tasks_invalid``).
    """
    row = {"instruction": instruction, "table_type": table_type, "table_size_cm": size_cm, "restricted_zone_cm": restricted_cm}
    try:
        return TaskSource("one instruction", [task_of(row, "task")])
    except SceneError as error:
        raise ConfigError(f"the task's {error}", "tasks_invalid") from error


def tasks_of_scenes(place: str, where: str = "") -> TaskSource:
    """The tasks of existing scenes: their instructions, tables and fixed surroundings, without their other objects.

    Args:
        place: A run with a table ``scenes``, or a folder in the MesaTask-10K format.
        where: A condition on the scenes of a run, see :mod:`stable_data.storage.filter_expression`.

    Raises:
        ConfigError: The place is neither, or ``where`` is not a valid condition on a run.
    """
    if "://" in place or RunFolder(place).files("scenes"):
        source = TaskSource.of(Path(place).name, _of_run(RunFolder(place), where))
        stands = any(isinstance(task, LayoutTask) and (task.surroundings or task.frame) for task in source.tasks)
        return replace(source, supports=absolute_uri(place)) if stands else source
    if where:
        raise ConfigError(f"{place}: has no table scenes; a condition needs a run", "not_a_run")
    dataset = MesaTaskDataset(Path(place).expanduser().resolve())
    return TaskSource.of(dataset.root.name, _of_dataset(dataset))


def variants_of_scenes(
    place: str, axis: str, count: int = 1, where: str = "", limit: int | None = None, seed: int = 0
) -> TaskSource:
    """The variants of the scenes of a run, see :mod:`pipelines.sources.scene_variants`.

    Args:
        place: The run.
        axis: What differs, a value of :class:`~models.dual_system.variant_task.Axis`.
        count: Number of variants of each scene.
        where: A condition on the scenes, see :mod:`stable_data.storage.filter_expression`.
        limit: Number of scenes that are varied, at most; None: all.
        seed: The seed of the job, which is part of the ids.

    Raises:
        ConfigError: The axis is unknown (``usage``), the place is no run with scenes (``not_a_run``) and assets
            (``table_missing``), or no scene meets the condition (``tasks_invalid``).
    """
    variants, content = read_variants(place, axis, count, where, limit, seed)
    return TaskSource(f"variants of {Path(place).name}", variants, supports=absolute_uri(place), inputs={"scenes": content})


def _of_run(run: RunFolder, where: str) -> Iterator[LayoutTask | Notice]:
    query = parse_filter(where, schemas.SCHEMAS["scenes"]) if where.strip() else None
    for batch in run.batches("scenes", where=None if query is None else query.expression):
        for row in batch.to_pylist():
            try:
                scene = scene_from_row(row)
            except SceneError as error:
                yield Notice(str(row["scene_id"]), STEP, error.code, str(error))
            else:
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
        scene_id, STEP, "task_missing", f"{scene_id}: has no task info, expected an instruction; preprocess writes one"
    )
