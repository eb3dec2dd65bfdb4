"""Which faults happen to a run, and when."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

LAST = 0.9
"""Share of written files after which no fault is planned: the run could end before it."""

_KILLS_PER_OTHER = 10


class FaultKind(StrEnum):
    """The kinds of faults.

    A killed driver is started again at once with the same command, as a batch system does with a requeued job. A killed worker is one
    that is busy with a shard. A killed node loses all its processes at the same moment; another node starts up to 20 s later. With the
    head a whole cluster is lost, and the job is started again on a new one. On a full disk the job must end by itself with one line; it
    is started again when there is space. The clock jumps by up to twelve hours. A second driver is started with the same command:
    it must refuse to run where a lock allows only one, and may do what it likes in an object store.
    """

    KILL_DRIVER = "kill_driver"
    KILL_WORKER = "kill_worker"
    KILL_NODE = "kill_node"
    KILL_HEAD = "kill_head"
    FULL_DISK = "full_disk"
    CLOCK = "clock"
    TWO_DRIVERS = "two_drivers"

    @property
    def is_kill(self) -> bool:
        """Whether processes are killed."""
        return self.value.startswith("kill_")


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        at: Share of the run's files that are there before it.
        kind: Its kind.
    """

    at: float
    kind: FaultKind


def planned(kinds: Collection[FaultKind], kills: int, rng: np.random.Generator) -> list[FaultKind]:
    """Plans faults in random order.

    Args:
        kinds: The kinds.
        kills: Number of kills; the numbers of the kinds of kills differ by at most one.
        rng: Chooses the order.

    Returns:
        The faults. Each other kind comes once for every ten kills, but at least once.
    """
    deadly = [kind for kind in FaultKind if kind in kinds and kind.is_kill]
    found = [deadly[k % len(deadly)] for k in range(kills if deadly else 0)]
    for kind in FaultKind:
        if kind in kinds and not kind.is_kill:
            found += [kind] * max(1, kills // _KILLS_PER_OTHER)
    return [found[k] for k in rng.permutation(len(found))]


def spread(kinds: Sequence[FaultKind], rng: np.random.Generator, last: float = LAST) -> list[Fault]:
    """Spreads faults over a run: each comes at a random moment up to a last one, in their order."""
    moments = sorted(rng.uniform(0, last, len(kinds)))
    return [Fault(float(at), kind) for at, kind in zip(moments, kinds, strict=True)]
