"""The generate job: Algorithm 1 turns tasks into simulation-ready scenes, in this process or on a Ray cluster."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import asdict, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, ClassVar

from models.baselines.layout.prompts import FINGERPRINT as PROMPTS_FINGERPRINT
from models.physics_corrector.learned_flow import load_flow, weights_fingerprint
from models.semantic_reasoner.factory import proposal_config
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution.engine_pool import refuse_without_workers
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.generate.report import write_generate_report
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import GenerateWork
from pipelines.sources.asset_copies import CopyAssets, asset_shards
from pipelines.sources.assets import AssetLibraries, absolute_places
from pipelines.sources.generation_tasks import SampledTask, Task, TaskSource, fingerprints_of_tasks, served_tasks
from pipelines.sources.layout_files import LayoutFiles
from pipelines.sources.scene_variants import SceneVariant
from pipelines.sources.scenes import TableSource
from stable_data.content_id import content_id, content_id_of_items
from stable_data.embedded_world.library import NAME as EMBEDDED
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.storage.run_folder import RunFolder, absolute_uri


def generate(
    tasks: TaskSource,
    out: str,
    settings: GenerateSettings,
    workers: WorkerPool,
    assets: Sequence[str] = (),
    *,
    report: bool = True,
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_generation(GenerateJob(tasks, settings, assets), out, workers, report=report)


def run_generation(job: "GenerateJob", out: str, workers: WorkerPool, *, report: bool = True) -> dict[str, Any]:
    """Runs a job that is made already, and says on stderr what is odd about its input; see :func:`generate`.

    Raises:
        ConfigError: The run cannot start or continue; finished shards are kept.
    """
    job.check_workers(workers)
    for notice in job.odd():
        sys.stderr.write(f"{notice.message}\n")
    return run_job(job, out, workers, report=report)


class GenerateJob(ShardJob):
    """Turns tasks into simulation-ready scenes.

    Args:
        tasks: The tasks.
        settings: The job's settings.
        assets: The asset libraries, see :class:`pipelines.sources.assets.AssetLibraries`; every node of a cluster must see
            them.
    """

    name = "generate"
    settings: GenerateSettings
    GROWS: ClassVar = frozenset({"dataset", "inputs.tasks"})

    def __init__(self, tasks: TaskSource, settings: GenerateSettings, assets: Sequence[str] = ()) -> None:
        self._may_choose_size, settings = settings.scenes_per_shard == 0, settings.of_tasks(len(tasks.tasks))
        self._supports, places = tasks.supports, absolute_places(assets)
        places = places or (EMBEDDED,) * (tasks.supports is not None)
        self._asked_places = places  # tasks are drawn for these: the same tasks for each system
        if settings.layout_files:
            settings = replace(settings, layout_files=absolute_uri(settings.layout_files))
            self._supports, places = settings.layout_files, (*(places or (EMBEDDED,)), *filter(None, [tasks.supports]))
        if tasks.varies and settings.layout != "stages":
            raise ConfigError(
                f"layout is {settings.layout}, but a variant has the layout of its scene; leave out --vary, or set layout to stages",
                "usage",
            )
        if tasks.varies and tasks.supports is not None:  # whose assets serve first, as in edits
            places = tuple(dict.fromkeys((tasks.supports, *places)))
        self.dataset, self.settings, self.places, self._asked = tasks.name, settings, places, tasks

    def check_workers(self, workers: WorkerPool) -> None:
        """Refuses engines and correctors that nobody could share.

        Raises:
            ConfigError: There are some, but this process does the work (``config_invalid``).
        """
        for name in ("engines", "correctors"):
            refuse_without_workers(name, getattr(self.settings, name), workers)

    @cached_property
    def tasks(self) -> TaskSource:
        """The tasks, of which those that are sampled may be limited to what the libraries have."""
        if not self.settings.draws_served(self._asked_places):
            return self._asked
        advice = self.settings.serving_advice(self._asked_places)
        return served_tasks(self._asked, self._libraries.serves(self.settings.retrieval), advice)

    def layout_tasks(self) -> Iterator[LayoutTask]:
        """Yields the tasks, sampled ones as they are drawn in the run; a task that cannot be sampled is left out.

        Raises:
            ConfigError: The tasks are variants of scenes (``usage``).
        """
        serves = self._libraries.serves(self.settings.retrieval)
        for task in self.tasks.tasks:
            if isinstance(task, SceneVariant):
                raise ConfigError("variants are no tasks for other systems, expected no --vary; leave it out", "usage")
            with suppress(SceneError):  # in a run a row of failures
                yield task.sample(serves) if isinstance(task, SampledTask) else task

    @cached_property
    def _libraries(self) -> AssetLibraries:
        return AssetLibraries(self.places, scenes=self._supports, offers_scenes=False)

    @cached_property
    def _inputs(self) -> dict[str, Any]:
        settings, tasks = self.settings, self.tasks
        found: dict[str, Any] = {}
        if settings.corrects != "never" and settings.corrector == "stable":
            load_flow(settings.weights, settings.steps)
            found["weights"] = weights_fingerprint(settings.weights)
        if settings.layout in ("holodeck", "idesign"):
            found["prompts"] = PROMPTS_FINGERPRINT
        if settings.layout_files:
            found["layouts"] = LayoutFiles(settings.layout_files, self._libraries).fingerprint
        return found | {
            "tasks": self._hash_of_tasks(tasks.tasks),
            "reasoner": content_id(proposal_config(settings.engine, settings.reasoner)),
            **self._asked.inputs,
            **{f"assets.{library}": found for library, found in self._libraries.fingerprints.items()},
        }

    def inputs(self) -> dict[str, Any]:
        """Hashes of the tasks, the weights, the configuration of the reasoner and the libraries."""
        return self._inputs

    def about(self) -> dict[str, Any]:
        """The name of the engine and the number of tasks."""
        return {"engine": self.settings.engine.engine, "num_tasks": len(self.tasks.tasks) + len(self.tasks.lost)}

    def continuing(self, was: Mapping[str, Any]) -> "GenerateJob":
        """The job that adds its further tasks to a former run, whose tasks are the first of its own."""
        former = was.get("growth", [was.get("num_tasks", 0) - len(self.tasks.lost)])
        tasks, count = self.tasks.tasks, sum(former)
        grown = copy(self)
        if self._may_choose_size:  # the default size is that of the former number of tasks
            size = was["settings"].get("scenes_per_shard")
            grown.settings = replace(self.settings, scenes_per_shard=size or self.settings.scenes_per_shard)
        if not 0 < count <= len(tasks) or self._hash_of_tasks(tasks[:count]) != was["inputs"].get("tasks"):
            return self  # other tasks, which are refused
        added = [len(tasks) - count] * (count < len(tasks))
        grown.growth = [*former, *added] if added or "growth" in was else ()
        return grown

    def _hash_of_tasks(self, tasks: Sequence[Task]) -> str:
        return content_id_of_items(fingerprints_of_tasks(tasks), [asdict(notice) for notice in self.tasks.lost])

    def plan(self) -> Sequence[StepShards[Any]]:
        """One step over the tasks. The id of a shard is a hash of its own tasks and of the settings, not of other tasks."""
        shaping = self.settings.shaping(), {key: value for key, value in self._inputs.items() if key != "tasks"}
        ends = [*accumulate(self.growth or [len(self.tasks.tasks)])]
        parts = [self.tasks.tasks[start:end] for start, end in pairwise([0, *ends])]
        shards = [
            Shard(content_id("generate", *shaping, [*fingerprints_of_tasks(part)]), tuple(part))
            for grown in parts
            for part in split_groups(grown, self.settings.scenes_per_shard)
        ]
        return [StepShards(GenerateWork(self.places, self.settings, content_id(self._inputs), self._supports), shards)]

    def later_plans(self, folder: RunFolder) -> Iterator[Sequence[StepShards[Any]]]:
        """The step that copies the assets of the scenes. It runs last, after engines and workers have released their memory."""
        libraries = content_id(self._libraries.fingerprints)
        carry = CopyAssets(self.places, libraries, self.settings.seconds_per_item, self._supports)
        yield [StepShards(carry, asset_shards(folder, ("scenes", "rejected"), libraries))]

    def expected(self) -> Sequence[ExpectedItems]:
        """All tasks."""
        ids = [*(task.scene_id for task in self.tasks.tasks), *(notice.item_id for notice in self.tasks.lost)]
        return [ExpectedItems("scenes", "scene_id", ids, "failed_scenes")]

    def odd(self) -> Sequence[Notice]:
        """Licences of the libraries that are not allowed or unknown, table types without tasks, and a system without its model."""
        notices = [*self._libraries.licence_notices(self.settings.retrieval), *self.tasks.odd]
        layout = self.settings.layout
        dialect, chats = self.settings.reasoner.dialect, self.settings.chats
        own = "with the embedded model: it knows no other prompts than those of its training, so that"
        if layout in ("holodeck", "idesign") and not chats:
            message = (
                f"layout={layout} {own} objects and relations are those of its own layouts, and only the search is that of the system; "
                "name another model with --engine"
            )
            notices.append(Notice(layout, "reason", "own_prompts_only", message))
        if layout == "stages" and dialect in ("zero_shot", "mesatask") and not chats:
            message = (
                f"reasoner.dialect={dialect} {own} it is asked in its own form, and the layouts are no row of the paper's table; name "
                "another model with --engine"
            )
            notices.append(Notice(dialect, "reason", "own_prompts_only", message))
        if dialect == "mesatask" and chats:
            message = (
                "MesaTask's prompt has the environment, goal, actions and objects of a task, which its own pipeline lets a language model "
                "write first; here they are those of the scenes of --scenes, and empty for other tasks"
            )
            notices.append(Notice("mesatask", "reason", "task_info_short", message))
        place = self.settings.layout_files
        if place and (rejected := _num_rejected(place)):
            message = f"{place} has {rejected} scenes in its table rejected, which are not read; make that run with accept= to have all"
            notices.append(Notice(place, "layout", "rejected_not_read", message))
        return notices

    def lost(self) -> Sequence[Notice]:
        """The invalid tasks."""
        return self.tasks.lost

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page and the contact sheet."""
        sources = None
        if self._asked.varies and self._asked.supports is not None:
            sources = TableSource(self._asked.supports, self._libraries)
        library = self._libraries.usable(self.settings.retrieval)
        write_generate_report(folder, manifest, self.settings, library, sources)


def _num_rejected(place: str) -> int:
    folder = RunFolder(place)
    return folder.num_rows("rejected") if folder.shard_ids("rejected") else 0
