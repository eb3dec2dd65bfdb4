"""The efficiency of the preprocess job's workers, and the growth of their memory.

``python -m benchmarks.preprocess DATASET [--scenes 1000] [--json FILE]``: the dataset's scenes are repeated under new names
until there are enough. Compared are two plain processes that share the scene shards, and a local Ray with two workers.
"""

import argparse
import json
import multiprocessing
import os
import resource
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_step import Shard, ShardTask, ShardWriter
from pipelines.preprocess.plan import plan_run
from pipelines.preprocess.settings import PreprocessSettings
from pipelines.preprocess.shard import SceneStep
from stable_data.mesatask import MesaTaskDataset

SETTINGS = PreprocessSettings(num_pictures=0, all_assets=False, position_convention="box_centre")


def repeated(dataset: Path, root: Path, count: int) -> Path:
    """Makes a dataset of ``count`` scenes that repeats those of another one; meshes are shared."""
    root.mkdir(parents=True)
    for name in ("Assets_library", "Asset_annotation.json"):
        (root / name).symlink_to((dataset / name).resolve())
    layouts = sorted(dataset.glob("Layout_info/*/*/layout.json"))
    for number in range(count):
        layout = layouts[number % len(layouts)]
        folder = root / "Layout_info" / layout.parts[-3] / f"{layout.parts[-3]}_{number:05d}"
        folder.mkdir(parents=True)
        shutil.copy(layout, folder / "layout.json")
    return root


class TimedWork:
    """The work of a shard, with its seconds and the memory of its process."""

    def __init__(self, work: ShardWriter) -> None:
        self.work = work

    def __call__(self, shard: Shard[str], *, isolated: bool = False) -> dict[str, float]:
        """Processes the shard."""
        began = time.perf_counter()
        self.work(ShardTask(0, shard), isolated=isolated)
        busy = time.perf_counter() - began
        return {
            "seconds": busy,
            "process": os.getpid(),
            "memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }


def _plain(work: TimedWork, shards: Sequence[Shard[str]], barrier: Any) -> None:
    work(shards[0])  # imports and fills caches, so that the process is as warm as a worker
    barrier.wait()
    for shard in shards[1:]:
        work(shard)


def two_plain_processes(work: TimedWork, shards: Sequence[Shard[str]]) -> float:
    """Measures the seconds of two processes that share the shards evenly, without Ray and without the first shard of each."""
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(3)
    processes = [context.Process(target=_plain, args=(work, shards[k::2], barrier)) for k in range(2)]
    for process in processes:
        process.start()
    barrier.wait()
    began = time.perf_counter()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    return time.perf_counter() - began


def two_workers(work: TimedWork, shards: Sequence[Shard[str]]) -> dict[str, float]:
    """Measures a local Ray with two workers on the same shards; the time starts when two shards are done."""
    results, stamps = [], []
    for result in WorkerPool(2).run(work, shards):
        results.append(result)
        stamps.append(time.perf_counter())
    wall = stamps[-1] - stamps[1]
    busy = sum(r["seconds"] for r in results[2:])
    memory = [max(r["memory_mib"] for r in part) for part in (results[: len(results) // 10 or 1], results)]
    return {
        "seconds": wall,
        "ray_share": 1 - busy / (2 * wall),
        "worker_memory_first_tenth_mib": memory[0],
        "worker_memory_mib": memory[1],
        "driver_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def measure(dataset: Path, num_scenes: int) -> dict[str, Any]:
    """Measures all figures."""
    with tempfile.TemporaryDirectory() as folder:
        root = repeated(dataset, Path(folder) / "data", num_scenes)
        shards = plan_run(MesaTaskDataset(root), SETTINGS).scenes
        plain = two_plain_processes(TimedWork(ShardWriter(f"{folder}/plain", (SceneStep(str(root), SETTINGS),))), shards)
        ray = two_workers(TimedWork(ShardWriter(f"{folder}/ray", (SceneStep(str(root), SETTINGS),))), shards)
    timed = num_scenes - len(shards[0]) - len(shards[1])  # the first shard of each worker warms it up
    rate = {"plain": timed / plain, "ray": timed / ray["seconds"]}
    return {
        "num_scenes": num_scenes,
        "plain_seconds": plain,
        **ray,
        "scenes_per_second": rate,
        "of_plain": rate["ray"] / rate["plain"],
    }


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    figures = measure(arguments.dataset, arguments.scenes)
    print(json.dumps(figures, indent=2))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
