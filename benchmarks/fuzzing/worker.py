"""The process that runs inputs: one after the other, watched, and ended by its parent where it does not go on."""

import faulthandler
import fcntl
import gc
import logging
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TextIO, TypeAlias

from benchmarks.fuzzing.cases import Case, Target
from benchmarks.fuzzing.watching import FindingKind, Outcome, Places, Watch, memory_size

NUMBER, DONE, ACCEPTED, REFUSED, BEGAN = range(5)
"""The places of the progress that a worker shares: the input that runs, counts of its block, and its processor time as it began, ns."""

PROGRESS_SIZE = 5

LOG = "trace.txt"
"""File for the traceback of a process that ends or hangs."""

_MOST_ADDRESSES = 34 * 2**30  # bytes that a process may reserve further: what is reserved is seen, and a runaway is ended
_SLACK = (
    2**30
)  # bytes of an earlier peak above the present size that are left alone: from 2 GiB on, they would count for the next input


@dataclass(frozen=True, slots=True)
class Block:
    """A job: some inputs of a target, by their numbers."""

    target: str
    first: int
    end: int


@dataclass(frozen=True, slots=True)
class Replay:
    """A job: one input, with all that protects users (``Target.read_apart``)."""

    target: str
    case: Case


@dataclass(frozen=True, slots=True)
class Found:
    """A message: an input of the block that did not end well."""

    number: int
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class BlockDone:
    """A message: the end of a block, or of its first part, after which the process wants to be replaced.

    Attributes:
        end: The number after the last input that was run.
        codes: Codes of refusals, and how often.
        is_used_up: Whether the process ends now, because of the memory that it holds.
    """

    end: int
    codes: Counter[str] = field(default_factory=Counter)
    is_used_up: bool = False


@dataclass(frozen=True, slots=True)
class Replayed:
    """A message: how the input of a replay ended."""

    outcome: Outcome


@dataclass(frozen=True, slots=True)
class Broken:
    """A message: the fuzzer itself is broken, such as an honest input that is refused."""

    reason: str


Job: TypeAlias = Block | Replay
Message: TypeAlias = Found | BlockDone | Replayed | Broken


def serve(connection: Connection, progress: Any, registry: str, seed: int, root: str) -> None:
    """Runs jobs until the connection ends.

    Args:
        connection: Where jobs come from and messages go to.
        progress: Shared integers, see above.
        registry: Module and name of the targets by name, such as ``benchmarks.fuzzing.targets.registry:TARGETS``.
        seed: Seed of the inputs.
        root: Folder of its files; the traceback of a process that ends or hangs is :data:`LOG` in it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's
    if sys.platform.startswith("linux"):
        _end_with_parent()
    try:
        with (Path(root) / LOG).open("w") as log:
            _Worker(connection, progress, load_targets(registry), seed, Places(Path(root)), log).run()
    except (EOFError, BrokenPipeError):
        return


def _end_with_parent() -> None:
    """Lets the system end this process as soon as the command ends, however that is: who else would end an input that hangs?

    The command holds the other end of a pipe. A thread that waits for its end would not run where native code holds the lock of Python.
    """
    parent = parent_process()
    assert parent is not None
    signal.signal(signal.SIGIO, signal.SIG_DFL)  # it ends the process
    fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, fcntl.fcntl(parent.sentinel, fcntl.F_GETFL) | os.O_ASYNC)


def load_targets(registry: str) -> dict[str, Target]:
    """Returns targets by name, from a module and a name in it."""
    module, _, name = registry.partition(":")
    found: dict[str, Target] = getattr(import_module(module), name)
    return found


class _Worker:
    def __init__(
        self, connection: Connection, progress: Any, targets: dict[str, Target], seed: int, places: Places, log: TextIO
    ) -> None:
        self._connection, self._progress, self._targets, self._seed, self._places = connection, progress, targets, seed, places
        self._ready: set[str] = set()
        places.enter()
        silence = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(silence, stream)
        warnings.simplefilter("ignore")
        logging.disable(logging.CRITICAL)
        faulthandler.enable(log, all_threads=True)
        faulthandler.register(signal.SIGUSR1, log, all_threads=True)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        most = memory_size()[0] + _MOST_ADDRESSES
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
        self._watch = Watch(places)

    def run(self) -> None:
        """Runs jobs until the connection ends."""
        while True:
            job: Job = self._connection.recv()
            try:
                self._prepare(job.target)
                message: Message
                if isinstance(job, Block):
                    message = self._block(job)
                else:
                    message = Replayed(self._outcome(self._targets[job.target], job.case, is_apart=True))
            except Exception:  # noqa: BLE001 - a reader's exceptions are outcomes: this one is of the fuzzer itself
                message = Broken(traceback.format_exc(limit=30))
            self._connection.send(message)
            if isinstance(message, BlockDone) and message.is_used_up:
                return

    def _prepare(self, name: str) -> None:
        """Writes the honest inputs of a target, and runs each: what it imports and caches is not the work of an input.

        Raises:
            RuntimeError: One is refused.
        """
        if name in self._ready:
            return
        target = self._targets[name]
        self._watch.add_outside(self._places.outside(name))
        for base in target.bases.values():
            folder = self._places.folder(name, base.name)
            for path, content in base.files.items():
                place = folder / path
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)
        for base in target.bases.values():
            for read in (target.read, target.read_apart or target.read):
                if not read(self._places.folder(name, base.name), base.name):
                    raise RuntimeError(f"target {name}: the base {base.name} is refused, expected an honest input")
                self._places.clear()
        gc.collect()
        gc.freeze()
        self._ready.add(name)

    def _block(self, block: Block) -> BlockDone:
        target, codes, progress = self._targets[block.target], Counter[str](), self._progress
        progress[DONE] = progress[ACCEPTED] = progress[REFUSED] = 0
        for number in range(block.first, block.end):
            progress[NUMBER] = number
            outcome = self._outcome(target, target.case(self._seed, number))
            if outcome.finding is not None:
                self._connection.send(Found(number, outcome))
            elif outcome.is_accepted:
                progress[ACCEPTED] += 1
            else:
                progress[REFUSED] += 1
                codes[outcome.code or "left out"] += 1
            progress[DONE] += 1
            size, peak = memory_size()
            if peak - size > _SLACK:
                return BlockDone(number + 1, codes, is_used_up=True)
        return BlockDone(block.end, codes)

    def _outcome(self, target: Target, case: Case, *, is_apart: bool = False) -> Outcome:
        """Runs one input; a finding of a target with a reader apart counts only if that reader has one too.

        One of memory is left to the campaign, which runs it in a new process.
        """
        folder = self._places.folder(target.name, case.base)
        place = folder / case.path
        place.write_bytes(case.content)
        self._progress[BEGAN] = time.process_time_ns()
        try:
            read = (target.read_apart or target.read) if is_apart else target.read
            outcome = self._watch.run(read, folder, case.base, target.starts)
            known = outcome.finding
            if known and known.kind is not FindingKind.MEMORY and target.read_apart is not None and not is_apart:
                outcome = self._watch.run(target.read_apart, folder, case.base, target.starts)
        finally:
            place.write_bytes(target.bases[case.base].files[case.path])
            self._places.clear()
        return outcome
