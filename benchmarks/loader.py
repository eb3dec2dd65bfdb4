"""Loading for training: scenes of the tables, against layout.json with its GLB files.

``python -m benchmarks.loader RUN DATASET [--json FILE]``, where RUN was preprocessed from DATASET. Every way of loading is
measured in the same run on the same scenes, and compared by its ratio to the first: what a job without the tables does for
every scene, parse its layout and load the meshes that it names.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import count, cycle
from pathlib import Path
from typing import Any

from torch.utils.data import DataLoader

from stable_data.errors import MeshError
from stable_data.glb import load_glb
from stable_data.loader import TableDataset, TableStream, collate_scenes
from stable_data.mesatask import MesaTaskDataset

BATCH_SIZE = 64


@dataclass(frozen=True, slots=True)
class Figure:
    """One way of loading.

    Attributes:
        name: What is loaded, into what.
        num_workers: Processes of the DataLoader; 0: this one.
        num_scenes: Scenes that were loaded.
        seconds: For them, the start of workers left out.
        scenes_per_second: Their quotient.
        ratio: Over layout.json and GLB files in one process.
    """

    name: str
    num_workers: int
    num_scenes: int
    seconds: float
    scenes_per_second: float
    ratio: float


def parse_scene(dataset: MesaTaskDataset, scene_id: str) -> int:
    """Reads one scene as a job without tables does: its layout, and every mesh that it names."""
    scene, _ = dataset.read(scene_id)
    paths = {o.asset_id: dataset.asset_path(o.asset_id) for o in scene.objects if o.asset_id is not None}
    for asset_id, path in paths.items():
        if path is not None:
            with suppress(MeshError):  # the job does without it, too
                load_glb(path, asset_id)
    return 1


def timed(items: Iterator[int], seconds: float) -> tuple[int, float]:
    """Takes items, each a number of scenes, for about some seconds; the first is not timed.

    Returns:
        Scenes, and the seconds that they took.
    """
    next(items)
    start, total = time.perf_counter(), 0
    for num_scenes in items:
        total += num_scenes
        if time.perf_counter() - start > seconds:
            break
    return total, time.perf_counter() - start


def epochs(stream: TableStream, num_workers: int, size: Callable[[Any], int]) -> Iterator[int]:
    """Numbers of scenes of the batches of a stream, epoch after epoch."""
    loader = DataLoader(stream, batch_size=None, num_workers=num_workers, persistent_workers=num_workers > 0)
    for epoch in count():
        stream.set_epoch(epoch)
        yield from map(size, loader)


def measure(run: str, dataset: MesaTaskDataset, seconds: float, num_workers: tuple[int, ...]) -> list[Figure]:
    """Every way of loading, the one without tables first."""
    table = TableDataset(run, columns=["scene_id"])
    scene_ids = [table[row]["scene_id"] for row in range(len(table))]
    unknown = sorted(set(scene_ids) - set(dataset.scene_ids))
    assert not unknown, f"{run} was made from another dataset: {unknown[:3]}"
    parsed = (parse_scene(dataset, scene_id) for scene_id in cycle(scene_ids))
    read = (len(dataset.read(scene_id)[:1]) for scene_id in cycle(scene_ids))
    timings = [
        ("layout.json and GLB files to scenes and meshes", 0, *timed(parsed, seconds)),
        ("layout.json alone to scenes", 0, *timed(read, seconds)),
    ]
    for workers in num_workers:
        scenes = TableStream(run, batch_size=BATCH_SIZE, shuffle_seed=0)
        timings.append(("tables to scenes", workers, *timed(epochs(scenes, workers, len), seconds)))
        tensors = TableStream(run, batch_size=BATCH_SIZE, shuffle_seed=0, collate=collate_scenes)
        batches = epochs(tensors, workers, lambda batch: len(batch["scene_ids"]))
        timings.append(("tables to padded tensors", workers, *timed(batches, seconds)))
    base = timings[0][2] / timings[0][3]
    return [Figure(name, w, n, round(s, 3), round(n / s, 1), round(n / s / base, 1)) for name, w, n, s in timings]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run folder")
    parser.add_argument("dataset", type=Path, help="the folder that it was preprocessed from")
    parser.add_argument("--json", type=Path, help="where to keep the figures")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each way of loading")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    figures = measure(arguments.run, MesaTaskDataset(arguments.dataset), arguments.seconds, tuple(arguments.workers))
    print(f"{'loading':48} {'workers':>7} {'scenes/s':>10} {'ratio':>8}")
    for figure in figures:
        print(f"{figure.name:48} {figure.num_workers:7} {figure.scenes_per_second:10.1f} {figure.ratio:7.1f}x")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=1) + "\n")


if __name__ == "__main__":
    main()
