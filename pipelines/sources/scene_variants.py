"""The variants that are made of the scenes of a run: which ones there are, and the scene of each."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from models.dual_system.variant_task import Axis, VariantTask
from pipelines.sources.scenes import TableSource
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, SceneError
from stable_data.metrics.alignment import reference_of
from stable_data.storage import schemas
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

_NEED_TASK = frozenset({Axis.LAYOUT, Axis.CLUTTER})


@dataclass(frozen=True, slots=True)
class SceneVariant:
    """A variant whose scene a worker reads when it needs it, so that a million of them need little memory.

    Attributes:
        source_id: The scene that is varied.
        axis: What differs.
        number: Which of the variants of the scene it is, from 1.
        seed: The seed of the job.
    """

    source_id: str
    axis: Axis
    number: int = 1
    seed: int = 0

    @property
    def scene_id(self) -> str:
        """The id of the variant. It contains the seed, so that runs with different seeds can be joined."""
        return f"{self.source_id}~{self.axis}_{self.number}" + (f"_seed{self.seed}" if self.seed else "")

    def read(self, run: TableSource) -> VariantTask:
        """Reads the scene.

        Args:
            run: The run of the scene.

        Raises:
            SceneError: The axis needs a task, and the scene has none (``task_missing``); or the row contains no valid scene.
        """
        row = run.row(self.source_id)
        scene = scene_from_row(row)
        if scene.task is None and self.axis in _NEED_TASK:
            raise SceneError(
                f"{self.scene_id}: {self.source_id} has no task info, expected one to vary its {self.axis}; vary its task first",
                "task_missing",
            )
        reference = None
        with suppress(SceneError):
            reference = reference_of(scene)
        return VariantTask(
            self.scene_id,
            "" if scene.task is None else scene.task.task,
            scene.table,
            reference=reference,
            surroundings=scene.surroundings,
            frame=scene.frame,
            source=scene,
            axis=self.axis,
            number=self.number,
            split=row["split"],
            duplicate_group=row["duplicate_group"],
        )


def read_variants(
    place: str, axis: str, count: int, where: str, limit: int | None, seed: int
) -> tuple[Sequence[SceneVariant], str]:
    """Lists the variants of the scenes of a run; the variants of a scene follow one another.

    Args:
        place: The run.
        axis: What differs.
        count: Number of variants of each scene.
        where: A condition on the scenes; empty: all.
        limit: Number of scenes, at most; None: all.
        seed: The seed of the job.

    Returns:
        The variants, and a hash of the scenes.

    Raises:
        ConfigError: See :func:`pipelines.sources.generation_tasks.variants_of_scenes`.
    """
    if axis not in list(Axis):
        raise ConfigError(f"--vary is {axis!r}, expected one of {', '.join(Axis)}", "usage")
    if count < 1 or (limit is not None and limit < 1):
        found = f"--variants is {count}" if count < 1 else f"--limit is {limit}"
        raise ConfigError(f"{found}, expected at least 1", "invalid_count")
    run = RunFolder(place)
    if not ("://" in place or run.files("scenes")):
        raise ConfigError(
            f"{place}: has no table scenes, expected a run to vary its scenes; preprocess or import-scenes makes one",
            "not_a_run",
        )
    for table in ("assets", "meshes"):
        if not run.files(table):
            raise ConfigError(
                f"{place}: has no table {table}, expected the assets of its scenes beside them; make the run again",
                "table_missing",
            )
    query = parse_filter(where, schemas.SCHEMAS["scenes"]) if where.strip() else None
    batches = run.batches("scenes", ["scene_id"], where=None if query is None else query.expression)
    names = [name for batch in batches for name in batch["scene_id"].to_pylist()][:limit]
    if not names:
        why = f"no scene meets {where!r}" if where.strip() else "its table scenes is empty"
        raise ConfigError(f"{place}: {why}, expected at least one scene to vary", "tasks_invalid")
    variants = [SceneVariant(name, Axis(axis), number, seed) for name in names for number in range(1, count + 1)]
    return variants, content_id(sorted(run.shard_ids("scenes")))
