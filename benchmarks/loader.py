"""Loading for training: scenes of the tables, against layout.json with its GLB files.

``python -m benchmarks.loader RUN DATASET [--json FILE]``, where RUN was preprocessed from DATASET. Every way of loading is
measured in the same run on the same scenes, and compared by its ratio to the first one: a job without the tables, which parses
the layout of every scene and loads its meshes. A training loop takes padded tensors and makes a step of a small network with
every batch.

Warm: the files were read before, and the start of workers is not timed. Cold: the system was asked to drop the files from its
cache (``posix_fadvise``), and the time is from opening the folder to the end of the first epoch, workers included.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch.utils.data import DataLoader, Dataset

from stable_data.errors import MeshError
from stable_data.geometry.gltf_reader import load_glb
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import Scene
from stable_data.storage.torch_dataset import SceneBatch, TableDataset, TableStream, collate_scenes

BATCH_SIZE = 64
_PARSED_AT_ONCE = 8  # parsing is slow, and a few seconds must contain several batches

Epoch: TypeAlias = Callable[[int], Iterator[int]]
"""Number of an epoch -> the sizes of its batches."""

Way: TypeAlias = Callable[[int], Epoch]
"""Number of workers -> the epochs; the call opens the folder."""


@dataclass(frozen=True, slots=True)
class LoaderFigure:
    """The figures of one way of loading.

    Attributes:
        name: The source and the target.
        num_workers: Processes of the DataLoader; 0: this process.
        is_cold: Whether the files were dropped from the cache, and opening and starting are timed.
        num_scenes: Number of loaded scenes.
        seconds: Their time.
        scenes_per_second: Scenes divided by seconds.
        ratio: Speed relative to layout.json and GLB files in one process, warm.
    """

    name: str
    num_workers: int
    is_cold: bool
    num_scenes: int
    seconds: float
    scenes_per_second: float
    ratio: float


class LayoutFiles(Dataset[Scene]):
    """Scenes as a job without tables reads them: the layout and, by default, every mesh that it names."""

    def __init__(self, root: Path, scene_ids: list[str], *, meshes: bool = True) -> None:
        self._dataset, self._scene_ids, self._meshes = MesaTaskDataset(root), scene_ids, meshes

    def __len__(self) -> int:
        return len(self._scene_ids)

    def __getitem__(self, index: int) -> Scene:
        scene, _ = self._dataset.read(self._scene_ids[index])
        if self._meshes:
            paths = {o.asset_id: self._dataset.asset_path(o.asset_id) for o in scene.objects if o.asset_id is not None}
            for asset_id, path in paths.items():
                if path is not None:
                    with suppress(MeshError):  # the job also continues without it
                        load_glb(path, asset_id)
        return scene


class TrainingStep:
    """A step of a small network with every batch."""

    def __init__(self) -> None:
        self._network = torch.nn.Sequential(torch.nn.Linear(4, 64), torch.nn.ReLU(), torch.nn.Linear(64, 4))
        self._optimizer = torch.optim.Adam(self._network.parameters())

    def __call__(self, batch: SceneBatch) -> int:
        """Trains on a batch, and returns its number of scenes."""
        poses = batch["poses"][batch["mask"]]
        self._optimizer.zero_grad()
        (self._network(poses) - poses).square().mean().backward()
        self._optimizer.step()
        return len(batch["scene_ids"])


def of_files(root: Path, scene_ids: list[str], *, meshes: bool, train: bool) -> Way:
    """Returns a way to load layouts, with or without meshes, as scenes or into a training loop."""

    def open_with(workers: int) -> Epoch:
        files = LayoutFiles(root, scene_ids, meshes=meshes)
        collate: Any = collate_scenes if train else list
        loader = DataLoader(
            files, batch_size=_PARSED_AT_ONCE, num_workers=workers, collate_fn=collate, persistent_workers=workers > 0
        )
        size: Callable[[Any], int] = TrainingStep() if train else len
        return lambda epoch: map(size, loader)

    return open_with


def of_tables(run: str, *, tensors: bool, train: bool = False) -> Way:
    """Returns a way to load tables, as scenes, as padded tensors or into a training loop."""

    def open_with(workers: int) -> Epoch:
        stream = TableStream(run, batch_size=BATCH_SIZE, shuffle_seed=0, collate=collate_scenes if tensors else None)
        loader = DataLoader(stream, batch_size=None, num_workers=workers, persistent_workers=workers > 0)
        size: Callable[[Any], int] = TrainingStep() if train else (lambda b: len(b["scene_ids"])) if tensors else len

        def batches(epoch: int) -> Iterator[int]:
            stream.set_epoch(epoch)
            return map(size, loader)

        return batches

    return open_with


def warm(way: Way, workers: int, seconds: float) -> tuple[int, float]:
    """Loads epoch after epoch for about ``seconds``; the first batch is not timed.

    Returns:
        Number of scenes, and their seconds.
    """
    batches = (size for epochs in [way(workers)] for epoch in count() for size in epochs(epoch))
    next(batches)
    start, total = time.perf_counter(), 0
    for num_scenes in batches:
        total += num_scenes
        if time.perf_counter() - start > seconds:
            break
    return total, time.perf_counter() - start


def cold(way: Way, workers: int, seconds: float, folders: list[Path]) -> tuple[int, float]:
    """Loads the first epoch, or about ``seconds`` of it; the time starts before the folder is opened.

    Returns:
        Number of scenes, and their seconds.
    """
    for folder in folders:
        forget(folder)
    start, total = time.perf_counter(), 0
    for num_scenes in way(workers)(0):
        total += num_scenes
        if time.perf_counter() - start > seconds:
            break
    return total, time.perf_counter() - start


def forget(folder: Path) -> None:
    """Asks the system to drop all files of a folder from its cache."""
    for path in folder.rglob("*"):
        if path.is_file():
            handle = os.open(path, os.O_RDONLY)
            try:
                os.fsync(handle)
                os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(handle)


def measure(run: str, root: Path, seconds: float, num_workers: tuple[int, ...], rounds: int) -> list[LoaderFigure]:
    """Measures every way of loading, the one without tables first; the best of all rounds, because the machine may be busy."""
    table = TableDataset(run, columns=["scene_id"])
    scene_ids = [table[row]["scene_id"] for row in range(len(table))]
    unknown = sorted(set(scene_ids) - set(MesaTaskDataset(root).scene_ids))
    assert not unknown, f"{run} was made from another dataset: {unknown[:3]} are not in {root}"
    files = "layout.json and GLB files"
    ways: list[tuple[str, Way, tuple[int, ...], bool]] = [
        (f"{files} to scenes and meshes", of_files(root, scene_ids, meshes=True, train=False), (0,), False),
        ("layout.json alone to scenes", of_files(root, scene_ids, meshes=False, train=False), (0,), False),
        ("tables to scenes", of_tables(run, tensors=False), num_workers, False),
        ("tables to padded tensors", of_tables(run, tensors=True), num_workers, False),
    ]
    for is_cold in (False, True):
        ways += [
            (f"{files} into a training loop", of_files(root, scene_ids, meshes=True, train=True), num_workers, is_cold),
            ("tables into a training loop", of_tables(run, tensors=True, train=True), num_workers, is_cold),
        ]
    best: dict[tuple[str, int, bool], tuple[int, float]] = {}
    for _ in range(rounds):
        for name, way, workers, is_cold in ways:
            for w in workers:
                found = cold(way, w, seconds, [Path(run), root]) if is_cold else warm(way, w, seconds)
                best[name, w, is_cold] = max(best.get((name, w, is_cold), (0, 1.0)), found, key=lambda f: f[0] / f[1])
    num_base, seconds_base = next(iter(best.values()))
    base = num_base / seconds_base
    return [LoaderFigure(*key, n, round(s, 3), round(n / s, 1), round(n / s / base, 1)) for key, (n, s) in best.items()]


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="a run folder")
    parser.add_argument("dataset", type=Path, help="the folder from which it was preprocessed")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--seconds", type=float, default=5.0, help="time for each way of loading")
    parser.add_argument("--rounds", type=int, default=2, help="rounds, of which the best counts for each way")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2])
    arguments = parser.parse_args()
    figures = measure(arguments.run, arguments.dataset, arguments.seconds, tuple(arguments.workers), arguments.rounds)
    print(f"{'loading':48} {'workers':>7} {'':5} {'scenes/s':>10} {'ratio':>8}")
    for f in figures:
        kind = "cold" if f.is_cold else "warm"
        print(f"{f.name:48} {f.num_workers:7} {kind:5} {f.scenes_per_second:10.1f} {f.ratio:7.1f}x")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=1) + "\n")


if __name__ == "__main__":
    main()
