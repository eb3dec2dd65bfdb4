"""Whether a job loses rows while processes, nodes, the object store, the disk and the clock fail at random moments.

``python -m benchmarks.chaos DATA --out WORK [--job generate] [--scenes 64] [--kills 8] [--faults kill_driver,clock] [--faulty-store]
[--minutes M] [--json FILE] [-- more options of the job]``. First the job runs undisturbed. Then it runs again on a Ray cluster of a head
and some nodes of one core each, all on this machine, while faults happen to it (``benchmarks.faults.plan``). All rows of the two runs
are compared, and ``stable-data verify`` checks the disturbed one. If it was complete before all faults had happened, it is deleted and
the job runs once more from the start, with the faults that are left.

DATA is a dataset in the MesaTask-10K format. ``preprocess`` and ``correct`` read its first scenes; ``generate`` makes the scenes of
their tasks from its assets. WORK has everything that is made: the same command continues there after ``--minutes``, or after the
benchmark was killed, and the figures are sums over all sessions. All that the faults need is tried before the undisturbed run. Status 0:
complete, every planned fault has hit the job, and the rows are equal. 1: they are not, a fault did not end as it must, or one never hit. 2:
the benchmark itself could not start or continue, which says nothing of the job. 3: not complete yet. 130: Ctrl-C.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args
from unittest.mock import patch

import numpy as np

from benchmarks.faults.comparison import compared
from benchmarks.faults.disturbed_job import Course, DisturbedJob
from benchmarks.faults.nodes import Nodes
from benchmarks.faults.plan import LAST, FaultKind, planned, spread
from benchmarks.faults.processes import ROOT, end, started
from benchmarks.faults.s3_server import CREDENTIALS
from benchmarks.faults.shifted_clock import ShiftedClock
from benchmarks.faults.small_disk import SmallDisk
from stable_data.atomic_files import write_file_atomically
from stable_data.code_version import code_version
from stable_data.commands.command_line import DONE, INTERRUPTED, NOT_STARTED, SOME_FAILED
from stable_data.config_diff import refuse_changed
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.manifest import COMPLETE, read_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS

Job = Literal["preprocess", "correct", "generate"]

NOT_COMPLETE = 3
"""Exit status of a session that ended before the runs were complete."""

_STATE = "chaos.json"
_SCENES = 64
_SAVE_SECONDS = 600.0  # between two times that the objects of a store are stored, which takes seconds
_TRIAL_GIGABYTES = 0.02
_MAX_IDLE_ROUNDS = 3  # rounds in a row without a fault that hits, after which the faults that are left never will
_STORE_FAULTS = ("failed", "slow", "torn")
_SAME = ("lost", "different", "doubled", "added", "files_that_differ", "columns_that_differ")


@dataclass(frozen=True, slots=True)
class ChaosSettings:
    """What is run and disturbed.

    Attributes:
        job: The job.
        scenes: Number of scenes.
        kills: Number of kills.
        seed: Chooses faults, moments and victims.
        faults: Kinds of faults.
        store: URI of a folder on an object store for the disturbed run; None for a local folder.
        faulty_store: Whether the disturbed run is in a store on this machine whose requests fail.
        nodes: Nodes of the cluster, and workers of the undisturbed run.
        per_shard: Scenes of a shard: the most that a killed worker loses.
        more: Further options of the job.
    """

    job: Job
    scenes: int
    kills: int
    seed: int
    faults: tuple[FaultKind, ...]
    store: str | None
    faulty_store: bool
    nodes: int
    per_shard: int
    more: tuple[str, ...]


class ChaosWork:
    """The folder of a benchmark, which is continued from session to session.

    Args:
        data: The dataset.
        folder: The folder.
        settings: What is run.
        until: Moment of ``time.monotonic`` at which the session ends.

    Raises:
        ConfigError: The folder is of other settings or of other code, or the dataset has fewer scenes.
    """

    def __init__(self, data: Path, folder: Path, settings: ChaosSettings, until: float = float("inf")) -> None:
        self.folder, self.settings, self.until = folder, settings, until
        self.course, self.clean_seconds, self.is_clean_complete = Course(), 0.0, False
        self.requests: Counter[str] = Counter()
        state = folder / _STATE
        if state.exists():
            found = json.loads(state.read_text("utf-8"))
            refuse_changed(str(folder), found["settings"], self._stored_settings)
            self.course = Course(**found["course"])
            self.clean_seconds, self.is_clean_complete = found["clean_seconds"], found["is_clean_complete"]
            self.requests = Counter(found["requests"])
        folder.mkdir(parents=True, exist_ok=True)
        self._data = folder / "data"
        _take_scenes(data, self._data, settings.scenes)

    @property
    def _stored_settings(self) -> dict[str, Any]:
        """What must not change from session to session: rows of other code may differ without a fault."""
        return asdict(self.settings) | {"code_version": code_version()}

    def save(self) -> None:
        """Stores what has happened so far."""
        found = {
            "settings": self._stored_settings,
            "course": asdict(self.course),
            "clean_seconds": self.clean_seconds,
            "is_clean_complete": self.is_clean_complete,
            "requests": self.requests,
        }
        write_file_atomically(self.folder / _STATE, (json.dumps(found, indent=2) + "\n").encode())

    def command(self, out: str, *where: str) -> list[str]:
        """Arguments of ``python -m pipelines``."""
        data, settings = str(self._data), self.settings
        inputs = {
            "preprocess": ["--data", data],
            "correct": ["--scenes", data],
            "generate": ["--scenes", data, "--assets", data],
        }[settings.job]
        aside = ["--set", "num_pictures=0", "--set", f"scenes_per_shard={settings.per_shard}"]
        return [settings.job, *inputs, "--out", out, *where, *aside, *settings.more]

    @property
    def clean(self) -> RunFolder:
        """The undisturbed run."""
        return RunFolder(str(self.folder / "clean"))

    def try_faults(self) -> None:
        """Tries all that the faults need, so that a run of hours does not end since something is missing.

        Raises:
            ConfigError: The clock cannot be shifted, no disk can be mounted, or the store on this machine does not answer.
        """
        with TemporaryDirectory(dir=self.folder, prefix=".trial_") as aside:
            if FaultKind.CLOCK in self.settings.faults:
                ShiftedClock(Path(aside) / "clock")
            if self._has_disk:
                SmallDisk(Path(aside), _TRIAL_GIGABYTES).close()
            if self.settings.faulty_store:
                _try_store(Path(aside) / "store")

    @property
    def _has_disk(self) -> bool:
        """Whether the disturbed run is on a disk of its own."""
        settings = self.settings
        return FaultKind.FULL_DISK in settings.faults and not settings.faulty_store and settings.store is None

    def run_undisturbed(self) -> bool:
        """Runs the job without faults; returns whether it is complete.

        Raises:
            RuntimeError: It ended with an error.
        """
        if self.is_clean_complete:
            return True
        command = [sys.executable, "-m", "pipelines", *self.command(self.clean.uri, "--workers", str(self.settings.nodes))]
        began, before = time.monotonic(), self.clean_seconds
        with (self.folder / "clean.log").open("ab") as log:
            job = started(command, log)
            try:
                job.wait(None if self.until == float("inf") else max(1.0, self.until - began))
            except subprocess.TimeoutExpired:
                pass
            finally:
                is_ended_here = job.poll() is None
                end(job)
                self.clean_seconds = before + time.monotonic() - began
                self.is_clean_complete = job.returncode in (DONE, SOME_FAILED) and is_complete(self.clean)
                self.save()
        if not self.is_clean_complete and not is_ended_here:
            raise RuntimeError(f"the undisturbed job ended with status {job.returncode}, see {self.folder / 'clean.log'}")
        return self.is_clean_complete

    def disturb(self) -> dict[str, Any] | None:
        """Runs the job with faults and compares it; returns the figures, or None if the session ended before."""
        settings = self.settings
        with ExitStack() as stack:
            stack.enter_context(patch.dict(os.environ))
            disk = clock = store = None
            before = Counter(self.requests)
            out = look = str(self.folder / "disturbed")
            if settings.faulty_store:
                from benchmarks.faults.faulty_store import FaultyStore

                os.environ |= CREDENTIALS
                store = FaultyStore(self.folder / "store", settings.seed)
                stack.callback(store.close)
                out, look = store.uri("disturbed"), store.calm_uri("disturbed")
            elif settings.store is not None:
                out = look = settings.store
            elif self._has_disk:
                disk = SmallDisk(self.folder, 1.0 + 3e-9 * _size_of(Path(self.clean.root)))
                stack.callback(disk.close)
                out = look = str(disk.root / "disturbed")
            if FaultKind.CLOCK in settings.faults:
                clock = ShiftedClock(self.folder / "clock")
                os.environ |= clock.environment  # the nodes and their workers too
            saved = time.monotonic()

            def save(at_once: bool = False) -> None:
                """Stores the course; that of a store only together with its objects."""
                nonlocal saved
                if store is not None:
                    if not at_once and time.monotonic() - saved < _SAVE_SECONDS:
                        return
                    store.save()
                    self.requests = before + Counter(store.counts())
                    saved = time.monotonic()
                self.save()

            if not self.course.is_complete:
                nodes = Nodes(settings.nodes)
                stack.callback(nodes.close)
                tables = [table for table in SCHEMAS if self.clean.files(table)]
                job = DisturbedJob(
                    lambda address: self.command(out, "--address", address),
                    RunFolder(look),
                    tables,
                    sum(len(self.clean.files(table)) for table in tables),
                    nodes,
                    self.folder / "logs",
                    self.course,
                    settings.seed,
                    clock,
                    disk,
                    until=self.until,
                    save=save,
                )
                try:
                    while not self.course.is_complete and self._round(job):
                        save()
                finally:
                    save(at_once=True)
        return self.figures() if self.course.is_complete else None

    def _round(self, job: DisturbedJob) -> bool:
        """Runs the job to its end with the faults that are left, and compares it; returns False if the session ended before."""
        course, settings = self.course, self.settings
        kinds, rng = self._planned[course.begins :], np.random.default_rng([settings.seed, course.rounds])
        last = 0.0 if course.idle_rounds else LAST  # what did not come in time, comes at the start
        if not job.go(spread(kinds, rng, last)):
            return False
        meshes = ["--assets", str(self._data)] if settings.job == "correct" else []  # in a store, nothing else has them
        found = compared(self.clean, job.run) | verified(job.run.uri, *meshes)
        for key, value in found.items():
            course.rows[key] = value if isinstance(value, bool | list) else course.rows.get(key, 0) + value
        course.idle_rounds = 0 if course.passed > course.begins else course.idle_rounds + 1
        course.rounds, course.begins = course.rounds + 1, course.passed
        course.is_complete = not is_same(found) or course.passed == len(self._planned) or course.idle_rounds == _MAX_IDLE_ROUNDS
        if not course.is_complete:
            job.run.filesystem.delete_dir(job.run.root)
        return True

    @property
    def _planned(self) -> list[FaultKind]:
        return planned(self.settings.faults, self.settings.kills, np.random.default_rng(self.settings.seed))

    def figures(self) -> dict[str, Any]:
        """What has happened so far."""
        settings, course = self.settings, self.course
        wanted = Counter(map(str, self._planned))
        hits = {kind: course.hits.get(kind, 0) for kind in wanted}
        missed = [f"{kind}: {hits[kind]} of {count}" for kind, count in wanted.items() if hits[kind] < count]
        if settings.faulty_store:
            missed += [f"store: no request was {name}" for name in _STORE_FAULTS if not self.requests[name]]
        return {
            "settings": self._stored_settings,
            "job": settings.job,
            "scenes": settings.scenes,
            "seconds_undisturbed": self.clean_seconds,
            "seconds_disturbed": course.seconds,
            "hits": hits,
            "missed": missed,
            "rounds": course.rounds,
            "requests": dict(self.requests),
            "starts": course.starts,
            "finished_early": course.finished_early,
            "stops": course.stops,
            "last_words": course.last_words,
            "unclear": course.unclear,
            **course.rows,
        }


def is_complete(run: RunFolder) -> bool:
    """Whether a run is complete, as its manifest says."""
    return (read_manifest(run) or {}).get("status") == COMPLETE


def verified(uri: str, *more: str) -> dict[str, Any]:
    """Verifies a run, with further options: ``is_whole``, and the last lines of ``stable-data verify``.

    Raises:
        RuntimeError: The command ended without a verdict.
    """
    command = [sys.executable, "-m", "stable_data", "verify", uri, "--quiet", *more]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    lines = (done.stdout + done.stderr).strip().splitlines()[-3:]
    if done.returncode not in (DONE, SOME_FAILED):
        raise RuntimeError(f"stable-data verify {uri} ended with status {done.returncode}: {'; '.join(lines) or 'no output'}")
    return {"is_whole": done.returncode == DONE, "verify": lines}


def _try_store(folder: Path) -> None:
    """Starts a store on this machine, and writes and reads an object.

    Raises:
        ConfigError: A package is missing, or the store does not answer (``store_not_served``).
    """
    content = b"a trial"
    try:
        from benchmarks.faults.faulty_store import FaultyStore, Rates

        with patch.dict(os.environ, CREDENTIALS):
            store = FaultyStore(folder, rates=Rates(failed=0.0, slow=0.0, torn=0.0))
            try:
                run = RunFolder(store.uri("trial"))
                run.write_bytes("trial", content)
                if run.read_bytes("trial") != content:
                    raise ConfigError("an object was read with another content than it was written with", "store_not_served")
            finally:
                store.close()
    except (ImportError, OSError, EOFError, ConfigError) as error:
        raise ConfigError(
            f"no object store can be served on this machine ({error or type(error).__name__}); install the development extra "
            "(make env), or leave --faulty-store out",
            "store_not_served",
        ) from error


def _take_scenes(data: Path, target: Path, count: int) -> None:
    """Makes a dataset of the first scenes of another one, whose assets it uses, unless it is there.

    Raises:
        ConfigError: There are fewer scenes.
    """
    if target.is_dir():
        return
    dataset = MesaTaskDataset(data.resolve())
    if len(dataset.scene_ids) < count:
        raise ConfigError(
            f"{data}: has {len(dataset.scene_ids)} scenes, expected at least {count}; choose fewer --scenes", "usage"
        )
    aside = target.with_name(f".{target.name}.tmp")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir()
    wanted = set(dataset.scene_ids[:count])
    for layout in sorted((dataset.root / "Layout_info").glob("*/*/layout.json")):
        if layout.parent.name in wanted:
            place = layout.parent.relative_to(dataset.root)
            shutil.copytree(layout.parent, aside / place)
    for entry in dataset.root.iterdir():
        if entry.name != "Layout_info":
            (aside / entry.name).symlink_to(entry, target_is_directory=entry.is_dir())
    aside.replace(target)


def _size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def is_same(figures: Mapping[str, Any]) -> bool:
    """Whether no row is lost, doubled or different, and the run is whole."""
    return not any(figures[key] for key in _SAME) and bool(figures["is_whole"])


def show(figures: Mapping[str, Any]) -> None:
    """Prints the table."""
    requests = figures["requests"]
    hits = ", ".join(f"{kind} {count}" for kind, count in figures["hits"].items())
    disturbed, undisturbed, rounds = figures["seconds_disturbed"], figures["seconds_undisturbed"], figures["rounds"]
    wall = f"{disturbed:.0f} s in {rounds} rounds against {undisturbed:.0f} s undisturbed, {disturbed / rounds / undisturbed:.2f} times"
    rows = {
        "job, scenes": f"{figures['job']}, {figures['scenes']}",
        "faults that hit": f"{sum(figures['hits'].values())}: {hits or 'none'}",
        "faults that never hit": "; ".join(figures["missed"]) or "none",
        "requests to the store": ", ".join(f"{name} {count}" for name, count in requests.items()),
        "starts of the job": figures["starts"],
        "ended by itself before a fault": f"{figures['finished_early']} times done, {figures['stops']} times with an error",
        "ends that were not clear": len(figures["unclear"]),
        "wall time": wall,
        "rows compared": figures["rows"],
        "rows lost, different, doubled, added": ", ".join(
            str(figures[key]) for key in ("lost", "different", "doubled", "added")
        ),
        "columns that differ": ", ".join(figures["columns_that_differ"]) or "none",
        "files of the dataset that differ": figures["files_that_differ"],
        "stable-data verify": f"{'whole' if figures['is_whole'] else 'NOT WHOLE'}: {next(reversed(figures['verify']), 'no output')}",
    }
    for name, value in rows.items():
        if value not in (None, ""):
            print(f"{name:40} {value}")
    for words in [*figures["unclear"], *figures["last_words"]]:
        print(f"  {words}")


def faults_of(text: str | None, kills: int, *, in_store: bool) -> tuple[FaultKind, ...]:
    """Reads a list of faults; by default all that can happen. A store is never full.

    Raises:
        ConfigError: A fault is unknown, cannot happen in a store, or would never happen (``usage``).
    """
    impossible = {FaultKind.FULL_DISK} if in_store else set[FaultKind]()
    names = [*FaultKind] if text is None else [name.strip() for name in text.split(",") if name.strip()]
    if unknown := [name for name in names if name not in set(FaultKind)]:
        raise ConfigError(f"--faults has {unknown[0]!r}, expected some of {', '.join(FaultKind)}", "usage")
    if text is not None and impossible & set(names):
        raise ConfigError("--faults has full_disk, but the run is in a store; leave it out, or the store", "usage")
    kinds = tuple(kind for kind in FaultKind if kind in names and kind not in impossible)
    if kills < (deadly := sum(kind.is_kill for kind in kinds)):
        raise ConfigError(
            f"--kills is {kills}, expected at least one for each of the {deadly} kinds of kills in --faults", "usage"
        )
    return kinds


def status_of(campaign: Callable[[], int]) -> int:
    """Runs a campaign of hours; returns its exit status, which tells an error of the campaign itself from what was measured."""
    try:
        return campaign()
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted; run the same command again", file=sys.stderr)
        return INTERRUPTED
    except Exception:  # noqa: BLE001 - Ray's errors have no type in common
        traceback.print_exc()
        print("the benchmark could not continue, which says nothing of the job; run the same command again", file=sys.stderr)
    return NOT_STARTED


def run_campaign(words: Sequence[str]) -> int:
    """Prints the figures; returns the status that the text of the module tells.

    Args:
        words: The arguments of the command.

    Raises:
        ConfigError: The benchmark cannot start.
        RuntimeError: It cannot continue.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="WORK")
    parser.add_argument("--job", choices=get_args(Job), default="generate")
    parser.add_argument("--scenes", type=int, help="the first 64 by default, or all if there are fewer")
    parser.add_argument("--kills", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--faults", help=f"some of {', '.join(FaultKind)}, joined by commas; all by default")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--store", metavar="URI", help="the disturbed run is there, in a folder that is not there yet")
    where.add_argument("--faulty-store", action="store_true", help="it is in a store on this machine whose requests fail")
    parser.add_argument("--nodes", type=int, default=2, help="nodes of one core each; workers of the undisturbed run")
    parser.add_argument("--per-shard", type=int, default=8, help="scenes of a shard: the most that a killed worker loses")
    parser.add_argument("--minutes", type=float, help="the session ends then; the same command continues")
    parser.add_argument("--json", type=Path)
    parser.epilog = "after --: further options of the job"
    last = list(words).index("--") if "--" in words else len(words)
    found, more = parser.parse_args(words[:last]), words[last + 1 :]
    os.environ |= {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}  # the nodes' workers have one core each
    until = float("inf") if found.minutes is None else time.monotonic() + 60 * found.minutes
    settings = ChaosSettings(
        found.job,
        found.scenes or min(_SCENES, len(MesaTaskDataset(found.data.resolve()).scene_ids)),
        found.kills,
        found.seed,
        faults_of(found.faults, found.kills, in_store=found.store is not None or found.faulty_store),
        found.store,
        found.faulty_store,
        found.nodes,
        found.per_shard,
        tuple(more),
    )
    work = ChaosWork(found.data, found.out.absolute(), settings, until)
    work.try_faults()
    figures = work.disturb() if work.run_undisturbed() else None
    if figures is None:
        done = f"{work.course.passed} faults have happened" if work.is_clean_complete else "the undisturbed run is not complete"
        print(f"not complete: {done}; run the same command again to continue")
        return NOT_COMPLETE
    show(figures)
    if found.json:
        found.json.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")
    return DONE if is_same(figures) and not figures["unclear"] and not figures["missed"] else 1


if __name__ == "__main__":
    raise SystemExit(status_of(lambda: run_campaign(sys.argv[1:])))
