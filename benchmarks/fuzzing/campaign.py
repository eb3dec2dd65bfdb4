"""A campaign: inputs of all targets in blocks, given to workers; counts and findings that outlive a stopped command."""

import fcntl
import json
import multiprocessing
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from multiprocessing import forkserver
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.cases import Case, Target
from benchmarks.fuzzing.findings import KnownFinding, about, code_of_campaign, read_finding, write_finding
from benchmarks.fuzzing.process import WorkerProcess
from benchmarks.fuzzing.reduction import reduced
from benchmarks.fuzzing.watching import NATIVE, Finding, FindingKind, Outcome
from benchmarks.fuzzing.worker import Block, BlockDone, Broken, Found, Job, Replay, Replayed, load_targets
from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError
from stable_data.limits import SETTING

TARGETS = "benchmarks.fuzzing.targets.registry:TARGETS"
"""The targets of this project."""

STATE, FINDINGS = "state.json", "findings"
"""The file of counts, and the folder of findings, in the folder of a campaign."""

_VERSION = 2
_MAYBE_OF_OTHERS = (NATIVE, "SIGKILL")  # another process may have opened the file, or have taken the memory of the machine
_SAVE_SECONDS = 5.0
_LOOK_SECONDS = 0.25
_STARTS = 3  # workers that are started for a job before the fuzzer is taken for broken
_IN_MEMORY = "/dev/shm"  # noqa: S108 - a folder in memory; that in it has a random name
_FOLDER = "stable-data-fuzz-"
_REDUCE_SECONDS = 40.0
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "IGL_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    SETTING: "item.max_scan_seconds=600",  # of wall time: an honest layer must not be refused on a machine that is very busy
}


@dataclass(slots=True)
class TargetCounts:
    """What a campaign did for one target, over all commands.

    Attributes:
        planned: Inputs that it is to have.
        done: Inputs that were run.
        accepted: Those with a result.
        refused: Those that were refused.
        seconds: Processor time of the workers.
        next: The first number that no worker was given yet.
        open: Blocks that were given to a worker and are not done: first number and end.
        codes: Code of a refusal -> how often.
    """

    planned: int = 0
    done: int = 0
    accepted: int = 0
    refused: int = 0
    seconds: float = 0.0
    next: int = 0
    open: list[tuple[int, int]] = field(default_factory=list)
    codes: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class State:
    """All that a campaign knows; it is written to its folder.

    Attributes:
        seed: Seed of the inputs.
        targets: Counts by target.
        findings: Findings by target and key.
    """

    seed: int
    targets: dict[str, TargetCounts] = field(default_factory=dict)
    findings: dict[str, KnownFinding] = field(default_factory=dict)

    def to_json(self) -> str:
        """Returns the state as JSON."""
        document = {
            "version": _VERSION,
            "seed": self.seed,
            "targets": {name: asdict(counts) for name, counts in self.targets.items()},
            "findings": {key: about(known) for key, known in self.findings.items()},
        }
        return json.dumps(document, indent=1) + "\n"

    @classmethod
    def of_json(cls, text: str) -> "State":
        """Returns the state of a JSON text that :meth:`to_json` made."""
        document = json.loads(text)
        if document["version"] != _VERSION:
            raise ValueError(f"version is {document['version']}, expected {_VERSION}")
        targets = {
            name: TargetCounts(**{**counts, "open": [(a, b) for a, b in counts["open"]]})
            for name, counts in document["targets"].items()
        }
        return cls(document["seed"], targets, {key: _known(entry) for key, entry in document["findings"].items()})


def _known(entry: Mapping[str, Any]) -> KnownFinding:
    finding = entry["finding"]
    return KnownFinding(**{**entry, "finding": Finding(**{**finding, "kind": FindingKind(finding["kind"])})})


class Campaign:
    """A campaign in a folder.

    Args:
        out: The folder; what an earlier command did there is continued.
        seed: Seed of the inputs.
        workers: Number of workers.
        registry: Module and name of the targets.

    Attributes:
        state: Its counts and findings.
        targets: The targets.

    Raises:
        ConfigError: The folder is of a campaign with another seed, or cannot be read (``campaign_invalid``).
    """

    def __init__(self, out: Path, seed: int = 0, workers: int = 2, registry: str = TARGETS) -> None:
        self.out, self._registry, self._num_workers = out, registry, workers
        self.targets: dict[str, Target] = load_targets(registry)
        self.state = State(seed)
        out.mkdir(parents=True, exist_ok=True)
        path = out / STATE
        if path.exists():
            try:
                self.state = State.of_json(path.read_text("utf-8"))
            except (OSError, ValueError, LookupError, TypeError) as error:
                raise ConfigError(
                    f"{path}: cannot be read ({error}), expected the state of a campaign", "campaign_invalid"
                ) from error
            if self.state.seed != seed:
                raise ConfigError(
                    f"{out}: has the seed {self.state.seed}, expected {seed}; choose another folder", "campaign_invalid"
                )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Locks the folder for one command.

        Raises:
            ConfigError: Another command works in it (``locked``).
        """
        with (self.out / ".lock").open("w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(
                    f"{self.out}: another command works in this folder, expected one at a time", "locked"
                ) from error
            yield

    def plan(self, count: int, names: Sequence[str] = ()) -> None:
        """Says how many inputs there are to be, all commands together.

        Args:
            count: Their number, divided by the shares of the targets.
            names: The targets; without any, all.

        Raises:
            ConfigError: There is no such target (``target_unknown``).
        """
        if unknown := sorted(set(names) - self.targets.keys()):
            raise ConfigError(f"there is no target {unknown[0]!r}, expected of {', '.join(self.targets)}", "target_unknown")
        shares = {name: target.share for name, target in self.targets.items() if not names or name in names}
        for name, planned in divided(count, shares).items():
            self.state.targets.setdefault(name, TargetCounts()).planned = planned

    def run(
        self, seconds: float = float("inf"), names: Sequence[str] = (), tell: Callable[[str], None] = lambda _: None
    ) -> None:
        """Runs what is planned and not done.

        Args:
            seconds: Time after which no further block is started.
            names: The targets; without any, all that have a plan.
            tell: Called with a line for each new finding.

        Raises:
            RuntimeError: The fuzzer is broken, such as an honest input that is refused.
        """
        chosen = {name: counts for name, counts in self.state.targets.items() if not names or name in names}
        with self.locked(), _Pool(self._num_workers, self._registry, self.state.seed) as pool:
            _Run(self, pool, chosen, seconds, tell).run()

    def recheck(self, tell: Callable[[str], None] = lambda _: None) -> None:
        """Runs the inputs of the findings again that are not mended; those that end well now with other code are.

        One that ends well with the same code is not mended: it depends on more than its input, and is left.

        Args:
            tell: Called with a line for each finding that does not come again.
        """
        left = [known for known in self.state.findings.values() if not known.is_mended and known.target in self.targets]
        if not left:
            return
        with self.locked(), _Pool(1, self._registry, self.state.seed) as pool:
            for known in left:
                case = read_finding(self.out / FINDINGS, known)
                if pool.replay(known.target, case).finding is not None:
                    known.code = code_of_campaign()
                elif known.code == code_of_campaign():
                    known.not_again += 1
                    tell(f"{known.folder}: did not come again, with the same code")
                else:
                    known.is_mended = True
                    tell(f"{known.folder}: mended")
                write_finding(self.out / FINDINGS, known, case.content)
                self.save()

    def reduce(self, tell: Callable[[str], None] = lambda _: None, seconds: float = _REDUCE_SECONDS) -> None:
        """Makes the inputs of the findings smaller, those that were not tried yet.

        Args:
            tell: Called with a line for each.
            seconds: Most time for one.
        """
        left = [known for known in self.state.findings.values() if not known.is_reduced and not known.is_mended]
        if not left:
            return
        with self.locked(), _Pool(1, self._registry, self.state.seed) as pool:
            for known in left:
                case, key, end = read_finding(self.out / FINDINGS, known), known.finding.key, time.monotonic() + seconds
                target = self.targets[known.target]

                def is_same(other: Case, target: Target = target, key: str = key) -> bool:
                    finding = pool.replay(target.name, other).finding
                    return finding is not None and finding.key == key

                def may_go_on(end: float = end) -> bool:
                    return time.monotonic() < end

                small = reduced(case, target, self.state.seed, known.number, is_same, may_go_on)
                known.is_reduced = True
                write_finding(self.out / FINDINGS, known, small.content)
                self.save()
                tell(f"{known.folder}: {len(case.content)} -> {len(small.content)} bytes")

    def replay(self, target: str, case: Case) -> Outcome:
        """Runs one input in a process of its own."""
        with _Pool(1, self._registry, self.state.seed) as pool:
            return pool.replay(target, case)

    def save(self) -> None:
        """Writes the state, at once."""
        write_file_atomically(self.out / STATE, self.state.to_json().encode())


def divided(count: int, shares: Mapping[str, float]) -> dict[str, int]:
    """Divides a number by shares; the parts are whole numbers whose sum it is."""
    total = sum(shares.values())
    exact = {name: count * share / total for name, share in shares.items()}
    found = {name: int(part) for name, part in exact.items()}
    by_rest = sorted(exact, key=lambda name: found[name] - exact[name])
    for name in by_rest[: count - sum(found.values())]:
        found[name] += 1
    return found


def remove_left_behind(folder: Path) -> None:
    """Removes the folders of workers that killed commands left in a folder; their names have the number of the process."""
    for left in folder.glob(f"{_FOLDER}*-*"):
        number = left.name.removeprefix(_FOLDER).partition("-")[0]
        if not number.isdecimal():
            continue
        try:
            os.kill(int(number), 0)  # it only asks whether the process is there
        except ProcessLookupError:
            shutil.rmtree(left, ignore_errors=True)
        except (PermissionError, OverflowError):  # one of another user, or no number of a process
            continue


class _Pool:
    """Workers, each of which is replaced as it ends."""

    def __init__(self, count: int, registry: str, seed: int) -> None:
        self._context = multiprocessing.get_context("forkserver")
        module = registry.partition(":")[0]
        self._context.set_forkserver_preload(["benchmarks.fuzzing.worker", module])
        before = {name: os.environ.get(name) for name in _ENVIRONMENT}
        os.environ |= _ENVIRONMENT  # of the processes to come, not of this one
        try:
            forkserver.ensure_running()
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        self._registry, self._seed, self._started = registry, seed, 0
        self._seconds = 0.0
        folders = Path(_IN_MEMORY if os.access(_IN_MEMORY, os.W_OK) else tempfile.gettempdir())
        remove_left_behind(folders)
        self._folder = tempfile.TemporaryDirectory(prefix=f"{_FOLDER}{os.getpid()}-", dir=folders)
        self.workers: list[WorkerProcess] = [self._start() for _ in range(count)]

    def __enter__(self) -> "_Pool":
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self.workers:
            worker.close()
        self._folder.cleanup()

    def replace(self, worker: WorkerProcess) -> WorkerProcess:
        """Starts another process in place of one, and returns it."""
        self._seconds += worker.seconds()
        worker.close()
        new = self.workers[self.workers.index(worker)] = self._start()
        return new

    def give(self, worker: WorkerProcess, job: Job) -> WorkerProcess:
        """Gives an idle worker a job, or another one in its place if it has ended meanwhile; returns the one that has the job.

        Raises:
            RuntimeError: New ones end at once, too.
        """
        for _ in range(_STARTS):
            try:
                worker.send(job)
            except ConnectionError:
                worker = self.replace(worker)
            else:
                return worker
        raise RuntimeError(f"{_STARTS} workers ended before they had a job, expected that they wait for one")

    def seconds(self) -> float:
        """The processor time of all its workers so far."""
        return self._seconds + sum(worker.seconds() for worker in self.workers)

    def replay(self, target: str, case: Case) -> Outcome:
        """Runs one input in the last worker, which is idle; that is replaced if the input ends it.

        Raises:
            RuntimeError: The fuzzer is broken.
        """
        worker = self.give(self.workers[-1], Replay(target, case))
        while True:
            try:
                message = worker.message()
            except EOFError:
                outcome = worker.death()
                self.replace(worker)
                return outcome
            if isinstance(message, Replayed):
                worker.job = None
                if message.outcome.finding is not None and message.outcome.finding.kind is FindingKind.MEMORY:
                    self.replace(worker)
                return message.outcome
            if isinstance(message, Broken):
                raise RuntimeError(message.reason)
            if (overdue := worker.overdue()) is not None:
                self.replace(worker)
                return overdue
            wait([worker.connection], _LOOK_SECONDS)

    def _start(self) -> WorkerProcess:
        self._started += 1
        return WorkerProcess(self._context, Path(self._folder.name) / str(self._started), self._registry, self._seed)


class _Run:
    """The run of one command."""

    def __init__(
        self, campaign: Campaign, pool: _Pool, chosen: Mapping[str, TargetCounts], seconds: float, tell: Callable[[str], None]
    ) -> None:
        self._campaign, self._pool, self._chosen, self._tell = campaign, pool, chosen, tell
        self._end = time.monotonic() + seconds
        self._blocks: dict[int, Block] = {}
        self._found: dict[int, list[Found]] = {}
        self._saved, self._is_changed = time.monotonic(), False
        # What was given to a worker of a command that was ended is given again; its counts were not stored.
        self._waiting = [Block(name, a, b) for name, counts in chosen.items() for a, b in counts.open if a < counts.planned]

    def run(self) -> None:
        try:
            while self._blocks or self._waiting or self._has_more():
                for worker in list(self._pool.workers):
                    if id(worker) in self._blocks:
                        self._look(worker)
                    elif (block := self._next()) is not None:
                        self._give(worker, block)
                if not self._blocks and self._peek() is None:
                    break
                wait([w.connection for w in self._pool.workers if id(w) in self._blocks], _LOOK_SECONDS)
                if self._is_changed and time.monotonic() - self._saved > _SAVE_SECONDS:
                    self._save()
        finally:
            self._save()

    def _has_more(self) -> bool:
        return time.monotonic() < self._end and any(c.next < c.planned for c in self._chosen.values())

    def _peek(self) -> str | None:
        """The target of the next block: that of which the smallest part is done."""
        if time.monotonic() >= self._end:
            return None
        if self._waiting:
            return self._waiting[0].target
        open_ones = [(c.next / c.planned, name) for name, c in self._chosen.items() if c.next < c.planned]
        return min(open_ones)[1] if open_ones else None

    def _next(self) -> Block | None:
        name = self._peek()
        if name is None:
            self._waiting = [] if time.monotonic() >= self._end else self._waiting
            return None
        if self._waiting:
            return self._waiting.pop(0)
        counts = self._chosen[name]
        block = Block(name, counts.next, min(counts.planned, counts.next + self._campaign.targets[name].block))
        counts.next = block.end
        counts.open.append((block.first, block.end))
        self._is_changed = True
        return block

    def _give(self, worker: WorkerProcess, block: Block) -> None:
        worker = self._pool.give(worker, block)
        self._blocks[id(worker)], self._found[id(worker)] = block, []

    def _look(self, worker: WorkerProcess) -> None:
        """Reads the messages of a worker; it is replaced if it ended, or if its input takes too much."""
        block = self._blocks[id(worker)]
        while True:
            try:
                message = worker.message()
            except EOFError:
                self._lost(worker, block, worker.death())
                return
            if message is None:
                break
            if isinstance(message, Found):
                self._found[id(worker)].append(message)
            elif isinstance(message, BlockDone):
                self._done(worker, block, message)
                return
            elif isinstance(message, Broken):
                raise RuntimeError(message.reason)
        if (overdue := worker.overdue()) is not None:
            self._lost(worker, block, overdue)

    def _done(self, worker: WorkerProcess, block: Block, message: BlockDone) -> None:
        self._count(worker, block, message.end, message.codes)
        if message.is_used_up:
            self._pool.replace(worker)

    def _count(
        self, worker: WorkerProcess, block: Block, end: int, codes: Mapping[str, int] | None = None, more: int = 0
    ) -> None:
        """Adds what a worker did of a block, up to a number; the rest waits for another worker.

        Findings are noted together with the counts, after all that takes time: a block that is given again after a kill adds neither
        twice, and a kill in between loses none.
        """
        name = block.target
        settled = [(found.number, self._settled(name, found)) for found in self._found[id(worker)]]
        counts, self._is_changed = self._chosen[name], True
        for number, outcome in settled:
            self._note(name, number, outcome)
        done, accepted, refused = worker.counts
        counts.done += done + more
        counts.accepted += accepted
        counts.refused += refused
        for code, times in (codes or {}).items():
            counts.codes[code] = counts.codes.get(code, 0) + times
        counts.seconds += worker.take_seconds()
        del self._found[id(worker)], self._blocks[id(worker)]
        counts.open.remove((block.first, block.end))
        if end < block.end:
            rest = Block(block.target, end, block.end)
            counts.open.append((rest.first, rest.end))
            self._waiting.insert(0, rest)

    def _lost(self, worker: WorkerProcess, block: Block, outcome: Outcome) -> None:
        """Notes the input with which a worker ended, and goes on with the next one."""
        number = worker.number
        if self._campaign.targets[block.target].read_apart is not None:
            outcome = self._again(block.target, number)
        self._found[id(worker)].append(Found(number, outcome))
        self._count(worker, block, number + 1, more=1)
        self._pool.replace(worker)

    def _again(self, name: str, number: int) -> Outcome:
        """Runs an input again, in a new process."""
        campaign = self._campaign
        with _Pool(1, campaign._registry, campaign.state.seed) as pool:
            outcome = pool.replay(name, campaign.targets[name].case(campaign.state.seed, number))
            self._chosen[name].seconds += pool.seconds()
            return outcome

    def _settled(self, name: str, found: Found) -> Outcome:
        """How an input ended; it is run again if that may be the work of another process, or of the reader that is not apart."""
        finding = found.outcome.finding
        if finding is None:
            return found.outcome
        # The peak of a process's memory stays: what a reader apart needs is seen in a new process alone.
        is_of_reader = finding.kind is FindingKind.MEMORY and self._campaign.targets[name].read_apart is not None
        return self._again(name, found.number) if is_of_reader or finding.type in _MAYBE_OF_OTHERS else found.outcome

    def _note(self, name: str, number: int, outcome: Outcome) -> None:
        """Notes how an input ended whose worker did not count it."""
        findings, counts, finding = self._campaign.state.findings, self._chosen[name], outcome.finding
        if finding is None:
            counts.refused, counts.accepted = counts.refused + (not outcome.is_accepted), counts.accepted + outcome.is_accepted
            return
        key = f"{name}: {finding.key}"
        if key in findings and not findings[key].is_mended:
            findings[key].count += 1
            findings[key].code = code_of_campaign()
            return
        case = self._campaign.targets[name].case(self._campaign.state.seed, number)
        count = findings[key].count + 1 if key in findings else 1  # one that was mended for another input alone is left again
        known = findings[key] = KnownFinding(name, number, case.base, case.path, finding, count, code=code_of_campaign())
        write_finding(self._campaign.out / FINDINGS, known, case.content)
        self._tell(f"{name}/{number}: {finding.key}: {finding.message[:200]}")

    def _save(self) -> None:
        self._campaign.save()
        self._saved, self._is_changed = time.monotonic(), False
