"""The steps of a job: a step turns one shard, or one item of a shard, into rows of tables, in any process."""

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Generic, Self, TypeAlias, TypeVar

import pyarrow as pa

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.progress_bar import ProgressTally
from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure, WorkerPool, item_limited
from stable_data.errors import ConfigError, Notice, StableDataError
from stable_data.limits import LIMITS, at_most, is_out_of_memory, map_large_arrays, release_free_memory
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import ROW_ERRORS, arrow_table, notice_row

Rows: TypeAlias = dict[str, list[schemas.Row]]
"""Rows by table."""

NOT_OF_AN_ITEM = (ConfigError, OSError)
"""Errors of the run or the machine, not of an item: a retry may succeed."""

_NO_ROWS = (*ROW_ERRORS, pa.ArrowException)
"""Errors of values that do not fit the schema of their table."""

CONTENT_ADDRESSED = {"textures": "sha256"}
"""Tables whose rows are named by their content, with that column."""

I = TypeVar("I")  # noqa: E741 - an item


@dataclass(frozen=True, slots=True)
class Shard(Generic[I]):
    """Items that are processed together.

    Attributes:
        shard_id: Hash of the items, their inputs and the settings that shape their rows.
        items: The items, picklable.
    """

    shard_id: str
    items: tuple[I, ...]

    def __len__(self) -> int:
        return len(self.items)

    def __str__(self) -> str:
        return f"shard {self.shard_id} ({len(self.items)} items)"


@dataclass(frozen=True, slots=True)
class ShardResult:
    """The result of a step for one shard.

    Attributes:
        rows: Rows by table. An item that cannot be used is a row of ``failures``.
        files: Further files by their path in the run's folder.
    """

    rows: Mapping[str, Sequence[schemas.Row]]
    files: Mapping[str, bytes] = field(default_factory=dict)


class ShardStep(ABC, Generic[I]):
    """A step that processes one shard. It is sent to the workers, so it must be picklable.

    Attributes:
        TABLES: Tables that a shard writes, in the order of writing, ``failures`` among them.
        SCHEMAS: Schemas of the tables that are not in :data:`stable_data.storage.schemas.SCHEMAS`.
        UNIT: Name of an item on the progress bar.
    """

    TABLES: ClassVar[tuple[str, ...]]
    SCHEMAS: ClassVar[Mapping[str, pa.Schema]] = {}
    UNIT: ClassVar[str] = "item"

    @abstractmethod
    def shard(self, shard: Shard[I], *, isolated: bool = False) -> ShardResult:
        """Computes the rows of a shard. The same shard gives the same rows in every process.

        Args:
            shard: The shard.
            isolated: Workers died while they processed this shard: each item runs in a separate process.

        Raises:
            ConfigError: The whole run cannot continue.
        """

    @contextmanager
    def sharing(self, workers: WorkerPool) -> Iterator[tuple[Self, ProgressTally | None]]:
        """Holds the resources that the workers share while shards are processed.

        Yields:
            The step as it is sent to the workers, and the tally that receives their progress, if there is one.
        """
        yield self, None


class ItemStep(ShardStep[I]):
    """A step that processes its items one by one.

    Attributes:
        OF_THE_RUN: Errors that end the run instead of failing an item, see :func:`rows_or_failure`.
    """

    OF_THE_RUN: ClassVar[tuple[type[Exception], ...]] = (ConfigError,)

    @property
    def seconds_per_item(self) -> float:
        """The time limit of an item, seconds; an item that takes longer fails. Not enforced without worker processes."""
        return 600.0

    def item_id(self, item: I) -> str:
        """The id of an item in its rows; by default the item as text."""
        return str(item)

    @abstractmethod
    def item_rows(self, item: I, progress: ItemProgress) -> Rows:
        """Computes the rows of one item.

        Args:
            item: The item.
            progress: Set its ``step`` before each part of the work; a failure names it.

        Raises:
            SceneError, MeshError: The item cannot be used; it becomes a row of ``failures``.
        """

    def prepare(self, item: I) -> None:
        """Opens what items need, such as a model. Its time does not count against the limit of an item."""

    def item(self, item: I) -> Rows:
        """The rows of one item, or its row of ``failures``."""
        progress = ItemProgress("read")
        return rows_or_failure(
            self.item_id(item), progress, partial(self.item_rows, item, progress), of_the_run=self.OF_THE_RUN
        )

    def shard(self, shard: Shard[I], *, isolated: bool = False) -> ShardResult:
        """Computes the rows of a shard, item by item. Content that several items share is one row of the shard."""
        rows: Rows = defaultdict(list)
        for item in shard.items:
            for table, found in (self._isolated_rows(item) if isolated else self._limited_rows(item)).items():
                rows[table] += found
        for table in rows.keys() & CONTENT_ADDRESSED.keys():
            rows[table] = list({row[CONTENT_ADDRESSED[table]]: row for row in rows[table]}.values())
        return ShardResult(rows)

    def _limited_rows(self, item: I) -> Rows:
        self.prepare(item)
        with item_limited(self.seconds_per_item):
            return self.item(item)

    def _isolated_rows(self, item: I) -> Rows:
        with IsolatedProcess(partial(self.prepare, item)) as process:
            return rows_isolated(process, self.item, item, self.item_id(item), seconds=self.seconds_per_item)


@dataclass(frozen=True, slots=True)
class StepShards(Generic[I]):
    """A step and all its shards in a run.

    Attributes:
        step: The step.
        shards: Its shards; if there are none, its tables must be empty.
    """

    step: ShardStep[I]
    shards: Sequence[Shard[I]]

    def missing(self, folder: RunFolder) -> list[Shard[I]]:
        """Shards of which at least one table is not yet written."""
        present = [folder.shard_ids(table) for table in self.step.TABLES]
        return [shard for shard in self.shards if not all(shard.shard_id in there for there in present)]


@dataclass(frozen=True, slots=True)
class ShardTask:
    """A shard to be processed.

    Attributes:
        step: Index of its step in :attr:`ShardWriter.steps`.
        shard: The shard.
    """

    step: int
    shard: Shard[Any]

    def __str__(self) -> str:
        return str(self.shard)


@dataclass(frozen=True, slots=True)
class WrittenShard:
    """What a worker tells of a shard that it has written.

    Attributes:
        num_items: Number of items of the shard.
        num_failures: Number of failed items.
        checksums: File of the shard, ``table/part-id.parquet`` -> SHA-256.
    """

    num_items: int
    num_failures: int
    checksums: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ShardWriter:
    """Processes shards of several steps and writes their tables; sent to the workers.

    Attributes:
        out: The run's folder, writable for every worker: an absolute path or a URI.
        steps: The steps.
    """

    out: str
    steps: tuple[ShardStep[Any], ...]

    def __call__(self, shard: ShardTask, *, isolated: bool = False) -> WrittenShard:
        """Processes one shard and writes its tables.

        Args:
            shard: The shard and its step.
            isolated: See :meth:`ShardStep.shard`.
        """
        step, items, folder = self.steps[shard.step], shard.shard, RunFolder(self.out)
        add_schemas(step)
        map_large_arrays()
        release_free_memory()  # of the shard before, all of which has ended: within a shard, what is still in use keeps the heap large
        made = step.shard(items, isolated=isolated)
        try:
            tables = _arrow_tables(made.rows, step.TABLES)
        except _NO_ROWS:
            if isolated:
                raise
            # One by one, the items whose rows cannot be written are found, and fail alone.
            made = step.shard(items, isolated=True)
            tables = _arrow_tables(made.rows, step.TABLES)
        for name, content in made.files.items():
            folder.write_bytes(name, content)
        for name, table in tables.items():
            folder.write_table(name, items.shard_id, table)
        return WrittenShard(len(items), len(made.rows.get("failures", ())), folder.written)


def _arrow_tables(rows: Mapping[str, Sequence[schemas.Row]], names: Iterable[str]) -> dict[str, pa.Table]:
    """The tables of these names, in their order; raises what is in :data:`_NO_ROWS` if rows are not as their schema says."""
    return {name: arrow_table(name, rows.get(name, ())) for name in names}


def add_schemas(step: ShardStep[Any]) -> None:
    """Registers the tables of a step in this process."""
    for table, schema in step.SCHEMAS.items():
        schemas.add_table(table, schema)


def rows_or_failure(
    item_id: str, progress: ItemProgress, make: Callable[[], Rows], *, of_the_run: tuple[type[Exception], ...] = (ConfigError,)
) -> Rows:
    """The rows of one item, or a row of ``failures`` with the step and the reason if the item cannot be used.

    Args:
        item_id: The id of the item in its failure.
        progress: The current step of the item.
        make: Computes the rows.
        of_the_run: Errors that are raised because they end the run. Foreign data may cause any error except ConfigError; a job
            that creates its items itself can name further errors.

    Raises:
        ConfigError: The whole run cannot continue.
    """
    try:
        return make()
    except of_the_run:
        raise
    except StableDataError as error:
        return {"failures": [notice_row(Notice(item_id, progress.step, error.code, str(error)))]}
    except Exception as error:  # noqa: BLE001 - the one place where an unexpected error becomes a row
        return {"failures": [notice_row(unexpected_notice(item_id, progress.step, error))]}


def unexpected_notice(item_id: str, step: str, error: Exception) -> Notice:
    """The notice of an item that failed with an error that is none of this project."""
    code = str(ProcessFailure.OUT_OF_MEMORY) if is_out_of_memory(error) else "unexpected"
    return Notice(item_id, step, code, f"{item_id}: {unexpected_failure(error)}")


def batch_notices(item_id: str, num_items: int, failure: str) -> list[Notice]:
    """The warning that items were computed one by one, because else nobody sees a fault that only their batch has.

    Args:
        item_id: The first of the items.
        num_items: Their number; one item is no batch and has no warning.
        failure: How the batch has failed, one line.

    Returns:
        One notice, or none.
    """
    if num_items == 1:
        return []
    others = f"{item_id} and {num_items - 1} other{'s' * (num_items > 2)}"
    message = f"{others}: the batch failed, and each was computed alone: {failure.removeprefix(f'{item_id}: ')}"
    return [Notice(item_id, "batch", "batch_failed", message)]


def batch_failure(error: Exception, num_items: int) -> str:
    """The message for an error of a batch of ``num_items`` items, one line."""
    if is_out_of_memory(error):
        return f"it {ProcessFailure.OUT_OF_MEMORY.told(0.0, num_items)}"
    return str(error) if isinstance(error, StableDataError) else unexpected_failure(error)


def unexpected_failure(error: Exception) -> str:
    """The message for an error that is none of this project, one line."""
    if is_out_of_memory(error):
        return f"memory is not enough for it, a worker has {at_most(LIMITS.item, 'max_memory_bytes', 'bytes')}; is it hostile?"
    return f"{type(error).__name__}: {' '.join(str(error).split())}; please report this with the file"


def rows_isolated(process: IsolatedProcess, make: Callable[[I], Rows], item: I, item_id: str, *, seconds: float) -> Rows:
    """The rows of one item from a separate process; a failure if that process dies or takes too long, or if they cannot be written."""
    found = process.call(make, item, seconds=seconds)
    if isinstance(found, ProcessFailure):
        return failed_process(found, item_id, seconds)
    try:
        _arrow_tables(found, found)
    except _NO_ROWS as error:
        return {"failures": [notice_row(Notice(item_id, "write", "unexpected", f"{item_id}: {unexpected_failure(error)}"))]}
    return found


def failed_process(found: ProcessFailure, item_id: str, seconds: float) -> Rows:
    """The row of ``failures`` of an item whose separate process ended without a result; ``seconds`` is its time limit."""
    message = f"{item_id}: it {found.told(seconds)}; is it hostile?"
    return {"failures": [notice_row(Notice(item_id, "isolate", str(found), message))]}


def engine_stopped(failure: str) -> ConfigError:
    """The error that stops a run if its engine no longer answers, see :data:`models.semantic_reasoner.engines.protocol.OFF`."""
    return ConfigError(f"{failure}; finished shards are kept, run again to continue", "engine_off")
