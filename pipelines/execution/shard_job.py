"""The contract of a job, and how every job runs: locked, resumed under one configuration only, checked and counted."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any, ClassVar, Protocol

from pipelines.execution.code_history import record_code
from pipelines.execution.progress_bar import ProgressBar
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.resume import (
    OF_DATASET,
    check_resume,
    check_shards,
    count_items,
    count_rows,
    new_manifest,
    write_manifest,
)
from pipelines.execution.shard_step import ShardTask, ShardWriter, StepShards, add_schemas
from stable_data.content_id import content_id
from stable_data.errors import Notice
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder


class JobSettings(Protocol):
    """Settings of a job: a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows: a run is resumed only under the same."""
        ...


@dataclass(frozen=True, slots=True)
class NoSettings:
    """Settings of a job without any."""

    def shaping(self) -> dict[str, Any]:
        """None."""
        return {}


@dataclass(frozen=True, slots=True)
class ExpectedItems:
    """Items each of which must be exactly one row of its table, or one of ``failures``.

    Attributes:
        table: Where the usable ones are.
        column: Their ids there.
        ids: All of them.
        failed_key: What those that failed are counted as, in the manifest.
        with_lost: Whether those of :meth:`ShardJob.lost` are among them.
    """

    table: str
    column: str
    ids: Sequence[str]
    failed_key: str
    with_lost: bool = True


class ShardJob(ABC):
    """A job: items cut into shards, which steps turn into tables. :func:`run_job` runs it.

    Attributes:
        name: The job's verb.
        dataset: Name of its input as a whole.
        settings: Its settings, with nothing left to be found out.
        ADDED: Keys of :meth:`about` that must be as they were, unless the former run had none of it.
    """

    ADDED: ClassVar[tuple[str, ...]] = ()

    name: str
    dataset: str
    settings: JobSettings = NoSettings()

    @abstractmethod
    def inputs(self) -> dict[str, Any]:
        """Content of all inputs by their kind; what cannot be used is refused here, before anything is written."""

    @abstractmethod
    def plan(self) -> Sequence[StepShards[Any]]:
        """The steps with their shards, done side by side."""

    @abstractmethod
    def expected(self) -> Sequence[ExpectedItems]:
        """Which items must be in which table."""

    def later_plans(self, folder: RunFolder) -> Iterator[Sequence[StepShards[Any]]]:
        """Further steps, each planned from the tables of the run when all before it are in place."""
        yield from ()

    def about(self) -> dict[str, Any]:
        """What else the manifest says of the job, such as how many items there are."""
        return {}

    def lost(self) -> Sequence[Notice]:
        """Items that are failures before there are shards."""
        return ()

    def odd(self) -> Sequence[Notice]:
        """What is odd about the input as a whole."""
        return ()

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Writes what is made of the whole run, once its shards are checked, and gives further counts for the manifest."""
        return {}

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:  # noqa: B027 - a report is not a must
        """Writes the report page."""


def run_job(job: ShardJob, out: str, workers: WorkerPool, *, report: bool = True) -> dict[str, Any]:
    """Runs a job, or what is missing of it.

    Args:
        job: The job.
        out: Local folder that every worker can write, or object-store URI.
        workers: Who runs the shards.
        report: Whether to write the report page.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    folder, inputs = RunFolder(out), job.inputs()  # what cannot be used is refused before anything is written
    with folder.locked():
        manifest = new_manifest(job.name, job.dataset, inputs, settings=_settings(job), work=[], **job.about())
        check_resume(folder, manifest, job.settings.shaping(), may_be_added=job.ADDED)
        write_manifest(folder, manifest)
        _write_notices(folder, job)
        steps = list(job.plan())
        work = _run_missing(folder, manifest, steps, workers, job.name)
        for later in job.later_plans(folder):
            _run_missing(folder, manifest, later, workers, job.name)
            steps += later
        planned = _planned(steps)
        check_shards(folder, planned)
        counts = {
            **count_rows(folder, [table for table, shard_ids in planned.items() if shard_ids]),
            **{e.failed_key: count_items(folder, e.table, e.column, e.ids, with_lost=e.with_lost) for e in job.expected()},
            **job.finish(folder),
        }
        manifest |= {"status": "complete", "counts": counts, "work": manifest["work"] + work}
        write_manifest(folder, manifest)
        if report:
            job.report(folder, manifest)
    return manifest


def describe(job: ShardJob) -> dict[str, Any]:
    """What a run would do: settings, inputs and counts, for ``--dry-run``."""
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
    """Rows that belong to no shard."""
    for table, found in (("failures", job.lost()), ("warnings", job.odd())):
        if OF_DATASET not in folder.shard_ids(table):
            folder.write_shard(table, OF_DATASET, [schemas.notice_row(n) for n in found])


def _planned(steps: Sequence[StepShards[Any]]) -> dict[str, set[str]]:
    """Ids of the shards of each table."""
    planned = {"warnings": {OF_DATASET}, "failures": {OF_DATASET}}
    for each in steps:
        for table in each.step.TABLES:
            planned.setdefault(table, set()).update(shard.shard_id for shard in each.shards)
    return planned


def _run_missing(
    folder: RunFolder, manifest: dict[str, Any], steps: Sequence[StepShards[Any]], workers: WorkerPool, name: str
) -> list[dict[str, Any]]:
    """Does the shards whose tables are not all in place; where there are any, the code of now is put into the manifest.

    Args:
        folder: The run.
        manifest: Of the run.
        steps: Steps that are done side by side, with all their shards.
        workers: Who does it.
        name: Of the job, on the progress bar.

    Returns:
        How long that took and for how many items, for the manifest; empty where nothing was missing.
    """
    for each in steps:
        add_schemas(each.step)
    missing = [ShardTask(number, shard) for number, each in enumerate(steps) for shard in each.missing(folder)]
    if not missing:
        return []
    if record_code(folder.uri, manifest):
        write_manifest(folder, manifest)
    total, left = sum(len(shard) for each in steps for shard in each.shards), sum(len(task.shard) for task in missing)
    units = {each.step.UNIT for each in steps}
    unit, began = units.pop() if len(units) == 1 else "item", perf_counter()
    with ExitStack() as shared:
        held = [shared.enter_context(each.step.sharing(workers)) for each in steps]
        tally = next((tally for _, tally in held if tally is not None), None)
        writer = ShardWriter(folder.root if folder.is_local else folder.uri, tuple(step for step, _ in held))
        with ProgressBar(name, unit, total, total - left, tally) as bar:
            for ended, (size, failures) in enumerate(workers.run(writer, missing), 1):
                bar.count(size, failures, len(missing) - ended)
    return [{"seconds": round(perf_counter() - began, 1), f"{unit}s": left}]
