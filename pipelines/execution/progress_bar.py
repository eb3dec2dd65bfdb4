"""Live progress: what is in place, how fast it comes, and where the items of the shards are that are being done.

All of it is for the eye: each worker tells once a second where its items are, whether that has changed or not, and who has not
been heard of for a while is not counted. What is lost on the way is told again, and no row depends on it.
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

Where: TypeAlias = Mapping[str, int]
"""How many items are where, in the words of the progress bar."""

_TELL_SECONDS = 1.0  # between two messages of a worker about one shard
_SILENT_SECONDS = (
    60.0  # after which a worker that tells nothing is taken to be lost; C code may keep it from telling for a while
)
_SHOW_SECONDS = 1.0  # between two looks at the tally
_LOG_SECONDS = 30.0  # likewise where nobody looks at a terminal, and each look is a line of a log
_PATIENCE_SECONDS = 5.0  # with a tally that does not answer
_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} {unit}s [{elapsed}<{remaining}{postfix}]"


class ProgressTally(Protocol):
    """Keeps where the items of the shards are that are being done."""

    def note(self, shard_id: str, where: Where) -> None:
        """Takes what a worker tells of its shard; nothing: the shard is done."""
        ...

    def total(self) -> dict[str, int]:
        """Items of all shards by where they are."""
        ...


@dataclass(slots=True)
class LocalTally:
    """A tally in this process."""

    _of: dict[str, tuple[float, Where]] = field(default_factory=dict)

    def note(self, shard_id: str, where: Where) -> None:
        """Takes what a worker tells of its shard."""
        if where:
            self._of[shard_id] = perf_counter(), where
        else:
            self._of.pop(shard_id, None)

    def total(self) -> dict[str, int]:
        """Items of all shards by where they are, of those that were heard of lately."""
        found: Counter[str] = Counter()
        for told, where in list(self._of.values()):
            if perf_counter() - told <= _SILENT_SECONDS:
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
        return cls(ray.remote(num_cpus=0, max_restarts=-1, scheduling_strategy=here)(LocalTally).remote())

    def note(self, shard_id: str, where: Where) -> None:
        """Sends what a worker tells of its shard; waits for nothing."""
        self.actor.note.remote(shard_id, dict(where))

    def total(self) -> dict[str, int]:
        """Items of all shards by where they are.

        Raises:
            RayError: The tally does not answer.
        """
        found: dict[str, int] = ray.get(self.actor.total.remote(), timeout=_PATIENCE_SECONDS)
        return found


class ProgressReporter:
    """Tells a tally where the items of one shard are. Used in a ``with`` statement, at whose end the shard is done.

    Args:
        tally: The tally; None: nobody looks.
        shard_id: The shard.
        where: How many items are where at first.
    """

    def __init__(self, tally: ProgressTally | None, shard_id: str, **where: int) -> None:
        self._tally, self._shard_id = tally, shard_id
        self._where: Where = where
        self._end, self._thread = Event(), Thread(target=self._tell, name="telling", daemon=True)

    def __enter__(self) -> "ProgressReporter":
        """Begins to tell."""
        if self._tally is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Tells that the shard is done, or given up."""
        if self._tally is not None:
            self._end.set()
            self._thread.join()

    def __call__(self, **where: int) -> None:
        """Takes how many items are where by now."""
        self._where = where

    def _tell(self) -> None:
        assert self._tally is not None
        try:
            self._tally.note(self._shard_id, self._where)
            while not self._end.wait(_TELL_SECONDS):
                self._tally.note(self._shard_id, self._where)
            self._tally.note(self._shard_id, {})
        except Exception:  # noqa: BLE001 - nobody listens any more, and the shard goes on all the same
            return


class ProgressBar:
    """The progress bar of a job. Used in a ``with`` statement.

    Args:
        name: Of the job.
        unit: Of what is counted.
        total: How many items there are.
        initial: How many are in place already.
        tally: Where those are that are being done; None: that is not shown.
    """

    def __init__(self, name: str, unit: str, total: int, initial: int, tally: ProgressTally | None = None) -> None:
        self._bar = tqdm(total=total, initial=initial, desc=name, unit=unit, bar_format=_BAR)
        self._tally, self._done, self._failed, self._left = tally, 0, 0, 0
        self._began, self._end = perf_counter(), Event()
        self._thread = Thread(target=self._look, name="progress", daemon=True)

    def __enter__(self) -> "ProgressBar":
        """Begins to look at the tally."""
        if self._tally is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leaves the bar as it is."""
        self._end.set()
        if self._tally is not None:
            self._thread.join()
        self._bar.set_postfix_str(self._said({}), refresh=False)
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
        self._left = left
        self._bar.set_postfix_str(self._said({}), refresh=False)
        self._bar.update(size)

    def _said(self, where: Where) -> str:
        """What stands behind the bar; on a narrow terminal its end is cut off."""
        now = ", ".join(f"{count} {name}" for name, count in where.items() if count)
        if not self._done:
            return now
        rate = 60 * self._done / max(perf_counter() - self._began, 1e-9)
        valid = 100 * (self._done - self._failed) / self._done
        so_far = f"{rate:.0f}/min, {valid:.1f} % valid"
        return "; ".join(filter(None, (so_far, now, f"{self._left} shards to come")))

    def _look(self) -> None:
        assert self._tally is not None
        while not self._end.wait(_SHOW_SECONDS if sys.stderr.isatty() else _LOG_SECONDS):
            try:
                self._bar.set_postfix_str(self._said(self._tally.total()))
            except ray.exceptions.RayError:
                continue  # it is being started anew
            except Exception:  # noqa: BLE001 - nothing can be shown any more, and the run goes on all the same
                return
