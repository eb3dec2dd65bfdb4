"""Live progress: finished shards, throughput, and the steps that the items of the running shards have reached.

Progress is for display only, and no row depends on it. Each worker reports once a second, changed or not, so a lost message is
repeated; a worker that stays silent for a while is not counted.
"""

import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from threading import Event, Thread
from time import perf_counter
from typing import Any, Protocol, TypeAlias

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
from tqdm import tqdm

from pipelines.execution.ray_executor import ACTOR

Where: TypeAlias = Mapping[str, int]
"""Number of items by the step that they have reached, in the words of the progress bar."""

_REPORT_SECONDS = 1.0  # between two reports of a worker about one shard
_SILENT_SECONDS = 60.0  # after which a silent worker counts as lost; long C calls can delay a report
_SHOW_SECONDS = 1.0  # between two updates of the bar
_LOG_SECONDS = 30.0  # the same without a terminal, where each update is a line of a log
_PATIENCE_SECONDS = 5.0  # time limit for an answer of the tally
_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} {unit}s [{elapsed}<{remaining}{postfix}]"


class ProgressTally(Protocol):
    """Counts the items of the running shards by the step that they have reached."""

    def note(self, shard_id: str, where: Where) -> None:
        """Stores a worker's report on its shard; an empty report means that the shard is done."""
        ...

    def total(self) -> dict[str, int]:
        """The number of items of all running shards, by step."""
        ...


@dataclass(slots=True)
class LocalTally:
    """A tally in this process."""

    _of: dict[str, tuple[float, Where]] = field(default_factory=dict)

    def note(self, shard_id: str, where: Where) -> None:
        """Stores a worker's report on its shard."""
        if where:
            self._of[shard_id] = perf_counter(), where
        else:
            self._of.pop(shard_id, None)

    def total(self) -> dict[str, int]:
        """The number of items by step, over all shards with a recent report."""
        found: Counter[str] = Counter()
        for reported, where in list(self._of.values()):
            if perf_counter() - reported <= _SILENT_SECONDS:
                found.update(where)
        return dict(found)


@dataclass(frozen=True, slots=True, eq=False)
class SharedTally:
    """A tally in an actor that workers on all nodes can reach; sent to them.

    Attributes:
        actor: The Ray actor of a :class:`LocalTally`.
    """

    actor: Any

    @classmethod
    def started(cls) -> "SharedTally":
        """Starts the actor on the node of this process; it reserves no core."""
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        return cls(ray.remote(scheduling_strategy=here, **ACTOR)(LocalTally).remote())

    def note(self, shard_id: str, where: Where) -> None:
        """Sends a worker's report; does not wait."""
        self.actor.note.remote(shard_id, dict(where))

    def total(self) -> dict[str, int]:
        """The number of items of all running shards, by step.

        Raises:
            RayError: The tally does not answer.
        """
        found: dict[str, int] = ray.get(self.actor.total.remote(), timeout=_PATIENCE_SECONDS)
        return found


class ProgressReporter:
    """Reports the progress of one shard to a tally. Used in a ``with`` statement, which ends when the shard is done.

    Args:
        tally: The tally, or None to report nothing.
        shard_id: The shard.
        where: Number of items by step at the start.
    """

    def __init__(self, tally: ProgressTally | None, shard_id: str, **where: int) -> None:
        self._tally, self._shard_id = tally, shard_id
        self._where: Where = where
        self._end, self._thread = Event(), Thread(target=self._report, name="progress reporter", daemon=True)

    def __enter__(self) -> "ProgressReporter":
        """Starts the reports."""
        if self._tally is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Reports that the shard is done or given up."""
        if self._tally is not None:
            self._end.set()
            self._thread.join()

    def __call__(self, **where: int) -> None:
        """Sets the number of items by step."""
        self._where = where

    def _report(self) -> None:
        assert self._tally is not None
        try:
            self._tally.note(self._shard_id, self._where)
            while not self._end.wait(_REPORT_SECONDS):
                self._tally.note(self._shard_id, self._where)
            self._tally.note(self._shard_id, {})
        except Exception:  # noqa: BLE001 - the display is lost; the shard must continue
            return


class ProgressBar:
    """The progress bar of a job. Used in a ``with`` statement.

    Args:
        name: Name of the job.
        unit: Name of an item.
        total: Number of items of the job.
        initial: Number of items that are already finished.
        tally: The tally of running items, or None to show finished items only.
    """

    def __init__(self, name: str, unit: str, total: int, initial: int, tally: ProgressTally | None = None) -> None:
        self._bar = tqdm(total=total, initial=initial, desc=name, unit=unit, bar_format=_BAR)
        self._tally, self._done, self._failed, self._left = tally, 0, 0, 0
        self._began, self._end = perf_counter(), Event()
        self._thread = Thread(target=self._update, name="progress", daemon=True)

    def __enter__(self) -> "ProgressBar":
        """Starts to show the tally."""
        if self._tally is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the bar."""
        self._end.set()
        if self._tally is not None:
            self._thread.join()
        self._bar.set_postfix_str(self._postfix({}), refresh=False)
        self._bar.close()

    def count(self, size: int, failures: int, left: int) -> None:
        """Counts a finished shard.

        Args:
            size: Number of its items.
            failures: Number of its failed items.
            left: Number of shards that remain.
        """
        self._done += size
        self._failed += failures
        self._left = left
        self._bar.set_postfix_str(self._postfix({}), refresh=False)
        self._bar.update(size)

    def _postfix(self, where: Where) -> str:
        """The text after the bar; a narrow terminal cuts off its end."""
        now = ", ".join(f"{count} {name}" for name, count in where.items() if count)
        if not self._done:
            return now
        rate = 60 * self._done / max(perf_counter() - self._began, 1e-9)
        valid = 100 * (self._done - self._failed) / self._done
        so_far = f"{rate:.0f}/min, {valid:.1f} % valid"
        return "; ".join(filter(None, (so_far, now, f"{self._left} shards left")))

    def _update(self) -> None:
        assert self._tally is not None
        while not self._end.wait(_SHOW_SECONDS if sys.stderr.isatty() else _LOG_SECONDS):
            try:
                self._bar.set_postfix_str(self._postfix(self._tally.total()))
            except ray.exceptions.RayError:
                continue  # Ray restarts the actor
            except Exception:  # noqa: BLE001 - the display is lost; the run must continue
                return
