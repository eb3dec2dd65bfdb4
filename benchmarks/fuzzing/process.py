"""A worker as its parent sees it: it gets jobs, and is ended where an input takes too much."""

import os
import shutil
import signal
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.watching import MOST_MEMORY, MOST_SECONDS, Finding, FindingKind, Outcome, frame_of_dump
from benchmarks.fuzzing.worker import ACCEPTED, BEGAN, DONE, LOG, NUMBER, PROGRESS_SIZE, REFUSED, Block, Job, Message, serve

_GRACE = 2.0  # seconds of processor time beyond the limit: the worker itself notes an input that ends meanwhile
_MOST_WALL_SECONDS = 120.0  # of an input that computes nothing: it waits for something that never comes
_COMPUTES = 0.5  # seconds of processor time in that time: less is nothing, also on a machine that is very busy
_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


class WorkerProcess:
    """One worker.

    Args:
        context: How processes are started.
        root: Folder for its files; it is removed with the worker.
        registry: Module and name of the targets.
        seed: Seed of the inputs.
    """

    def __init__(self, context: BaseContext, root: Path, registry: str, seed: int) -> None:
        self._root = root
        root.mkdir(parents=True)
        self._progress: Any = context.RawArray("q", PROGRESS_SIZE)
        self._connection: Connection
        self._connection, other = context.Pipe()
        self._process: Any = context.Process(target=serve, args=(other, self._progress, registry, seed, str(root)), daemon=True)  # type: ignore[attr-defined]
        self._process.start()
        other.close()
        self._seen = self._taken = 0.0
        self._since, self._computed, self._input = time.monotonic(), 0.0, (-1, 0)
        self._resident = _resident(self._process.pid)
        self.job: Job | None = None

    @property
    def connection(self) -> Connection:
        """Where its messages come from."""
        return self._connection

    @property
    def counts(self) -> tuple[int, int, int]:
        """The inputs of its block that are done, accepted and refused."""
        return self._progress[DONE], self._progress[ACCEPTED], self._progress[REFUSED]

    @property
    def number(self) -> int:
        """The number of the input that it runs."""
        return int(self._progress[NUMBER])

    def send(self, job: Job) -> None:
        """Gives it a job."""
        self.job = job
        self._progress[DONE] = self._progress[ACCEPTED] = self._progress[REFUSED] = 0
        self._progress[NUMBER] = job.first if isinstance(job, Block) else 0
        self._progress[BEGAN] = 0  # until its first input begins
        self._input = (-1, 0)
        self._connection.send(job)

    def seconds(self) -> float:
        """Its processor time so far, with that of the processes that it has started.

        That of one that has ended by itself is as it was last seen: when its last input began, or at a later look.
        """
        self._seen = max(self._seen, self._progress[BEGAN] / 1e9)
        self._fields()
        return self._seen

    def take_seconds(self) -> float:
        """Its processor time since the last call, which is counted thereby."""
        before, self._taken = self._taken, self.seconds()
        return self._taken - before

    def _fields(self) -> Sequence[str] | None:
        """What the system says of it, from its state on; None if it has ended. Its processor time is noted."""
        try:
            fields = Path(f"/proc/{self._process.pid}/stat").read_text("utf-8").rpartition(")")[2].split()
        except OSError:
            return None
        self._seen = max(self._seen, sum(map(int, fields[11:15])) / _TICKS)
        return fields

    def message(self) -> Message | None:
        """Returns its next message; None if there is none now.

        Raises:
            EOFError: It has ended.
        """
        try:
            return self._connection.recv() if self._connection.poll() else None
        except ConnectionError as error:
            raise EOFError from error

    def overdue(self) -> Outcome | None:
        """Ends it if its input takes too much; returns how that input ended then."""
        fields = self._fields()
        if fields is None:
            return None
        began = self._progress[BEGAN]
        spent = sum(map(int, fields[11:13])) / _TICKS - began / 1e9
        computed = spent + _seconds_of_children(self._process.pid)
        if self._input != (self.number, began) or abs(computed - self._computed) > _COMPUTES:
            self._input, self._since, self._computed = (self.number, began), time.monotonic(), computed
        is_stuck = time.monotonic() - self._since > _MOST_WALL_SECONDS
        if began and (spent > MOST_SECONDS + _GRACE or is_stuck):
            frame, dump = self._ended()
            return Outcome(
                False, "", Finding(FindingKind.HANG, "stuck" if is_stuck else "slow", frame, "was ended", dump), spent
            )
        if _resident(self._process.pid) - self._resident > 2 * MOST_MEMORY:
            frame, dump = self._ended()
            return Outcome(False, "", Finding(FindingKind.MEMORY, "resident", frame, "was ended", dump), spent)
        return None

    def death(self) -> Outcome:
        """How the input ended with which the process ended by itself."""
        self._process.join(10)
        code = self._process.exitcode
        name = signal.Signals(-code).name if code is not None and code < 0 else f"exit {code}"
        dump = (self._root / LOG).read_text("utf-8", "replace") if (self._root / LOG).exists() else ""
        return Outcome(
            False, "", Finding(FindingKind.SIGNAL, name, frame_of_dump(dump), "the process ended", dump[-6000:]), 0.0
        )

    def close(self) -> None:
        """Ends it and removes its files."""
        self._connection.close()
        self._process.join(2)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        shutil.rmtree(self._root, ignore_errors=True)

    def _ended(self) -> tuple[str, str]:
        """Ends the process; returns where it was, and its traceback."""
        try:
            os.kill(self._process.pid, signal.SIGUSR1)  # it writes its traceback, also within native code
            time.sleep(0.3)
        except ProcessLookupError:
            pass
        self.seconds()  # nobody says it afterwards
        self._process.kill()
        self._process.join()
        dump = (self._root / LOG).read_text("utf-8", "replace") if (self._root / LOG).exists() else ""
        return frame_of_dump(dump), dump[-6000:]


def _seconds_of_children(process: int) -> float:
    """The processor time of the processes that a process has started and that still run."""
    ticks = 0
    try:
        for child in Path(f"/proc/{process}/task/{process}/children").read_text("utf-8").split():
            fields = Path(f"/proc/{child}/stat").read_text("utf-8").rpartition(")")[2].split()
            ticks += sum(map(int, fields[11:13]))
    except OSError:  # one has ended meanwhile, or the system does not list them
        return 0.0
    return ticks / _TICKS


def _resident(process: int) -> int:
    try:
        return int(Path(f"/proc/{process}/statm").read_text("utf-8").split()[1]) * _PAGE
    except (OSError, IndexError):
        return 0
