"""The steps of a job: what is done with one shard, or with one item of a shard, in whatever process."""

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Generic, Self, TypeAlias, TypeVar

import pyarrow as pa

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.progress_bar import ProgressTally
from pipelines.execution.ray_executor import ProcessFailure, WorkerPool, run_isolated, time_limited
from stable_data.errors import ConfigError, Notice, StableDataError
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

Rows: TypeAlias = dict[str, list[schemas.Row]]
"""Rows by table."""

I = TypeVar("I")  # noqa: E741 - an item


@dataclass(frozen=True, slots=True)
class Shard(Generic[I]):
    """Items that are done together.

    Attributes:
        shard_id: Content of the items, of all that they are made from and of the settings that shape their rows.
        items: The items; they can be pickled.
    """

    shard_id: str
    items: tuple[I, ...]

    def __len__(self) -> int:
        return len(self.items)

    def __str__(self) -> str:
        return f"shard {self.shard_id} ({len(self.items)} items)"


@dataclass(frozen=True, slots=True)
class ShardResult:
    """What a step makes of a shard.

    Attributes:
        rows: Rows of its tables; an item that cannot be used is a row of ``failures``.
        files: Further files of the run's folder, by their path in it.
    """

    rows: Mapping[str, Sequence[schemas.Row]]
    files: Mapping[str, bytes] = field(default_factory=dict)


class ShardStep(ABC, Generic[I]):
    """What is done with one shard; sent to the workers, so it can be pickled.

    Attributes:
        TABLES: Tables of a shard, in the order in which they are put in place; ``failures`` is one of them.
        SCHEMAS: Schemas of those tables that are not in :data:`stable_data.storage.schemas.SCHEMAS`.
        UNIT: What an item is called on the progress bar.
    """

    TABLES: ClassVar[tuple[str, ...]]
    SCHEMAS: ClassVar[Mapping[str, pa.Schema]] = {}
    UNIT: ClassVar[str] = "item"

    @abstractmethod
    def shard(self, shard: Shard[I], *, isolated: bool = False) -> ShardResult:
        """Makes the rows of a shard; the same shard gives the same rows in whatever process.

        Args:
            shard: The shard.
            isolated: Workers died over this shard: what may end a process is done in one of its own, item by item.

        Raises:
            ConfigError: The run itself cannot go on.
        """

    @contextmanager
    def sharing(self, workers: WorkerPool) -> Iterator[tuple[Self, ProgressTally | None]]:
        """Holds what the workers share as long as shards are done.

        Yields:
            The step as it is sent to the workers, and whom they tell of their progress.
        """
        yield self, None


class ItemStep(ShardStep[I]):
    """A step whose items are made one by one.

    Attributes:
        OF_THE_RUN: Errors that are not an item's but the run's, see :func:`rows_or_failure`.
    """

    OF_THE_RUN: ClassVar[tuple[type[Exception], ...]] = (ConfigError,)

    @property
    def seconds_per_item(self) -> float:
        """An item that takes longer is a failure; not watched without worker processes."""
        return 600.0

    def item_id(self, item: I) -> str:
        """What the rows of an item are named by; by default the item itself."""
        return str(item)

    @abstractmethod
    def item_rows(self, item: I, progress: ItemProgress) -> Rows:
        """Makes the rows of one item.

        Args:
            item: The item.
            progress: Is told of each step, which a failure names.

        Raises:
            SceneError, MeshError: The item cannot be used; that becomes a row of ``failures``.
        """

    def prepare(self, item: I) -> None:
        """Opens what an item needs, outside of the time of the first one."""

    def item(self, item: I) -> Rows:
        """Rows of one item, or its row of ``failures``."""
        progress = ItemProgress("read")
        return rows_or_failure(
            self.item_id(item), progress, partial(self.item_rows, item, progress), of_the_run=self.OF_THE_RUN
        )

    def shard(self, shard: Shard[I], *, isolated: bool = False) -> ShardResult:
        """Makes the rows of a shard, item by item."""
        rows: Rows = defaultdict(list)
        for item in shard.items:
            for table, found in (self._alone(item) if isolated else self._limited(item)).items():
                rows[table] += found
        return ShardResult(rows)

    def _limited(self, item: I) -> Rows:
        self.prepare(item)
        with time_limited(self.seconds_per_item):
            return self.item(item)

    def _alone(self, item: I) -> Rows:
        seconds = self.seconds_per_item
        return rows_alone(self.item, item, self.item_id(item), seconds=seconds, prepare=partial(self.prepare, item))


@dataclass(frozen=True, slots=True)
class StepShards(Generic[I]):
    """A step and all its shards in a run.

    Attributes:
        step: The step.
        shards: Its shards; where there are none its tables must be empty.
    """

    step: ShardStep[I]
    shards: Sequence[Shard[I]]

    def missing(self, folder: RunFolder) -> list[Shard[I]]:
        """Shards whose tables are not all in place."""
        present = [folder.shard_ids(table) for table in self.step.TABLES]
        return [shard for shard in self.shards if not all(shard.shard_id in there for there in present)]


@dataclass(frozen=True, slots=True)
class ShardTask:
    """A shard that is to be done.

    Attributes:
        step: Number of its step, in the order of :attr:`ShardWriter.steps`.
        shard: The shard.
    """

    step: int
    shard: Shard[Any]

    def __str__(self) -> str:
        return str(self.shard)


@dataclass(frozen=True, slots=True)
class ShardWriter:
    """Does shards of several steps and puts their tables in place; sent to the workers.

    Attributes:
        out: The run's folder, which every worker can write: an absolute path, or a URI.
        steps: The steps.
    """

    out: str
    steps: tuple[ShardStep[Any], ...]

    def __call__(self, shard: ShardTask, *, isolated: bool = False) -> tuple[int, int]:
        """Does one shard.

        Args:
            shard: The shard and its step.
            isolated: See :meth:`ShardStep.shard`.

        Returns:
            How many items the shard has, and how many of them failed.
        """
        step, items, folder = self.steps[shard.step], shard.shard, RunFolder(self.out)
        add_schemas(step)
        made = step.shard(items, isolated=isolated)
        for name, content in made.files.items():
            folder.write_bytes(name, content)
        for table in step.TABLES:
            folder.write_shard(table, items.shard_id, made.rows.get(table, ()))
        return len(items), len(made.rows.get("failures", ()))


def add_schemas(step: ShardStep[Any]) -> None:
    """Makes the tables of a step known to this process."""
    for table, schema in step.SCHEMAS.items():
        schemas.add_table(table, schema)


def rows_or_failure(
    item_id: str, progress: ItemProgress, make: Callable[[], Rows], *, of_the_run: tuple[type[Exception], ...] = (ConfigError,)
) -> Rows:
    """Rows of one item; where it cannot be used, a row of ``failures`` that says in which step and why.

    Args:
        item_id: What a failure is named by.
        progress: Which step it is at.
        make: Makes the rows.
        of_the_run: Errors that are not the item's but the run's, and are raised. What is read from outside can bring forth any
            but ConfigError; a job that makes its items itself names those that may pass, too.

    Raises:
        ConfigError: The run itself cannot go on.
    """
    try:
        return make()
    except of_the_run:
        raise
    except StableDataError as error:
        return {"failures": [schemas.notice_row(Notice(item_id, progress.step, error.code, str(error)))]}
    except Exception as error:  # noqa: BLE001 - the one place where what nobody foresaw becomes a row
        message = f"{item_id}: {unexpected_failure(error)}"
        return {"failures": [schemas.notice_row(Notice(item_id, progress.step, "unexpected", message))]}


def unexpected_failure(error: Exception) -> str:
    """What is said of an error that nobody foresaw, one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}; please report this with the file"


def rows_alone(
    make: Callable[[I], Rows], item: I, item_id: str, *, seconds: float, prepare: Callable[[], object] | None = None
) -> Rows:
    """Rows of one item, made in a process of its own; a failure where that process dies or takes too long."""
    found = run_isolated(make, item, seconds=seconds, prepare=prepare)
    if not isinstance(found, ProcessFailure):
        return found
    hint = {
        ProcessFailure.CRASHED: "the process that read it died; is the file hostile?",
        ProcessFailure.TIMED_OUT: f"took over {seconds:g} s; is it hostile, or is seconds_per_item too short for it?",
    }[found]
    return {"failures": [schemas.notice_row(Notice(item_id, "isolate", str(found), f"{item_id}: {hint}"))]}


def engine_stopped(failure: str) -> ConfigError:
    """What stops a run whose engine answers nothing any more, see :data:`models.semantic_reasoner.engines.protocol.OFF`."""
    return ConfigError(f"{failure}; what is done is kept, run again to go on", "engine_off")
