"""Whether a run loses rows while its driver, its workers and whole nodes are killed at random.

``python -m benchmarks.chaos [--scenes 64] [--kills 6] [--seed 0] [--engine embedded] [--per-shard 8] [--json FILE]``: the
generate job on a Ray cluster of a head and three nodes of one core each, all on this machine, first undisturbed, then with
kills. The tables of the two runs are compared row by row. A long run is ``--scenes 1000 --kills 20 --per-shard 16``.

- A killed driver is started again at once with the same command, as a batch system does with a requeued job.
- A killed worker is one that is busy with a shard.
- A killed node loses all its processes at the same moment; another node starts up to 20 s later.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from ray.cluster_utils import Cluster

from models.semantic_reasoner.staged_layout import task_of_scene
from pipelines.generate.shard import GenerateWork
from stable_data.commands.command_line import DONE, SOME_FAILED
from stable_data.embedded_world import EmbeddedWorld, write_world
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS

ROOT = Path(__file__).resolve().parents[1]

_LAST = 0.9  # share of written shards after which no kill is planned: the run could end before it
_ABSENT_SECONDS = 20.0  # longest time until another node replaces a killed one
_LOOK_SECONDS = 0.2


class Victim(StrEnum):
    """The kinds of victims."""

    DRIVER = "driver"
    WORKER = "worker"
    NODE = "node"


@dataclass(frozen=True, slots=True)
class Kill:
    """One kill.

    Attributes:
        at: Share of shards written before it.
        victim: The kind of the victim.
    """

    at: float
    victim: Victim


@dataclass(slots=True)
class ChaosRun:
    """The course of a run.

    Attributes:
        seconds: Wall time from its first start to its end.
        kills: Number of kills of each kind.
        stops: Number of times that the job ended by itself with an error and was started again; 0 is expected.
        last_words: The last error line of each stop.
    """

    seconds: float = 0.0
    kills: Counter[str] = field(default_factory=Counter)
    stops: int = 0
    last_words: list[str] = field(default_factory=list)


def planned(count: int, rng: np.random.Generator) -> list[Kill]:
    """Plans kills at random moments of a run; the numbers of the kinds differ by at most one."""
    victims = list(Victim)
    moments = sorted(rng.uniform(0, _LAST, count))
    return [Kill(float(at), victims[k % len(victims)]) for at, k in zip(moments, rng.permutation(count), strict=True)]


class Nodes:
    """A Ray cluster on this machine: a head that runs no shard, and nodes of one core each.

    Args:
        count: Number of nodes besides the head.
    """

    def __init__(self, count: int = 3) -> None:
        self._cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        self._absent: list[float] = []
        self._added = 0
        for _ in range(count):
            self._add()

    @property
    def address(self) -> str:
        """The address of the cluster for a driver."""
        return str(self._cluster.address)

    def busy(self) -> list[int]:
        """Returns the processes that work on a shard."""
        return busy_workers(_raylet(node) for node in self._cluster.worker_nodes)

    def lose(self, rng: np.random.Generator) -> bool:
        """Kills all processes of a node at once; returns whether there was a node."""
        nodes = sorted(self._cluster.worker_nodes, key=_raylet)
        if not nodes:
            return False
        node = nodes[int(rng.integers(len(nodes)))]
        for process in below([_raylet(node)]):
            _kill(process)
        self._cluster.remove_node(node, allow_graceful=False)
        self._absent.append(time.monotonic() + float(rng.uniform(0, _ABSENT_SECONDS)))
        return True

    def restore(self) -> None:
        """Adds the nodes that are due to replace killed ones."""
        due = [moment for moment in self._absent if moment <= time.monotonic()]
        self._absent = [moment for moment in self._absent if moment not in due]
        for _ in due:
            self._add()

    def _add(self) -> None:
        self._added += 1
        own = (
            f"resources_of_node_{self._added}"  # a node deletes what it has unpacked, so nodes on one machine must not share it
        )
        self._cluster.add_node(num_cpus=1, runtime_env_dir_name=own)

    def close(self) -> None:
        """Shuts the cluster down."""
        self._cluster.shutdown()


def below(roots: Iterable[int]) -> dict[int, str]:
    """Returns processes and all that they have started, with their command lines."""
    listing = subprocess.run(["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True, check=True).stdout
    processes = [(int(pid), int(ppid), args) for pid, ppid, args in (x.split(maxsplit=2) for x in listing.splitlines()[1:])]
    found, size = set(roots), 0
    while len(found) > size:
        size = len(found)
        found |= {pid for pid, parent, _ in processes if parent in found}
    return {pid: args for pid, _, args in processes if pid in found}


def busy_workers(roots: Iterable[int]) -> list[int]:
    """Returns Ray's workers below some processes that work on a shard."""
    return sorted(pid for pid, args in below(roots).items() if args.startswith("ray::_call"))


def _raylet(node: Any) -> int:
    return int(node.all_processes["raylet"][0].process.pid)


def _kill(process: int) -> None:
    try:
        os.kill(process, signal.SIGKILL)
    except ProcessLookupError:
        return  # it had ended already


@dataclass(slots=True)
class DisturbedCommand:
    """A command that runs on a cluster, and is disturbed while it runs.

    Attributes:
        command: The command; it ends with DONE or SOME_FAILED, and resumes after a kill.
        out: The run folder that it writes.
        table: The table whose shards are written last.
        num_shards: Number of shards at the end.
        nodes: The cluster.
        rng: Chooses moments and victims.
        delay_seconds: Longest time between the shard that a kill waits for and the kill.
    """

    command: Sequence[str]
    out: str
    table: str
    num_shards: int
    nodes: Nodes
    rng: np.random.Generator
    delay_seconds: float = 3.0

    def run(self, kills: Sequence[Kill]) -> ChaosRun:
        """Runs the command to its end.

        Raises:
            RuntimeError: It ended with an error more than three times.
        """
        course, waiting, began = ChaosRun(), deque(kills), time.monotonic()
        with tempfile.TemporaryFile("w+") as log:
            driver = self._start(log)
            while (status := driver.poll()) not in (DONE, SOME_FAILED):
                self.nodes.restore()
                if status is not None:
                    self._note(course, log)
                    driver = self._start(log)
                elif waiting and self._share_done() >= waiting[0].at:
                    time.sleep(float(self.rng.uniform(0, self.delay_seconds)))
                    if self._kill_victim(waiting[0].victim, driver):
                        course.kills[waiting.popleft().victim] += 1
                        driver = driver if driver.poll() is None else self._start(log)
                else:
                    time.sleep(_LOOK_SECONDS)
        course.seconds = time.monotonic() - began
        return course

    def _start(self, log: Any) -> subprocess.Popen[str]:
        return subprocess.Popen(self.command, cwd=ROOT, stdout=log, stderr=log, start_new_session=True, text=True)

    def _share_done(self) -> float:
        return len(RunFolder(self.out).shard_ids(self.table)) / self.num_shards

    def _kill_victim(self, victim: Victim, driver: subprocess.Popen[str]) -> bool:
        """Kills a victim of a kind; returns whether there was one."""
        if driver.poll() is not None:
            return False
        if victim is Victim.NODE:
            return self.nodes.lose(self.rng)
        if victim is Victim.WORKER:
            return self._kill_busy_worker(driver)
        os.killpg(driver.pid, signal.SIGKILL)
        driver.wait()
        return True

    def _kill_busy_worker(self, driver: subprocess.Popen[str]) -> bool:
        """Kills a worker as soon as one is busy; returns False if the driver ends first."""
        while driver.poll() is None:
            self.nodes.restore()
            if busy := self.nodes.busy():
                _kill(busy[int(self.rng.integers(len(busy)))])
                return True
            time.sleep(_LOOK_SECONDS)
        return False

    def _note(self, course: ChaosRun, log: Any) -> None:
        """Notes the error with which the job ended; raises RuntimeError after too many."""
        log.seek(0)
        lines = [line for line in log.read().splitlines() if line.startswith("error: ")] or ["no error line"]
        course.stops += 1
        course.last_words.append(lines[-1])
        if course.stops > 3:
            raise RuntimeError(
                f"{' '.join(self.command)}: ended {course.stops} times with an error, expected none: {lines[-1]}"
            )


def compared(clean: RunFolder, other: RunFolder) -> dict[str, Any]:
    """Compares all tables of a disturbed run with those of an undisturbed one.

    Returns:
        ``rows``: rows of the undisturbed run; ``lost``: those missing in the other run; ``added``: rows of the other run alone;
        ``duplicates``: additional rows of the same scene in its scenes and failures; ``columns_that_differ``, in a value or in
        the order of values, as ``table.column``.
    """
    figures, differ = Counter(rows=0, lost=0, added=0), []
    for table in (table for table in SCHEMAS if clean.files(table)):
        first, second = clean.table(table), other.table(table)
        expected, found = (Counter(map(repr, x.to_pylist())) for x in (first, second))
        figures.update(rows=expected.total(), lost=(expected - found).total(), added=(found - expected).total())
        differ += [f"{table}.{name}" for name in first.column_names if first[name] != second[name]]
    ends = [*other.table("scenes", ["scene_id"])["scene_id"].to_pylist(), *other.table("failures", ["id"])["id"].to_pylist()]
    return dict(figures) | {"duplicates": len(ends) - len(set(ends)), "columns_that_differ": differ}


def tasks_of_world(path: Path, count: int) -> None:
    """Writes a file of tasks: those of some embedded scenes, repeated under new names and so with new seeds."""
    root = path.parent / "world"
    write_world(root, min(count, 24), EmbeddedWorld(pictures=False))
    dataset = MesaTaskDataset(root)
    known = [task_of_scene(dataset.read(scene_id)[0]) for scene_id in dataset.scene_ids]
    with path.open("w", encoding="utf-8") as stream:
        for number in range(count):
            task = known[number % len(known)]
            row = {
                "scene_id": f"scene_{number:05d}",
                "instruction": task.instruction,
                "table_type": task.table.table_type,
                "table_size_cm": [100 * side for side in task.table.size_xy],
            }
            stream.write(json.dumps(row) + "\n")


def measure(num_scenes: int, kills: int, seed: int, engine: str, per_shard: int) -> dict[str, Any]:
    """Measures all figures."""
    courses: dict[str, ChaosRun] = {}
    with tempfile.TemporaryDirectory() as folder:
        tasks_of_world(Path(folder) / "tasks.jsonl", num_scenes)
        for name, planned_kills in (("clean", 0), ("disturbed", kills)):
            nodes, out, rng = Nodes(), f"{folder}/{name}", np.random.default_rng(seed)
            command = [sys.executable, "-m", "pipelines", "generate", "--tasks", f"{folder}/tasks.jsonl", "--out", out]
            command += ["--engine", engine, "--address", nodes.address]
            command += ["--set", f"scenes_per_shard={per_shard}", "--set", "num_pictures=0"]
            try:
                run = DisturbedCommand(command, out, GenerateWork.TABLES[-1], -(-num_scenes // per_shard), nodes, rng)
                courses[name] = run.run(planned(planned_kills, rng))
            finally:
                nodes.close()
        figures = compared(RunFolder(f"{folder}/clean"), RunFolder(f"{folder}/disturbed"))
    clean, disturbed = courses["clean"], courses["disturbed"]
    return {
        "scenes": num_scenes,
        "seconds_undisturbed": clean.seconds,
        "seconds_disturbed": disturbed.seconds,
        "kills": {str(kind): disturbed.kills[kind] for kind in Victim},
        "stops": disturbed.stops,
        "last_words": disturbed.last_words,
        **figures,
    }


def show(figures: dict[str, Any]) -> None:
    """Prints the table."""
    by_kind = ", ".join(f"{kind} {count}" for kind, count in figures["kills"].items())
    wall = f"{figures['seconds_disturbed']:.0f} s against {figures['seconds_undisturbed']:.0f} s undisturbed"
    rows = {
        "scenes": figures["scenes"],
        "kills": by_kind,
        "ended by itself and was started again": figures["stops"],
        "wall time": f"{wall}, {figures['seconds_disturbed'] / figures['seconds_undisturbed']:.2f} times",
        "rows compared": figures["rows"],
        "rows lost, rows added": f"{figures['lost']}, {figures['added']}",
        "duplicates": figures["duplicates"],
        "columns that differ": ", ".join(figures["columns_that_differ"]) or "none",
    }
    for name, value in rows.items():
        print(f"{name:40} {value}")
    for words in figures["last_words"]:
        print(f"  {words}")


def main() -> None:
    """Prints the figures; the status is 1 if the runs differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=64)
    parser.add_argument("--kills", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", default="embedded", help="engine of the generate job")
    parser.add_argument("--per-shard", type=int, default=8, help="scenes of a shard: the most that a killed worker loses")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}  # the nodes' workers have one core each
    figures = measure(arguments.scenes, arguments.kills, arguments.seed, arguments.engine, arguments.per_shard)
    show(figures)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")
    if any(figures[key] for key in ("lost", "added", "duplicates", "columns_that_differ")):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
