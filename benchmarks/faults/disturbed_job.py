"""A job that is run to its end while faults happen to it."""

import os
import re
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.nodes import Nodes
from benchmarks.faults.plan import Fault, FaultKind
from benchmarks.faults.processes import kill, started
from benchmarks.faults.shifted_clock import ShiftedClock
from benchmarks.faults.small_disk import SmallDisk
from stable_data.commands.command_line import DONE, NOT_STARTED, SOME_FAILED
from stable_data.storage.run_folder import RunFolder

_LOOK_SECONDS = 0.5
_END_SECONDS = 600.0  # for a driver to end by itself when it cannot go on
_HANG_SECONDS = 3600.0  # longest time without another file while the job runs
_RIVAL_SECONDS = 180.0  # longest life of a second driver after its work has begun
_AT_WORK = re.compile(r"\d+/\d+ \w+s \[")  # the progress bar of a job whose shards are planned
_CLOSING_LINE = "; report/index.html"  # a process that crashes may end with the status of a job that is done
_ADVICE = "start the cluster again"  # what the job asks of its user where Ray has lost a node without noticing it
_MAX_STOPS = 10  # times in a row that the job may end by itself while nothing is written


@dataclass(slots=True)
class Course:
    """The course of a run, summed over the sessions in which it was made.

    Attributes:
        seconds: Wall time of the sessions.
        rounds: Number of times that the job was completed.
        passed: Number of planned faults that have happened.
        begins: Number of them when the present round began.
        idle_rounds: Number of last rounds in a row in which none happened.
        hits: Number of them by kind; only those that really hit the job.
        starts: Number of times that the job was started.
        finished_early: Number of times that it was done by itself while faults of its round were still to come.
        stops: Number of times that it ended by itself with an error although no fault asked for it.
        last_words: The error line of each stop, and of each second driver in a store that ended with one.
        unclear: What was expected to end with one line and did not: the fault, and what was found.
        rows: What was compared in all rounds so far, see :func:`benchmarks.faults.comparison.compared`.
        is_complete: Whether all rounds are done.
    """

    seconds: float = 0.0
    rounds: int = 0
    passed: int = 0
    begins: int = 0
    idle_rounds: int = 0
    hits: dict[str, int] = field(default_factory=dict)
    starts: int = 0
    finished_early: int = 0
    stops: int = 0
    last_words: list[str] = field(default_factory=list)
    unclear: list[str] = field(default_factory=list)
    rows: dict[str, Any] = field(default_factory=dict)
    is_complete: bool = False


@dataclass(slots=True)
class _Driver:
    """A started command, and the file of its output."""

    process: subprocess.Popen[bytes]
    log: Path

    def text(self) -> str:
        """What it has written so far."""
        return self.log.read_text("utf-8", "replace")

    @property
    def is_done(self) -> bool:
        """Whether it has ended since its job is done."""
        return self.process.poll() in (DONE, SOME_FAILED) and _CLOSING_LINE in self.text()

    def last_words(self) -> str:
        """The last line that begins with ``error:``, or what the output ends with."""
        lines = re.split(r"[\r\n]+", self.text().strip())
        return next((line for line in reversed(lines) if line.startswith("error: ")), f"no error line, but: {lines[-1][-200:]}")

    def kill(self) -> bool:
        """Kills it with all that it has started in its session; returns False if it had ended before."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        return self.process.wait() == -signal.SIGKILL


@dataclass(slots=True)
class DisturbedJob:
    """A job on a cluster, and what disturbs it.

    Attributes:
        command: Arguments of ``python -m pipelines`` for a cluster's address; the job resumes if it is started again.
        run: The run folder that it writes, as it is seen without faults.
        tables: Tables whose files are counted to know how far the run is.
        num_files: Number of these files at the end.
        nodes: The cluster.
        logs: Folder that gets the output of each driver, in a file of its own.
        course: What has happened so far.
        seed: Chooses moments and victims.
        clock: The clock of all processes, or None if it never jumps.
        disk: The disk of the run, or None if it is never full.
        delay_seconds: Longest time between the file that a fault waits for and the fault.
        until: Moment of ``time.monotonic`` at which the session ends.
        save: Called when the course has changed.
    """

    command: Callable[[str], Sequence[str]]
    run: RunFolder
    tables: Collection[str]
    num_files: int
    nodes: Nodes
    logs: Path
    course: Course = field(default_factory=Course)
    seed: int = 0
    clock: ShiftedClock | None = None
    disk: SmallDisk | None = None
    delay_seconds: float = 3.0
    until: float = float("inf")
    save: Callable[[], None] = lambda: None
    _driver: _Driver = field(init=False)
    _former: frozenset[int] = frozenset()  # workers that were busy when the driver was started: those of one that was killed
    _rivals: list[tuple[_Driver, float]] = field(default_factory=list)

    def go(self, faults: Sequence[Fault]) -> bool:
        """Runs the job until it is complete, or the session ends; returns whether it is complete.

        Args:
            faults: The faults of this round, those that have happened included.

        Raises:
            RuntimeError: It ended with an error again and again, or hangs.
        """
        began = since = time.monotonic()
        waiting = deque(faults[self.course.passed - self.course.begins :])
        before, idle_stops, there = self.course.seconds, 0, -1
        self._start()
        try:
            while not self._driver.is_done:
                self.course.seconds = before + time.monotonic() - began
                if time.monotonic() > self.until:
                    return False
                self.nodes.restore()
                self._end_rivals()
                if (now_there := self._num_there()) != there:
                    idle_stops, there, since = 0, now_there, time.monotonic()
                elif time.monotonic() - since > _HANG_SECONDS:
                    raise RuntimeError(f"the job has written nothing for {_HANG_SECONDS:g} s, see {self._driver.log}")
                if (status := self._driver.process.poll()) is not None and not self._driver.is_done:
                    self._note_stop(status)
                    if _ADVICE in self.course.last_words[-1].lower():
                        self._replace_cluster()
                    idle_stops += 1
                    if idle_stops > _MAX_STOPS:
                        raise RuntimeError(f"the job ended {idle_stops} times by itself: {self.course.last_words[-1]}")
                    self._start()
                elif waiting and there >= waiting[0].at * self.num_files:
                    rng = np.random.default_rng([self.seed, self.course.passed])
                    time.sleep(float(rng.uniform(0, self.delay_seconds)))
                    if self._hit(waiting[0].kind, rng):
                        kind = str(waiting.popleft().kind)
                        self.course.hits[kind] = self.course.hits.get(kind, 0) + 1
                        self.course.passed += 1
                        self.save()
                else:
                    time.sleep(_LOOK_SECONDS)
            if not self._rivals_are_done():
                return False
            self.course.finished_early += bool(waiting)
            return True
        finally:
            for driver in (self._driver, *(rival for rival, _ in self._rivals)):
                driver.kill()
            self.course.seconds = before + time.monotonic() - began
            self.save()

    def _start(self) -> None:
        """Starts the job."""
        self._former = frozenset(self.nodes.busy())
        self._driver = self._started()

    def _started(self) -> _Driver:
        command = [sys.executable, "-m", "pipelines", *self.command(self.nodes.address)]
        environment = os.environ | (dict(self.clock.environment) if self.clock is not None else {})
        self.logs.mkdir(exist_ok=True)
        self.course.starts += 1
        log = self.logs / f"{self.course.starts:04d}.log"
        with log.open("wb") as stream:
            return _Driver(started(command, stream, environment), log)

    def _num_there(self) -> int:
        return sum(len(self.run.files(table)) for table in self.tables)

    def _busy(self) -> list[int]:
        """The workers that work on a shard for the present driver."""
        return [process for process in self.nodes.busy() if process not in self._former]

    def _hit(self, kind: FaultKind, rng: np.random.Generator) -> bool:
        """Lets a fault happen, and starts the job again if it has ended; returns whether the fault hit the job."""
        busy = self._busy()
        match kind:
            case FaultKind.KILL_WORKER:
                return bool(busy) and kill([busy[int(rng.integers(len(busy)))]]) == 1
            case FaultKind.KILL_NODE:
                return self.nodes.lose(busy, rng)
            case FaultKind.CLOCK:
                assert self.clock is not None
                if busy:
                    self.clock.jump(rng)
                return bool(busy) and all(map(self.clock.is_seen_by, [self._driver.process.pid, *busy]))
            case FaultKind.TWO_DRIVERS:
                return self._start_rival(rng)
            case FaultKind.KILL_DRIVER:
                is_hit = self._driver.kill()
            case FaultKind.KILL_HEAD:
                is_hit = bool(busy) and self._lose_head()
            case FaultKind.FULL_DISK:
                is_hit = bool(busy) and self._fill_disk()
        if is_hit:
            self._start()
        return is_hit

    def _lose_head(self) -> bool:
        """Kills the head, waits for the job to end by itself, and starts a new cluster; returns False if it was complete without it."""
        self.nodes.lose_head()
        is_hit = self._expect_end(self._driver, FaultKind.KILL_HEAD, r"error: .*(head|Ray)")
        self._replace_cluster()
        return is_hit

    def _replace_cluster(self) -> None:
        """Starts a new cluster; second drivers end with the old one."""
        for rival, _ in self._rivals:
            rival.kill()
        self._rivals.clear()
        self.nodes.start_again()

    def _fill_disk(self) -> bool:
        """Fills the disk until the job has ended by itself; returns False if it was complete without it."""
        assert self.disk is not None
        self.disk.fill()
        try:
            return self._expect_end(self._driver, FaultKind.FULL_DISK, r"error: .*No space left on device")
        finally:
            self.disk.free()

    def _start_rival(self, rng: np.random.Generator) -> bool:
        """Starts a second driver. Where there is a lock, one of the two must refuse to run; in a store it works for a while."""
        rival = self._started()
        while rival.process.poll() is None and self._driver.process.poll() is None:
            if not self.run.is_local and all(_AT_WORK.search(driver.text()) for driver in (self._driver, rival)):
                self._rivals.append((rival, time.monotonic() + float(rng.uniform(0.2, 1)) * _RIVAL_SECONDS))
                return True
            self.nodes.restore()
            time.sleep(_LOOK_SECONDS)
        if not self.run.is_local:  # one of the two ended before both were at work; a second one that is late must end by itself
            self._rivals.append((rival, float("inf") if self._driver.is_done else 0.0))
            return False
        refused, self._driver = (rival, self._driver) if rival.process.poll() is not None else (self._driver, rival)
        return self._expect_end(refused, FaultKind.TWO_DRIVERS, r"error: .*another run is writing to this folder")

    def _end_rivals(self) -> None:
        """Kills the second drivers whose time is over; one that has ended by itself must be done, or say why not."""
        for rival, ends in list(self._rivals):
            if rival.process.poll() is None and time.monotonic() < ends:
                continue
            if not rival.kill() and not rival.is_done:
                self.course.last_words.append(f"second driver: {rival.last_words()}")
                self._note_end(FaultKind.TWO_DRIVERS, rival, rival.process.returncode)
            self._rivals.remove((rival, ends))

    def _rivals_are_done(self) -> bool:
        """Waits until the second drivers that are left have ended by themselves; returns False if the session ends first."""
        while self._rivals:
            if time.monotonic() > self.until:
                return False
            self.nodes.restore()
            self._rivals = [(rival, float("inf")) for rival, _ in self._rivals]
            self._end_rivals()
            time.sleep(_LOOK_SECONDS)
        return True

    def _expect_end(self, driver: _Driver, kind: FaultKind, words: str) -> bool:
        """Waits for a driver to end by itself, and notes it if that is not with the right status and one clear line.

        Returns:
            Whether it ended before its job was done.
        """
        try:
            status = driver.process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            status = None
        driver.kill()
        if driver.is_done:
            return False
        self._note_end(kind, driver, status, words)
        return True

    def _note_stop(self, status: int) -> None:
        """Notes that the job ended by itself."""
        self.course.stops += 1
        self.course.last_words.append(self._driver.last_words())
        self._note_end("ended by itself", self._driver, status)

    def _note_end(self, what: str, driver: _Driver, status: int | None, words: str = "error: ") -> None:
        """Notes the end of a driver before its job was done, unless it has the right status and one line with some words."""
        found = driver.last_words()
        if status != NOT_STARTED or not re.match(words, found):
            ended = f"status {status}" if status is not None else f"did not end within {_END_SECONDS:g} s"
            self.course.unclear.append(f"{what}: {ended}, {found}")
