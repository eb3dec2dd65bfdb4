"""The cost of a generated scene: end to end, by step, against serial alternation, and on the driver of a cluster.

``python -m benchmarks.generation [--scenes 128] [--serial-scenes 24] [--scripted 100 1000] [--weights auto] [--json FILE]``

Every run is the command ``python -m pipelines generate`` in its own processes, on tasks that were sampled before. Its time is
that of its shards, with the start of Ray and of its workers, which load models and libraries. Assets are decomposed and words
encoded once a process, so a run with more scenes is faster a scene.

- pipelined: two workers, each with a quarter of the scenes (up to 128) in parallel: some are corrected while others are proposed.
- serial: Algorithm 1 with M = 1, one scene after the other in one process, with as many threads as the machine has cores and
  with one; the comparison uses the faster of both.
- in process, and on Ray with one worker: the same shards on one core: the overhead of Ray.
- two plain processes: half of the same tasks each, without Ray: the loss of two workers.
- scripted: a reasoner that answers at once, tables of three objects: the growth of memory, and the cost of the driver and of
  Ray's object store.
- elsewhere: the same reasoner behind an endpoint that answers one batch of up to 64 at a time, some seconds each, like a GPU
  shared by the workers; called by the worker itself, which waits, and by an engine beside it, so that the worker corrects
  another shard meanwhile.

Each figure is printed and written as soon as it is measured.
"""

import argparse
import json
import os
import resource
import runpy
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import ray

from models.semantic_reasoner.engines.protocol import Request
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.generate.report import TimeSpent
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import SampledTask, sample_tasks
from stable_data.commands.command_line import DONE, SOME_FAILED
from stable_data.scene import Stage
from stable_data.storage.run_folder import RunFolder
from tests.models.semantic_reasoner.engines.endpoint import FORM, Act, endpoint, said

_ONE_CORE = {"OMP_NUM_THREADS": "1", "IGL_NUM_THREADS": "1"}
_SHARDS_OF_A_MILLION = 7_813


@dataclass(frozen=True, slots=True)
class GenerationRun:
    """The figures of a run.

    Attributes:
        scenes: Number of requested scenes.
        accepted: Number of accepted scenes.
        seconds: Wall time of all shards.
        steps: Step -> seconds of single processes, over all scenes.
    """

    scenes: int
    accepted: int
    seconds: float
    steps: dict[str, float]

    @property
    def a_minute(self) -> float:
        """Accepted scenes a minute."""
        return 60 * self.accepted / self.seconds


def command(out: Path, *words: str) -> list[str]:
    """Returns the command line of the job."""
    return [sys.executable, "-m", "pipelines", "generate", "--out", str(out), *words, "--set", "num_pictures=0"]


def run(out: Path, *words: str, threads: bool = False, cores: Set[int] | None = None) -> GenerationRun:
    """Runs the job once, on some cores or on all; its status must be 0 or 1."""
    environment = {key: value for key, value in os.environ.items() if key not in _ONE_CORE} | ({} if threads else _ONE_CORE)
    keep = None if cores is None else partial(os.sched_setaffinity, 0, cores)
    done = subprocess.run(command(out, *words), env=environment, capture_output=True, text=True, check=False, preexec_fn=keep)
    if done.returncode not in (DONE, SOME_FAILED):
        raise SystemExit(done.stderr.strip()[-2000:])
    return checked(course_of(out))


def checked(course: GenerationRun) -> GenerationRun:
    """Returns a run with at least 90 % accepted scenes; a run in which scenes fail is fast and would not be comparable."""
    if course.accepted < 0.9 * course.scenes:
        raise SystemExit(f"{course.accepted} of {course.scenes} scenes are accepted, expected at least 90 %")
    return course


def course_of(out: Path) -> GenerationRun:
    """Reads the figures of a run from its files."""
    folder = RunFolder(str(out))
    manifest = json.loads((out / "manifest.json").read_text("utf-8"))
    spent = TimeSpent.of_run(folder)
    return GenerationRun(
        spent.num_scenes, folder.num_rows("scenes"), sum(w["seconds"] for w in manifest["work"]), dict(spent.steps)
    )


def tasks_file(path: Path, tasks: Sequence[LayoutTask]) -> Path:
    """Writes a file of tasks."""
    with path.open("w", encoding="utf-8") as stream:
        for task in tasks:
            zone = task.table.restricted_zone
            row = {
                "scene_id": task.scene_id,
                "instruction": task.instruction,
                "table_type": task.table.table_type,
                "table_size_cm": [100 * side for side in task.table.size_xy],
                "restricted_zone_cm": None if zone is None else [100 * side for side in zone],
            }
            stream.write(json.dumps(row) + "\n")
    return path


def side_by_side(place: Path, parts: Sequence[Sequence[str]]) -> float:
    """Runs parts in plain processes at the same time, and returns the seconds of the slowest."""
    with ThreadPoolExecutor(len(parts)) as pool:
        done = pool.map(lambda k: run(place / f"part{k}", *parts[k]), range(len(parts)))
        return max(course.seconds for course in done)


def scripted(folder: Path) -> Path:
    """Writes a script for a reasoner that puts the library's first assets on every table."""
    script = {}
    for stage, asset in zip(Stage, AssetLibraries().libraries[0].assets[1:4], strict=True):
        size = [round(12 * side / max(asset.tilts[0].extents), 1) + 0.1 for side in asset.tilts[0].extents]
        there = {"description": asset.words, "size": size, "position": [20.0, 20.0, round(size[2] / 2, 1)], "z_rotation": 90}
        script[WANTED[stage]] = {"objects": [{"instance": f"{asset.category}_0", **there}]}
    path = folder / "script.json"
    path.write_text(json.dumps(script), "utf-8")
    return path


def memory_of(place: Path, script: Path, count: int) -> dict[str, float]:
    """Measures the largest resident memory of a run's process, megabytes, with a reasoner that answers at once, and its seconds."""
    words = ["--count", str(count), "--workers", "0", "--engine", f"scripted:{script}", "--set", "weights=none"]
    words += ["--set", "settle=false", "--set", "accept=clean"]
    began = time.perf_counter()
    child = subprocess.Popen(command(place / f"scripted{count}", *words), env=os.environ | _ONE_CORE, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (DONE, SOME_FAILED):
        raise SystemExit(
            f"the scripted run of {count} ended with status {os.waitstatus_to_exitcode(status)}, expected {DONE} or {SOME_FAILED}"
        )
    checked(course_of(place / f"scripted{count}"))
    return {"scenes": count, "megabytes": used.ru_maxrss / 1024, "seconds": time.perf_counter() - began}


def driver_of(place: Path, script: Path, count: int) -> dict[str, float]:
    """Measures the cost of a run's driver with a reasoner that answers at once: :func:`driven` in its own process."""
    words = ["--count", str(count), "--engine", f"scripted:{script}", "--set", "weights=none", "--set", "settle=false"]
    words += ["--set", "accept=clean", "--workers", "2"]
    done = subprocess.run(
        [sys.executable, "-c", "import benchmarks.generation; benchmarks.generation.driven()"],
        input=json.dumps(command(place / f"driver{count}", *words)[3:]),
        env=os.environ | _ONE_CORE,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(done.stderr.strip()[-2000:])
    checked(course_of(place / f"driver{count}"))
    return {"scenes": count, **json.loads(done.stdout.splitlines()[-1])}


def driven() -> None:
    """Runs the command line from standard input, and prints the cost for this process and for Ray's object store.

    The figures: processor seconds, megabytes of the largest resident memory, and megabytes of Ray's objects by its own account,
    read twice a second. The cost of the workers is not included.
    """
    words, end = json.loads(sys.stdin.read()), threading.Event()
    stored: list[float] = []

    def look() -> None:
        while not end.wait(0.5):
            with suppress(ray.exceptions.RaySystemError, KeyError):  # Ray has not started yet, or has ended
                stored.append(ray.cluster_resources()["object_store_memory"] - ray.available_resources()["object_store_memory"])

    threading.Thread(target=look, daemon=True).start()
    sys.argv = ["pipelines", *words]
    try:
        runpy.run_module("pipelines", run_name="__main__")
    except SystemExit as stop:
        if stop.code not in (DONE, SOME_FAILED):
            raise
    end.set()
    if len(stored) < 2:
        raise SystemExit("Ray's object store was read less than twice, expected a longer run")
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    found = {"seconds": time.process_time(), "megabytes": megabytes, "objects_mb": max(stored) / 1e6, "looks": len(stored)}
    print(json.dumps(found))


class Batches:
    """Replies of an engine in batches that take some seconds each, one after the other.

    Attributes:
        count: Number of batches so far.
    """

    def __init__(self, engine: ScriptedEngine, batch_seconds: float, most: int = 64) -> None:
        self._engine, self._batch_seconds, self._most = engine, batch_seconds, most
        self._lock, self._begins, self._ends, self._size, self.count = threading.Lock(), 0.0, 0.0, 0, 0

    def __call__(self, words: str, number: int, body: dict[str, Any]) -> Act:
        """Returns the reply to a request, at the end of the first batch that has room for it."""
        now = time.monotonic()
        with self._lock:
            if now >= self._begins or self._size == self._most:
                self._begins = max(now + 0.25, self._ends)  # a batch waits briefly for more requests
                self._ends, self._size, self.count = self._begins + self._batch_seconds, 0, self.count + 1
            self._size += 1
            (found,) = self._engine.complete([Request(tuple(body["messages"]), FORM, body["seed"])])
            return Act(body=said(found.text), after_s=self._ends - now)


def elsewhere(place: Path, script: Path, scenes: int, batch_seconds: float) -> dict[str, float]:
    """Measures how busy an endpoint and one core are: if the worker waits for the endpoint, and if an engine waits instead.

    The run has one core of this machine; Ray does not know this limit.
    """
    cores = {min(os.sched_getaffinity(0))}
    found: dict[str, float] = {"scenes": scenes, "seconds_a_batch": batch_seconds}
    for label, engines in (("waiting", 0), ("shared", 1)):
        batches = Batches(ScriptedEngine.from_file(script), batch_seconds)
        with endpoint(batches) as server:
            words = ["--count", str(scenes), "--workers", "1", "--engine", "openai:unhurried", "--set", f"engines={engines}"]
            words += ["--set", f"engine.http.base_url={server.url}", "--set", "engine.http.concurrency=64"]
            words += ["--set", "weights=none", "--set", "settle=false", "--set", "accept=clean"]
            course = run(place / f"elsewhere_{label}", *words, cores=cores)
        corrector = sum(seconds for step, seconds in course.steps.items() if step != "propose")
        found |= {f"{label}_batches": batches.count, f"{label}_seconds": course.seconds}
        found[f"{label}_reasoner_busy"] = batches.count * batch_seconds / course.seconds
        found[f"{label}_corrector_busy"] = corrector / course.seconds
    return found


def listing(place: Path) -> dict[str, float]:
    """Measures the seconds to list the shards of a million scenes."""
    folder = place / "million" / "scenes"
    folder.mkdir(parents=True)
    for number in range(_SHARDS_OF_A_MILLION):
        (folder / f"part-{number:016x}.parquet").touch()
    began = time.perf_counter()
    found = RunFolder(str(folder.parent)).shard_ids("scenes")
    assert len(found) == _SHARDS_OF_A_MILLION
    return {"shards": len(found), "seconds": time.perf_counter() - began}


def figures(scenes: int, serial: int, counts: Sequence[int], weights: str) -> Iterator[tuple[str, Any]]:
    """Yields all figures with their names, each as soon as it is measured."""
    with tempfile.TemporaryDirectory(prefix="stable-data-") as name:
        place, script = Path(name), scripted(Path(name))
        drawn = (task for task in sample_tasks(scenes).tasks if isinstance(task, SampledTask))
        tasks = [task.sample(lambda _: True) for task in drawn]
        half = -(-scenes // 2)
        size = min(half, GenerateSettings().of_tasks(scenes).scenes_per_shard)

        def words(label: str, some: Sequence[LayoutTask], workers: int, per_shard: int = size) -> list[str]:
            file = tasks_file(place / f"{label}.jsonl", some)
            shards = ["--set", f"scenes_per_shard={per_shard}", "--set", f"weights={weights}"]
            return ["--tasks", str(file), "--workers", str(workers), *shards]

        yield "pipelined", (pipelined := run(place / "pipelined", *words("all", tasks, 2)))
        yield "serial", (wide := run(place / "serial", *words("few", tasks[:serial], 0, 1), threads=True))
        yield "serial, one thread", (narrow := run(place / "narrow", *words("few", tasks[:serial], 0, 1)))
        seconds = min(wide.seconds / wide.scenes, narrow.seconds / narrow.scenes)
        yield "pipelined_to_serial", seconds * pipelined.scenes / pipelined.seconds
        plain = side_by_side(place, [words("first", tasks[:half], 0), words("second", tasks[half:], 0)])
        yield "two_workers_to_two_processes", plain / pipelined.seconds
        yield "in process", (here := run(place / "here", *words("first", tasks[:half], 0)))
        yield "on Ray", (on_ray := run(place / "ray", *words("first", tasks[:half], 1)))
        yield "ray_overhead", on_ray.seconds / here.seconds - 1
        for count in counts:
            yield f"memory, {count} scenes", memory_of(place, script, count)
        for count in counts:
            yield f"driver, {count} scenes", driver_of(place, script, count)
        yield "elsewhere", elsewhere(place, script, 4 * 64, 4.0)
        yield "listing", listing(place)


def shown(name: str, found: Any) -> str:
    """Returns a figure as a line."""
    if isinstance(found, GenerationRun):
        steps = ", ".join(f"{step} {seconds / found.scenes:.2f}" for step, seconds in found.steps.items())
        return f"{name}: {found.accepted} of {found.scenes} accepted, {found.a_minute:.1f} a minute; seconds a scene: {steps}"
    if isinstance(found, dict):
        return f"{name}: " + ", ".join(f"{key} {value:g}" for key, value in found.items())
    return f"{name}: {found:.3f}"


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=128)
    parser.add_argument("--serial-scenes", type=int, default=24)
    parser.add_argument(
        "--scripted", type=int, nargs="+", default=[100, 1000], help="scenes of the runs whose memory is measured"
    )
    parser.add_argument("--weights", default="auto", help="weights of the corrector")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    document: dict[str, Any] = {}
    for name, found in figures(arguments.scenes, arguments.serial_scenes, arguments.scripted, arguments.weights):
        print(shown(name, found), flush=True)
        document[name] = asdict(found) | {"a_minute": found.a_minute} if isinstance(found, GenerationRun) else found
        if arguments.json:
            arguments.json.write_text(json.dumps(document, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
