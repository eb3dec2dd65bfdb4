"""Live progress: what is in place, how fast it comes, and where the items of the shards are that are being done.

All of it is for the eye: what is lost on the way to the driver is told again a moment later, and no row depends on it.
"""

import sys
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Event, Thread
from time import perf_counter
from types import TracebackType
from typing import Any, Protocol, TypeAlias

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
from tqdm import tqdm

Where: TypeAlias = Mapping[str, int]
"""How many items are where, in the words of the progress bar."""

_TELL_SECONDS = 1.0  # between two messages of a worker about one shard
_SHOW_SECONDS = 1.0  # between two looks at the tally
_LOG_SECONDS = 30.0  # likewise where nobody looks at a terminal, and each look is a line of a log
_PATIENCE_SECONDS = 5.0  # with a tally that does not answer


class Tally(Protocol):
    """Keeps where the items of the shards are that are being done."""

    def note(self, shard_id: str, where: Where) -> None:
        """Takes what a worker tells of its shard; nothing: the shard is done."""
        ...

    def total(self) -> dict[str, int]:
        """Items of all shards by where they are."""
        ...


@dataclass(slots=True)
class OwnTally:
    """A tally in this process."""

    _of: dict[str, Where] = field(default_factory=dict)

    def note(self, shard_id: str, where: Where) -> None:
        """Takes what a worker tells of its shard."""
        self._of[shard_id] = where
        if not where:
            del self._of[shard_id]

    def total(self) -> dict[str, int]:
        """Items of all shards by where they are."""
        found: Counter[str] = Counter()
        for where in list(self._of.values()):
            found.update(where)
        return dict(found)


@dataclass(frozen=True, slots=True, eq=False)
class SharedTally:
    """A tally in a process of its own that workers on all nodes reach; sent to them.

    Attributes:
        actor: The process.
    """

    actor: Any

    @classmethod
    def started(cls) -> "SharedTally":
        """One beside the driver, on the cluster that this process is connected to; it takes no core from the work."""
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        return cls(ray.remote(num_cpus=0, scheduling_strategy=here)(OwnTally).remote())

    def note(self, shard_id: str, where: Where) -> None:
        """Sends what a worker tells of its shard; waits for nothing."""
        self.actor.note.remote(shard_id, dict(where))

    def total(self) -> dict[str, int]:
        """Items of all shards by where they are; none where the tally does not answer."""
        with suppress(ray.exceptions.RayError):
            found: dict[str, int] = ray.get(self.actor.total.remote(), timeout=_PATIENCE_SECONDS)
            return found
        return {}


@dataclass(slots=True)
class Telling:
    """Tells a tally where the items of one shard are, now and then. Used in a ``with`` statement, at whose end the shard is done.

    Attributes:
        tally: The tally; None: nobody looks.
        shard_id: The shard.
    """

    tally: Tally | None
    shard_id: str
    _next: float = 0.0

    def __enter__(self) -> "Telling":
        """Tells nothing yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """Tells that the shard is done, or given up."""
        if self.tally is not None:
            self.tally.note(self.shard_id, {})

    def __call__(self, *, at_once: bool = False, **where: int) -> None:
        """Tells how many items are where, unless that was told a moment ago and need not be told at once."""
        now = perf_counter()
        if self.tally is not None and (at_once or now >= self._next):
            self._next = now + _TELL_SECONDS
            self.tally.note(self.shard_id, where)


class LiveBar:
    """The progress bar of a job. Used in a ``with`` statement.

    Args:
        name: Of the job.
        unit: Of what is counted.
        total: How many items there are.
        initial: How many are in place already.
        tally: Where those are that are being done; None: that is not shown.
    """

    def __init__(self, name: str, unit: str, total: int, initial: int, tally: Tally | None = None) -> None:
        self._bar = tqdm(total=total, initial=initial, desc=name, unit=unit)
        self._tally, self._said, self._done, self._failed = tally, "", 0, 0
        self._began, self._end = perf_counter(), Event()
        self._thread = Thread(target=self._look, name="progress", daemon=True)

    def __enter__(self) -> "LiveBar":
        """Begins to look at the tally."""
        if self._tally is not None:
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Leaves the bar as it is."""
        self._end.set()
        if self._tally is not None:
            self._thread.join()
        self._bar.set_postfix_str(self._said, refresh=False)
        self._bar.close()

    def count(self, size: int, failures: int, left: int) -> None:
        """A shard is in place.

        Args:
            size: Its items.
            failures: How many of them failed.
            left: How many shards are to come.
        """
        self._done += size
        self._failed += failures
        rate = 60 * self._done / max(perf_counter() - self._began, 1e-9)
        valid = 100 * (self._done - self._failed) / max(self._done, 1)
        self._said = f"{rate:.0f} a minute, {valid:.1f} % valid, {left} shards to come"
        self._bar.set_postfix_str(self._said, refresh=False)
        self._bar.update(size)

    def _look(self) -> None:
        assert self._tally is not None
        while not self._end.wait(_SHOW_SECONDS if sys.stderr.isatty() else _LOG_SECONDS):
            where = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in self._tally.total().items() if count)
            self._bar.set_postfix_str("; ".join(filter(None, (self._said, where))))
