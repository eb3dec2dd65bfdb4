"""Whether a long run of ``generate`` stays as it is: memory, open files, processes, and the time of a scene.

``python -m benchmarks.soak [LIBRARY ...] --out WORK [--scenes 20000] [--seed S] [--minutes M] [--json FILE] [--with FILE ...]``. The
scenes are those of ``make demo``: sampled tasks, the embedded reasoner, the real and the embedded assets unless libraries are named; two
workers on a local Ray. All processes of the job are looked at every ten seconds. The same command continues after ``--minutes``; figures
are of all sessions. Several runs, each with a seed and a folder of its own, may be summed: ``--with`` reads what ``--json`` of another
one wrote.

The criterion: a quantity is the mean over blocks of 100 scenes, without the first scenes of each session, in which processes still fill
their caches (by default 4,000; 1,000 for times). What a worker keeps and the time of a scene are of single shards. A line with one slope
and an own height for each session is fitted. Its 95 % interval is wider where what is left of neighbouring blocks is alike: such blocks
are not independent. Memory

- is *flat* if the whole interval of its slope is within 5 MB per 1,000 scenes: over 20,000 scenes less than 100 MB;
- *grows* or *falls* if it is not flat and the interval does not contain 0;
- is *unknown* otherwise, and with fewer than eight blocks.

The memory of a worker is what it keeps from shard to shard: all that it holds when a shard begins, as the files of the run's timing tell.
While a worker is at a shard it needs up to a gigabyte more, mostly for the replies of the model: that follows from the tasks of the shard,
and differs far more than by 5 MB. So the memory of the workers at work is judged as all else.

The time of a scene is that of the worker's processor. Most of it goes into long replies, whose lengths follow from the tasks. So it is
judged at equal replies: together with the line, its dependence on the tokens of the replies of a shard, and on their squares, is fitted.
That of the driver and of Ray's processes is a small part of it, and is *flat* if the whole interval predicts a change over all scenes of
less than 5 % of the worker's time of a scene; the rest is as for memory.

Every other quantity is *flat* if the interval predicts a change of less than 20 % of its mean over all scenes of all runs, and contains 0
or the slope itself predicts a change of less than 5 %. The rest is as for memory.

The wall time of a scene is shown too (over blocks of 500 scenes), but not judged: it depends on what else the machine does.

The outcomes of the scenes are those of the manifests: how many were accepted, and how many failed, by code. A scene that failed through
the toolkit itself is told as such: ``unexpected``, ``out_of_memory``, ``timed_out`` or ``crashed``.

Status 0: all runs are complete and whole, every quantity is flat or falls, and no scene failed through the toolkit itself. 1: not so. 2:
the benchmark itself could not start or continue. 3: not complete yet. 130: Ctrl-C.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from benchmarks.chaos import NOT_COMPLETE, is_complete, status_of, verified
from benchmarks.faults.processes import Usage, below, end, started, usage_of
from pipelines.generate.shard import KEPT, TIMING_FOLDER
from stable_data.atomic_files import write_file_atomically
from stable_data.commands.command_line import DONE, SOME_FAILED
from stable_data.config_diff import refuse_changed
from stable_data.errors import ConfigError
from stable_data.limits import MIB
from stable_data.storage.manifest import read_manifest
from stable_data.storage.run_folder import RunFolder

LIBRARIES = ("real", "embedded")
WALL_TIME = "seconds a scene"
FAULTS_OF_THE_TOOLKIT = ("unexpected", "out_of_memory", "timed_out", "crashed")
"""Codes of scenes that failed through the toolkit itself, and not through their task."""

_WORKERS = 2
_LOOK_SECONDS = 10.0
_BLOCK, _TIME_BLOCK = 100, 500
_FEWEST_BLOCKS = 8
_FLAT, _KNOWN = 0.05, 0.20
_MOST_ALIKE = 0.95
MOST_MB = 5.0
"""Change of memory per 1,000 scenes that counts as none, MB."""


@dataclass(frozen=True, slots=True)
class FinishedShard:
    """What a shard of the job tells.

    Attributes:
        shard_id: Its id.
        scenes: Its scenes.
        seconds: Seconds of the processor that its worker took.
        kept_mb: Memory that the worker kept from earlier shards, MB; None if it is not told.
        tokens: Tokens of the model's replies; None if the engine did not count all of them.
        tokens_squared: Sum of the squares of the tokens of each turn: a long reply attends to more, and is written with few others. None
            likewise.
    """

    shard_id: str
    scenes: int
    seconds: float
    kept_mb: float | None
    tokens: int | None
    tokens_squared: int | None

    @classmethod
    def of_run(cls, run: RunFolder, shard_id: str) -> "FinishedShard":
        """Reads what a run holds of a shard.

        Raises:
            RuntimeError: It has no timing of the shard.
        """
        if (content := run.read_bytes(f"{TIMING_FOLDER}/{shard_id}.json")) is None:
            raise RuntimeError(f"{run.uri}: the shard {shard_id} has no file in {TIMING_FOLDER}")
        told = json.loads(content)
        kept_mb = None if told[KEPT] is None else told[KEPT] / MIB
        tokens = run.table("turns", ["reply_tokens"], shard_ids={shard_id})["reply_tokens"].to_pylist()
        counts = (None, None) if None in tokens else (sum(tokens), sum(n * n for n in tokens))
        return cls(shard_id, told["scenes"], told["processor"], kept_mb, *counts)


@dataclass(frozen=True, slots=True)
class Sample:
    """One look at the job.

    Attributes:
        session: Number of the session, from 0.
        seconds: Time since the session began.
        scenes: Scenes that are written.
        driver: The process of the command.
        workers: The processes that work on shards, or wait for one.
        ray: Ray's own processes.
        finished: Shards that were finished since the look before.
    """

    session: int
    seconds: float
    scenes: int
    driver: Usage
    workers: Usage
    ray: Usage
    finished: Sequence[FinishedShard] = ()

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> "Sample":
        """Reads a line of the file of samples."""
        parts = {name: Usage(**row[name]) for name in ("driver", "workers", "ray")}
        shards = [FinishedShard(**shard) for shard in row["finished"]]
        return cls(row["session"], row["seconds"], row["scenes"], **parts, finished=shards)


@dataclass(frozen=True, slots=True)
class SoakedRun:
    """The samples of a run.

    Attributes:
        num_scenes: Scenes that it is to have.
        is_complete: Whether it has them.
        is_whole: Whether it was verified then.
        samples: The samples, in order.
        accepted: Scenes that were accepted.
        failures: Scenes that failed, by code.
        code_versions: Versions of the code that made the scenes, in order.
        command: The options of the job.
    """

    num_scenes: int
    is_complete: bool
    is_whole: bool
    samples: Sequence[Sample]
    accepted: int = 0
    failures: Mapping[str, int] = field(default_factory=dict)
    code_versions: Sequence[str] = ()
    command: Sequence[str] = ()

    @classmethod
    def read(cls, path: Path) -> "SoakedRun":
        """Reads the output of ``--json``.

        Raises:
            ConfigError: It cannot be read, or is of something else (``soak_invalid``).
        """
        try:
            found = json.loads(path.read_text("utf-8"))["run"]
            return cls(**{**found, "samples": [Sample.of(row) for row in found["samples"]]})
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise ConfigError(f"{path}: cannot be read ({error}), expected the output of --json", "soak_invalid") from error


def outcomes(run: RunFolder) -> dict[str, Any]:
    """Reads the manifest of a run; returns its part of :class:`SoakedRun`. Before the run is complete, nothing is counted."""
    manifest = read_manifest(run) or {}
    counts = manifest.get("counts", {})
    return {
        "accepted": int(counts.get("scenes", 0)),
        "failures": dict(counts.get("failures_by_code", {})),
        "code_versions": list(manifest.get("code_versions", ())),
    }


@dataclass(frozen=True, slots=True)
class Trend:
    """How a quantity changes while scenes are made.

    Attributes:
        name: The quantity.
        mean: Its mean.
        slope: Its change per 1,000 scenes.
        low: Lower end of the 95 % interval of the slope; None if it is unknown.
        high: Upper end.
        change: Change that the slope predicts over all scenes of all runs, as a share of the mean.
        blocks: Number of blocks.
        verdict: ``flat``, ``grows``, ``falls`` or ``unknown``.
    """

    name: str
    mean: float
    slope: float | None
    low: float | None
    high: float | None
    change: float | None
    blocks: int
    verdict: str


KEPT_MEMORY = "memory that a worker keeps, MB"
WORKER_TIME = "worker seconds a scene, at equal replies"
DRIVER_TIME = "driver and Ray, seconds a scene"
MEMORY = ("driver memory, MB", "Ray's memory, MB")
"""The quantities of each look that may change by an allowance, not by a share of their mean."""
QUANTITIES: Mapping[str, Callable[[Sample], float]] = {
    "driver memory, MB": lambda s: s.driver.memory_mb,
    "Ray's memory, MB": lambda s: s.ray.memory_mb,
    "memory of workers at work, MB": lambda s: s.workers.memory_mb,
    "driver open files": lambda s: s.driver.handles,
    "workers' open files": lambda s: s.workers.handles,
    "Ray's open files": lambda s: s.ray.handles,
    "processes": lambda s: (s.driver + s.workers + s.ray).processes,
    "threads": lambda s: (s.driver + s.workers + s.ray).threads,
}
"""The quantities that each look gives."""


def trend(
    name: str,
    blocks: Sequence[tuple[int, float, float | None]],
    num_scenes: int,
    allowed: float | None = None,
    causes: Sequence[Sequence[float | None]] = (),
) -> Trend:
    """Fits a line with one slope and an own height for each session; if any of the values is not known, the trend is not.

    Args:
        name: The quantity.
        blocks: Session, number of scenes and value of each block, in order.
        num_scenes: Scenes of all runs.
        allowed: Change per 1,000 scenes that a flat quantity may have; None for a share of its mean.
        causes: Quantities of each block on which the value depends, too: factors for them are fitted together with the slope.
    """
    values = np.array([value for _, _, value in blocks], dtype=np.float64)
    scenes = np.array([where for _, where, _ in blocks], dtype=np.float64)
    sessions = np.array([session for session, _, _ in blocks], dtype=np.int64)
    others = np.array(causes, dtype=np.float64).reshape(len(causes), len(blocks))
    mean = float(values.mean()) if len(values) else float("nan")
    freedom = len(values) - len(set(sessions.tolist())) - 1 - len(others)
    for session in set(sessions.tolist()):  # its own height
        mine = sessions == session
        for row in (values, scenes, *others):
            row[mine] -= row[mine].mean()
    is_known = bool(np.isfinite([values, *others]).all())  # None has become NaN
    if len(others) and freedom > 0 and is_known:  # what follows from the causes alone is left out
        values, scenes = (row - others.T @ np.linalg.lstsq(others.T, row, rcond=None)[0] for row in (values, scenes))
    spread = float(scenes @ scenes)
    if not is_known or len(blocks) < _FEWEST_BLOCKS or freedom < 1 or spread == 0 or mean == 0:
        return Trend(name, mean, None, None, None, None, len(blocks), "unknown")
    slope = float(scenes @ values) / spread
    rest = values - slope * scenes
    is_next = sessions[1:] == sessions[:-1]
    alike = float(rest[1:][is_next] @ rest[:-1][is_next]) / max(float(rest @ rest), np.finfo(float).tiny)
    alike = min(max(alike, 0.0), _MOST_ALIKE)
    noise = float(np.sqrt(rest @ rest / freedom / spread * (1 + alike) / (1 - alike)))
    half = float(student.ppf(0.975, freedom)) * noise
    change, low, high = slope * num_scenes / mean, slope - half, slope + half
    farthest = max(abs(low), abs(high))
    if allowed is not None:
        is_flat = 1000 * farthest < allowed
    else:
        is_flat = farthest * num_scenes / mean < _KNOWN and (low <= 0 <= high or abs(change) < _FLAT)
    if is_flat:
        verdict = "flat"
    elif low <= 0 <= high:
        verdict = "unknown"
    else:
        verdict = "grows" if slope > 0 else "falls"
    return Trend(name, mean, 1000 * slope, 1000 * low, 1000 * high, change, len(blocks), verdict)


def trends(runs: Sequence[SoakedRun], warm_up: int, warm_up_of_times: int) -> list[Trend]:
    """The trends of all quantities.

    Args:
        runs: The runs.
        warm_up: First scenes of each session that are left out.
        warm_up_of_times: The same for times.
    """
    samples, of_times = list(_warm(runs, warm_up)), list(_warm(runs, warm_up_of_times))
    num_scenes = sum(run.num_scenes for run in runs)
    kept = [(one.session, float(one.scenes), shard.kept_mb) for one in samples for shard in one.finished]
    found = [trend(KEPT_MEMORY, kept, num_scenes, MOST_MB)]
    for name, value in QUANTITIES.items():
        blocks: dict[tuple[int, int], list[float]] = {}
        for sample in samples:
            blocks.setdefault((sample.session, sample.scenes // _BLOCK), []).append(value(sample))
        means = [(session, (block + 0.5) * _BLOCK, float(np.mean(own))) for (session, block), own in blocks.items()]
        found.append(trend(name, means, num_scenes, MOST_MB if name in MEMORY else None))
    shards = [(one, shard) for one in of_times for shard in one.finished]
    times = [(one.session, float(one.scenes), shard.seconds / shard.scenes) for one, shard in shards]
    tokens = [None if shard.tokens is None else shard.tokens / shard.scenes for _, shard in shards]
    squared = [None if shard.tokens_squared is None else shard.tokens_squared / shard.scenes for _, shard in shards]
    of_worker = trend(WORKER_TIME, times, num_scenes, causes=(tokens, squared))
    allowed = 1000 * _FLAT * of_worker.mean / num_scenes
    found += [of_worker, trend(DRIVER_TIME, list(_times(of_times, _driver_and_ray)), num_scenes, allowed)]
    found.append(trend(WALL_TIME, list(_times(of_times, _seconds)), num_scenes))
    return found


def _warm(runs: Sequence[SoakedRun], warm_up: int) -> Iterator[Sample]:
    """The samples of running jobs, without those in which their processes still grow; sessions of all runs are numbered on."""
    first: dict[tuple[int, int], tuple[int, int]] = {}  # run and session: number, scenes at its begin
    for place, run in enumerate(runs):
        for sample in run.samples:
            number, begin = first.setdefault((place, sample.session), (len(first), sample.scenes))
            if begin + warm_up <= sample.scenes < run.num_scenes:
                yield replace(sample, session=number)


def _times(kept: Sequence[Sample], clock: Callable[[Sample], float]) -> Iterator[tuple[int, float, float]]:
    """The time of a scene in each block of a session: session, number of scenes, seconds."""
    for session in sorted({sample.session for sample in kept}):
        mine = [sample for sample in kept if sample.session == session]
        start = mine[0]
        for sample in mine:
            if (made := sample.scenes - start.scenes) >= _TIME_BLOCK:
                yield session, (start.scenes + sample.scenes) / 2, (clock(sample) - clock(start)) / made
                start = sample


def _driver_and_ray(sample: Sample) -> float:
    return (sample.driver + sample.ray).cpu_seconds


def _seconds(sample: Sample) -> float:
    return sample.seconds


class Soak:
    """The folder of a soak, which is continued from session to session.

    Args:
        folder: The folder.
        num_scenes: Number of scenes.
        per_shard: Scenes of a shard.
        libraries: The asset libraries.
        more: Further options of the job.

    Attributes:
        command: All options of the job.

    Raises:
        ConfigError: The folder is of other settings.
    """

    def __init__(
        self, folder: Path, num_scenes: int, per_shard: int, libraries: Sequence[str] = LIBRARIES, more: Sequence[str] = ()
    ) -> None:
        self.run, self._samples, self._folder = RunFolder(str(folder / "run")), folder / "samples.jsonl", folder
        self.num_scenes, self._per_shard = num_scenes, per_shard
        command = ["generate", "--count", str(num_scenes), *(word for place in libraries for word in ("--assets", place))]
        command += ["--out", self.run.uri, "--workers", str(_WORKERS)]
        self.command = [*command, "--set", "num_pictures=0", "--set", f"scenes_per_shard={per_shard}", *more]
        folder.mkdir(parents=True, exist_ok=True)
        state = folder / "soak.json"
        if state.exists():
            refuse_changed(str(folder), json.loads(state.read_text("utf-8")), {"command": self.command})
        write_file_atomically(state, json.dumps({"command": self.command}).encode())

    @property
    def samples(self) -> list[Sample]:
        """All samples so far."""
        if not self._samples.exists():
            return []
        return [Sample.of(json.loads(line)) for line in self._samples.read_text("utf-8").splitlines()]

    def go(self, until: float) -> bool:
        """Runs the job until it is complete or the session ends; returns whether it is complete.

        Args:
            until: Moment of ``time.monotonic`` at which the session ends.

        Raises:
            RuntimeError: The job ended with an error.
        """
        if self._samples.exists():  # a session that was killed may have written a part of a line
            content = self._samples.read_bytes()
            write_file_atomically(self._samples, content[: content.rfind(b"\n") + 1])
        session = 1 + max((sample.session for sample in self.samples), default=-1)
        told = {shard.shard_id for sample in self.samples for shard in sample.finished}
        command = [sys.executable, "-m", "pipelines", *self.command]
        began = time.monotonic()
        with (self._folder / "log").open("ab") as log, self._samples.open("a", encoding="utf-8") as stream:
            job = started(command, log)
            try:
                while job.poll() is None and time.monotonic() < until:
                    sample = self._look(job.pid, session, time.monotonic() - began, told)
                    stream.write(json.dumps(asdict(sample)) + "\n")
                    stream.flush()
                    try:
                        job.wait(_LOOK_SECONDS)
                    except subprocess.TimeoutExpired:
                        continue
            finally:
                end(job)
        if job.returncode in (DONE, SOME_FAILED) and is_complete(self.run):
            return True
        if time.monotonic() < until:
            raise RuntimeError(f"the job ended with status {job.returncode}, see {self._folder / 'log'}")
        return False

    def _look(self, driver: int, session: int, seconds: float, told: set[str]) -> Sample:
        processes = below([driver])
        workers = [pid for pid, words in processes.items() if words.startswith("ray::") and not words.startswith("ray::Dash")]
        workers = [pid for pid in workers if not processes[pid].startswith("ray::RuntimeEnv")]
        rest = processes.keys() - {driver, *workers}
        written = self.run.shard_ids("scenes")
        finished = [FinishedShard.of_run(self.run, shard_id) for shard_id in sorted(written - told)]
        told |= written
        scenes = min(self.num_scenes, self._per_shard * len(written))
        return Sample(session, round(seconds, 1), scenes, usage_of([driver]), usage_of(workers), usage_of(rest), finished)


def show(found: Sequence[Trend], runs: Sequence[SoakedRun]) -> None:
    """Prints the table."""
    scenes = sum(run.samples[-1].scenes for run in runs if run.samples)
    sessions = sum(len({sample.session for sample in run.samples}) for run in runs)
    print(f"{scenes:,} scenes in {len(runs)} runs and {sessions} sessions, {sum(len(run.samples) for run in runs)} samples")
    failures = sum((Counter(run.failures) for run in runs), Counter[str]())
    by_code = ", ".join(f"{code} {count}" for code, count in failures.most_common()) or "none"
    print(f"{sum(run.accepted for run in runs):,} accepted, {failures.total():,} failed: {by_code}")
    if own := [code for code in FAULTS_OF_THE_TOOLKIT if failures[code]]:
        print(f"failed through the toolkit itself: {', '.join(f'{code} {failures[code]}' for code in own)}")
    versions = dict.fromkeys(version for run in runs for version in run.code_versions)
    print(f"code: {', '.join(versions) or 'unknown'}")
    print_trends(found)


def print_trends(found: Sequence[Trend]) -> None:
    """Prints a line for each trend."""
    print(f"{'':40} {'mean':>10} {'per 1,000 scenes, 95 %':>34} {'all scenes':>11} {'blocks':>7}")
    for one in found:
        if one.slope is None:
            print(f"{one.name:40} {one.mean:10.3f} {'':34} {'':11} {one.blocks:7d}  {one.verdict}")
            continue
        interval = f"{one.slope:+.4f} ({one.low:+.4f} … {one.high:+.4f})"
        print(f"{one.name:40} {one.mean:10.3f} {interval:>34} {one.change:+11.1%} {one.blocks:7d}  {one.verdict}")


def is_good(found: Sequence[Trend], runs: Sequence[SoakedRun]) -> bool:
    """Whether complete runs are whole, nothing that is judged grows or is unknown, and no scene failed through the toolkit itself."""
    is_steady = all(one.verdict in ("flat", "falls") for one in found if one.name != WALL_TIME)
    return is_steady and all(run.is_whole and not any(map(run.failures.get, FAULTS_OF_THE_TOOLKIT)) for run in runs)


def run_campaign() -> int:
    """Prints the figures; returns the status that the text of the module tells.

    Raises:
        ConfigError: The benchmark cannot start.
        RuntimeError: It cannot continue.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("libraries", nargs="*", default=LIBRARIES, metavar="LIBRARY", help="as --assets of generate")
    parser.add_argument("--out", type=Path, required=True, metavar="WORK")
    parser.add_argument("--scenes", type=int, default=20000)
    parser.add_argument("--seed", type=int, default=0, help="of the tasks")
    parser.add_argument(
        "--per-shard", type=int, default=128, help="scenes of a shard; the default is that of generate for many scenes"
    )
    parser.add_argument("--warm-up", type=int, default=4000, help="first scenes of each session that are left out")
    parser.add_argument("--warm-up-of-times", type=int, default=1000, help="the same for the time of a scene")
    parser.add_argument("--minutes", type=float, help="the session ends then; the same command continues")
    parser.add_argument("--json", type=Path, help="output file of the figures and samples")
    parser.add_argument(
        "--with", type=Path, action="append", default=[], dest="others", metavar="FILE", help="output of --json of another run"
    )
    parser.epilog = "after --: further options of the job"
    last = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    arguments, more = parser.parse_args(sys.argv[1:last]), sys.argv[last + 1 :]
    os.environ |= {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}
    until = float("inf") if arguments.minutes is None else time.monotonic() + 60 * arguments.minutes
    seed = ["--seed", str(arguments.seed)]
    others = [SoakedRun.read(path) for path in arguments.others]
    soak = Soak(arguments.out.absolute(), arguments.scenes, arguments.per_shard, arguments.libraries, [*seed, *more])
    is_complete = soak.go(until)
    verdict: dict[str, Any] = verified(soak.run.uri) if is_complete else {"is_whole": False, "verify": []}
    run = SoakedRun(
        arguments.scenes, is_complete, verdict["is_whole"], soak.samples, **outcomes(soak.run), command=soak.command
    )
    runs = [*others, run]
    found = trends(runs, arguments.warm_up, arguments.warm_up_of_times)
    show(found, runs)
    print(*verdict["verify"], sep="\n")
    if arguments.json:
        figures = {"trends": [asdict(one) for one in found], "verify": verdict["verify"], "run": asdict(run)}
        arguments.json.write_text(json.dumps(figures) + "\n", "utf-8")
    if not all(one.is_complete for one in runs):
        print("not complete: run the same command again to continue")
        return NOT_COMPLETE
    return DONE if is_good(found, runs) else 1


if __name__ == "__main__":
    raise SystemExit(status_of(run_campaign))
