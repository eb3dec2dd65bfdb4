"""The contract of a job, and how every job runs: locked, resumed under one configuration only, checked and counted."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any, ClassVar, Protocol

from pipelines.execution.code_history import record_code
from pipelines.execution.progress_bar import ProgressBar
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.resume import (
    OF_DATASET,
    REPLACED,
    check_resume,
    check_shards,
    count_items,
    count_rows,
    new_manifest,
)
from pipelines.execution.shard_step import ShardTask, ShardWriter, StepShards, add_schemas
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice
from stable_data.storage import schemas
from stable_data.storage.checksums import forget_shards, save_checksums
from stable_data.storage.manifest import COMPLETE, PLANNED, PlannedItems, read_manifest, write_manifest
from stable_data.storage.run_changes import PRUNED
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import notice_row

_SAVE_SECONDS = 30.0  # between two times that checksums are stored; a killed driver leaves the last ones to be computed


class JobSettings(Protocol):
    """Settings of a job: a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows; a run is resumed only if they are equal."""
        ...


@dataclass(frozen=True, slots=True)
class NoSettings:
    """The settings of a job without settings."""

    def shaping(self) -> dict[str, Any]:
        """None."""
        return {}


@dataclass(frozen=True, slots=True)
class ExpectedItems:
    """Items that must each be exactly one row of their table or one row of ``failures``.

    Attributes:
        table: The table of the usable items.
        column: The column of their ids.
        ids: Ids of all items.
        failed_key: The key of the number of failed items in the manifest.
        with_lost: Whether the items of :meth:`ShardJob.lost` are among ``ids``.
    """

    table: str
    column: str
    ids: Sequence[str]
    failed_key: str
    with_lost: bool = True


class ShardJob(ABC):
    """A job: items are split into shards, and steps turn the shards into tables. :func:`run_job` runs it.

    Attributes:
        name: The job's verb.
        dataset: Name of its input as a whole.
        settings: Its settings, fully resolved.
        growth: The numbers of items with which the run began and by which it grew; empty if it never grew.
        ADDED: Keys of :meth:`about` that must not change on a resume, if the former run has them.
        GROWS: What may differ from the former run if this job continues it with further items, as keys of the manifest.
    """

    ADDED: ClassVar[tuple[str, ...]] = ()
    GROWS: ClassVar[frozenset[str]] = frozenset()

    name: str
    dataset: str
    settings: JobSettings = NoSettings()
    growth: Sequence[int] = ()

    @abstractmethod
    def inputs(self) -> dict[str, Any]:
        """Hashes of all inputs by kind. An input that cannot be used is refused here, before anything is written."""

    def continuing(self, was: Mapping[str, Any]) -> "ShardJob":
        """The job as it continues a former run in its folder; a job that can grow keeps the shards of the former run.

        Args:
            was: The manifest of the former run.
        """
        return self

    @abstractmethod
    def plan(self) -> Sequence[StepShards[Any]]:
        """The steps with their shards; all of them may run at the same time."""

    @abstractmethod
    def expected(self) -> Sequence[ExpectedItems]:
        """The items that must be in each table."""

    def later_plans(self, folder: RunFolder) -> Iterator[Sequence[StepShards[Any]]]:
        """Further steps, each planned from the run's tables when all earlier steps are finished."""
        yield from ()

    def carried(self) -> Mapping[str, Set[str]]:
        """Ids of the shards that :meth:`finish` copies from another run, by table."""
        return {}

    def about(self) -> dict[str, Any]:
        """Further entries of the manifest, such as the number of items."""
        return {}

    def lost(self) -> Sequence[Notice]:
        """Items that failed before shards were planned."""
        return ()

    def odd(self) -> Sequence[Notice]:
        """Warnings about the input as a whole."""
        return ()

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Writes the outputs of the whole run after its shards are checked; returns further counts for the manifest."""
        return {}

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:  # noqa: B027 - a report is not a must
        """Writes the report page."""


def run_job(job: ShardJob, out: str, workers: WorkerPool, *, report: bool = True) -> dict[str, Any]:
    """Runs a job, or only its missing shards if it was started before.

    Args:
        job: The job.
        out: A local folder that every worker can write, or an object-store URI.
        workers: The workers that run the shards.
        report: Whether to write the report page.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or continue; finished shards are kept.
    """
    folder, inputs = RunFolder(out), job.inputs()  # bad inputs are refused before anything is written
    with folder.locked():
        was = read_manifest(folder)
        job = job if was is None else job.continuing(was)
        manifest = new_manifest(job.name, job.dataset, inputs, settings=_settings(job), work=[], **job.about())
        if job.growth:
            manifest["growth"] = list(job.growth)
        grown = job.GROWS if job.growth else frozenset[str]()
        check_resume(folder, manifest, job.settings.shaping(), may_be_added=job.ADDED, grown=grown)
        steps = list(job.plan())
        if was is not None and (list(job.growth) != was.get("growth", []) or PRUNED in was):
            _note_replaced(folder, manifest, _planned(steps))
        write_manifest(folder, manifest)
        _write_notices(folder, job)
        work = _run_missing(folder, manifest, steps, workers, job.name)
        for later in job.later_plans(folder):
            _run_missing(folder, manifest, later, workers, job.name)
            steps += later
        planned = _planned(steps)
        for table, shard_ids in manifest.pop(REPLACED, {}).items():
            folder.remove_shards(table, set(shard_ids) - planned.get(table, set()))
        check_shards(folder, planned, job.carried())
        counts = {
            **count_rows(folder, [table for table, shard_ids in planned.items() if shard_ids]),
            **{e.failed_key: count_items(folder, e.table, e.column, e.ids, with_lost=e.with_lost) for e in job.expected()},
            **job.finish(folder),
        }
        manifest |= {"status": COMPLETE, "counts": counts, "work": manifest["work"] + work, PLANNED: _planned_items(job)}
        manifest = write_manifest(folder, manifest)
        if report:
            job.report(folder, manifest)
    return manifest


def describe(job: ShardJob) -> dict[str, Any]:
    """Describes what a run would do: settings, inputs and counts, for ``--dry-run``."""
    inputs = job.inputs()
    return {
        "job": job.name,
        "dataset": job.dataset,
        "settings": _settings(job),
        "inputs": inputs,
        "input_fingerprint": content_id(inputs),
        **job.about(),
        "num_lost": len(job.lost()),
        "num_shards": sum(len(each.shards) for each in job.plan()),
    }


def _settings(job: ShardJob) -> dict[str, Any]:
    return asdict(job.settings) | job.settings.shaping()


def _write_notices(folder: RunFolder, job: ShardJob) -> None:
    """Writes the rows that belong to no shard."""
    for table, found in (("failures", job.lost()), ("warnings", job.odd())):
        if OF_DATASET not in folder.shard_ids(table):
            folder.write_shard(table, OF_DATASET, [notice_row(n) for n in found])


def _note_replaced(folder: RunFolder, manifest: dict[str, Any], planned: Mapping[str, set[str]]) -> None:
    """Notes in the manifest the shards of later steps: those steps are planned anew from the tables of the grown run."""
    was = manifest.get(REPLACED, {})
    found = {table: folder.shard_ids(table) - planned.get(table, set()) for table in schemas.SCHEMAS}
    manifest[REPLACED] = {table: sorted({*ids, *was.get(table, ())}) for table, ids in found.items() if ids or table in was}


def _planned_items(job: ShardJob) -> list[dict[str, Any]]:
    """The items of a job, for its manifest."""
    return [
        asdict(PlannedItems.of(e.table, e.column, e.ids, lost=e.with_lost, failed_key=e.failed_key)) for e in job.expected()
    ]


def _planned(steps: Sequence[StepShards[Any]]) -> dict[str, set[str]]:
    """The ids of the shards of each table."""
    planned = {"warnings": {OF_DATASET}, "failures": {OF_DATASET}}
    for each in steps:
        for table in each.step.TABLES:
            planned.setdefault(table, set()).update(shard.shard_id for shard in each.shards)
    return planned


def _run_missing(
    folder: RunFolder, manifest: dict[str, Any], steps: Sequence[StepShards[Any]], workers: WorkerPool, name: str
) -> list[dict[str, Any]]:
    """Processes the missing shards; if there are any, the current code version is recorded in the manifest.

    Args:
        folder: The run.
        manifest: Its manifest.
        steps: Steps that may run at the same time, with all their shards.
        workers: The workers.
        name: Name of the job on the progress bar.

    Returns:
        The seconds and the number of items, for the manifest; empty if no shard was missing.
    """
    for each in steps:
        add_schemas(each.step)
    missing = [ShardTask(number, shard) for number, each in enumerate(steps) for shard in each.missing(folder)]
    if not missing:
        return []
    if record_code(folder.uri, manifest):
        write_manifest(folder, manifest)
    anew: dict[str, set[str]] = {}
    for task in missing:
        for table in steps[task.step].step.TABLES:
            anew.setdefault(table, set()).add(task.shard.shard_id)
    forget_shards(folder, anew)
    total, left = sum(len(shard) for each in steps for shard in each.shards), sum(len(task.shard) for task in missing)
    units = {each.step.UNIT for each in steps}
    unit, began = units.pop() if len(units) == 1 else "item", perf_counter()
    with ExitStack() as shared:
        held = [shared.enter_context(each.step.sharing(workers)) for each in steps]
        tally = next((tally for _, tally in held if tally is not None), None)
        writer = ShardWriter(folder.root if folder.is_local else folder.uri, tuple(step for step, _ in held))
        with ProgressBar(name, unit, total, total - left, tally) as bar:
            saved = perf_counter()
            try:
                for ended, done in enumerate(workers.run(writer, missing), 1):
                    folder.written |= done.checksums
                    bar.count(done.num_items, done.num_failures, len(missing) - ended)
                    if perf_counter() - saved > _SAVE_SECONDS:
                        save_checksums(folder)
                        saved = perf_counter()
            except BaseException:
                with suppress(ConfigError):  # what ended the run is told, not that this fails too
                    save_checksums(folder)
                raise
            save_checksums(folder)
    return [{"seconds": round(perf_counter() - began, 1), f"{unit}s": left}]
