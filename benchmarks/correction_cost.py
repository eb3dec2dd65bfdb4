"""The cost of a correction: scenes a second on all cores, and seconds against the number of objects.

``python -m benchmarks.correction_cost DATASET [--scenes N] [--rounds N] [--workers N] [--json FILE]``:

- throughput: the scenes of the dataset that are nearest to 15 objects, made coarse several times by the kind ``jitter`` of the
  corrector's training; one process a core, which corrects its share scene after scene. Counted are clean scenes, by the wall
  time of all processes together, and by processor time as if the cores had no other work;
- growth: layouts of 5 to 60 objects, three of each number: objects of those scenes with all that they carry, on a square table
  of which their footprints cover 30 %, perturbed by 4 cm and 0.2 rad (standard deviations). Measured are processor seconds of
  one core, and the exponent of seconds against objects, by least squares of the logarithms over all layouts;
- full tables: layouts of 60 and 200 objects whose footprints cover 60 % to 200 % of the table, with certification alone. Objects
  without a place are left out.

``certify`` is certification alone, ``flow + certify`` certification after the learned flow, both with the scene's own audit and
relations. Data that is computed once an asset, such as point features, is computed before. Run with
``OMP_NUM_THREADS=1 IGL_NUM_THREADS=1``.
"""

import json
import math
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from statistics import mean, median
from typing import Annotated

import numpy as np
import torch
import typer
from tqdm import tqdm

from benchmarks.audit import readable_scenes
from benchmarks.corrector_parts import corrector_parts
from benchmarks.layouts import shaken
from models.baselines.outcome import Baseline
from models.physics_corrector.geometry.scene_batch import LayoutBatch, pad_scenes
from models.physics_corrector.training.perturbation import PerturbationSettings, perturb
from pipelines.reports.text_table import align_columns
from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError, StableDataError
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.related_scene import relate_scene
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.scene_graph.support_tree import SupportTree

SIZES = (5, 8, 12, 18, 27, 40, 60)
"""Numbers of objects."""

_METHODS = ("certify", "flow + certify")
_TYPICAL = 15  # number of objects
_OCCUPANCY = 0.3  # total footprint of the objects on the table over its area
_FULL = {60: (0.6, 0.8, 1.0, 1.5), 200: (1.0, 2.0)}  # occupancies of full tables by number of objects
_SHAKE = 0.04  # standard deviation of x and y, metres
_LAYOUTS = 3  # layouts of each number of objects


@dataclass(frozen=True, slots=True)
class Cost:
    """The correction of one layout.

    Attributes:
        method: Name of the method.
        layout: Name of the layout.
        num_objects: Number of objects.
        is_clean: Whether the result is clean, possibly with dropped objects.
        seconds: Processor time.
        num_dropped: Number of objects that were left out.
        occupancy: Footprints of the objects on the table over its area; None if it was not set.
    """

    method: str
    layout: str
    num_objects: int
    is_clean: bool
    seconds: float
    num_dropped: int = 0
    occupancy: float | None = None


@dataclass(frozen=True, slots=True)
class Throughput:
    """Scenes a second of one method.

    Attributes:
        workers: Processes.
        wall_seconds: Wall time from the first scene's start to the last one's end.
        costs: The scenes.
    """

    workers: int
    wall_seconds: float
    costs: tuple[Cost, ...]

    def __str__(self) -> str:
        """Returns the rates of clean scenes."""
        clean, sizes = sum(c.is_clean for c in self.costs), [c.num_objects for c in self.costs]
        rates = clean / self.wall_seconds, self.workers * clean / sum(c.seconds for c in self.costs)
        return (
            f"{self.costs[0].method}: {clean} of {len(sizes)} scenes of {min(sizes)} to {max(sizes)} objects ({mean(sizes):.1f}) clean, "
            f"{rates[0]:.2f} scenes/s with {self.workers} processes ({rates[1]:.2f} by processor time)"
        )


class Bench:
    """Scenes of a dataset, with the data that is computed once an asset.

    Args:
        root: A folder in the MesaTask-10K format.
        count: Number of scenes: those nearest to 15 objects.
    """

    def __init__(self, root: Path, count: int) -> None:
        torch.set_num_threads(1)
        dataset = MesaTaskDataset(root)
        self._store = AssetStore(dataset, max_bytes=2**30)
        every = sorted(readable_scenes(dataset), key=lambda s: (abs(len(s.objects) - _TYPICAL), s.scene_id))
        self.scenes = [self._related(scene) for scene in every[:count]]
        self._methods: dict[str, Baseline] = {name: method for name, method in corrector_parts().items() if name in _METHODS}
        for name in self.methods:
            self.costs(name, self.jittered(0))

    @property
    def methods(self) -> tuple[str, ...]:
        """``certify``, and ``flow + certify``."""
        return tuple(self._methods)

    def costs(self, name: str, scenes: Iterable[Scene]) -> list[Cost]:
        """Measures a method on scenes."""
        return [self.cost(name, scene) for scene in scenes]

    def jittered(self, seed: int) -> list[Scene]:
        """Returns the scenes, made coarse by the kind ``jitter``."""
        shapes = [self._store.resolved(scene)[1] for scene in self.scenes]
        arrays = {k: torch.from_numpy(v) for k, v in pad_scenes(self.scenes, shapes, [frozenset()] * len(shapes)).items()}
        batch = LayoutBatch(shape_index=torch.zeros_like(arrays["parent"]), **arrays)
        coarse = perturb(batch, PerturbationSettings(), torch.Generator().manual_seed(seed), "jitter").poses
        poses = coarse.double().numpy()
        return [scene.with_poses(own[: len(scene.objects)]) for scene, own in zip(self.scenes, poses, strict=True)]

    def crowds(self) -> list[Scene]:
        """Returns layouts of every number of objects."""
        rng = np.random.default_rng(0)
        return [shaken(crowd(self.scenes, n, rng), _SHAKE, rng) for n in SIZES for _ in range(_LAYOUTS)]

    def full_tables(self) -> list[tuple[float, Scene]]:
        """Returns layouts on tables that are almost or too full, with their occupancies."""
        rng = np.random.default_rng(1)
        return [(s, shaken(crowd(self.scenes, n, rng, s), _SHAKE, rng)) for n, shares in _FULL.items() for s in shares]

    def cost(self, name: str, scene: Scene, occupancy: float | None = None) -> Cost:
        """Measures a method on a scene of an occupancy."""
        scene, shapes, _ = self._store.resolved(scene)
        done = self._methods[name].correct(scene, shapes, self._store)
        num_dropped = len(shapes) - len(done.scene.objects)
        return Cost(name, scene.scene_id, len(shapes), done.converged, done.seconds, num_dropped, occupancy)

    def _related(self, scene: Scene) -> Scene:
        scene, shapes, _ = self._store.resolved(scene)
        posed = PosedScene(scene, shapes)
        return relate_scene(posed, audit_posed_scene(posed), {}).scene


def crowd(scenes: Sequence[Scene], count: int, rng: np.random.Generator, occupancy: float = _OCCUPANCY) -> Scene:
    """Builds a layout of ``count`` objects at a fixed occupancy: objects of scenes, with all that they carry, in a grid.

    Args:
        scenes: The scenes, with supports.
        count: Number of objects.
        rng: Source of randomness.
        occupancy: Total footprint of the objects on the table over its area.

    Raises:
        SceneError: Every object on a table carries too many others to reach the number (``scenes_unsuited``).
    """
    groups = [group for scene in scenes for group in _groups(scene)]
    chosen = list[list[SceneObject]]()
    while (rest := count - sum(map(len, chosen))) > 0:
        fitting = [group for group in groups if len(group) <= rest]
        if not fitting:
            raise SceneError(
                f"every object on the tables of {len(scenes)} scenes carries at least {rest} others, expected one that carries none",
                "scenes_unsuited",
            )
        chosen.append(fitting[rng.integers(len(fitting))])
    footprint = sum(first.size[0] * first.size[1] for first, *_ in chosen)
    side, across = math.sqrt(footprint / occupancy), math.ceil(math.sqrt(len(chosen)))
    objects = []
    for k, (first, *carried) in enumerate(chosen):
        place = (np.array(divmod(k, across)) + 0.5) * side / across - first.position[:2]
        for o in (first, *carried):
            x, y = (o.position[:2] + place).tolist()
            support = o.support if o is first else f"{k}/{o.support}"
            objects.append(replace(o.moved((x, y, o.position[2]), o.yaw), instance=f"{k}/{o.instance}", support=support))
    return Scene(f"crowd of {count}", Tabletop("", (side, side)), tuple(objects))


def _groups(scene: Scene) -> list[list[SceneObject]]:
    """Returns the objects on the table, each followed by all that it carries."""
    tree = SupportTree.of(scene.objects)
    groups = {name: [scene[name]] for name in tree.children(None)}
    for o in scene.objects:
        if tree.parent(o.instance) is not None:
            groups[tree.root(o.instance)].append(o)
    return list(groups.values())


@lru_cache(maxsize=1)
def _bench(root: Path, count: int) -> Bench:
    return Bench(root, count)


def _share(root: Path, count: int, name: str, seeds: Sequence[int], part: slice) -> list[Cost]:
    """Corrects a process's share of the scenes of all rounds."""
    bench = _bench(root, count)
    return bench.costs(name, [scene for seed in seeds for scene in bench.jittered(seed)][part])


def throughput(root: Path, count: int, rounds: int, workers: int) -> list[Throughput]:
    """Measures how many scenes a second become clean, by method.

    Args:
        root: A folder in the MesaTask-10K format.
        count: Number of its scenes.
        rounds: Number of coarse layouts of each scene.
        workers: Processes, each of one thread.
    """
    pools = [ProcessPoolExecutor(1, mp_context=get_context("spawn")) for _ in range(workers)]
    try:
        for ready in [pool.submit(_share, root, count, "certify", (), slice(None)) for pool in pools]:
            ready.result()
        found = []
        for name in _bench(root, count).methods:
            parts = [slice(n, None, workers) for n in range(workers)]
            seeds = range(1, 1 + rounds)
            begin = time.perf_counter()
            shares = [pool.submit(_share, root, count, name, seeds, part) for pool, part in zip(pools, parts, strict=True)]
            costs = tuple(cost for share in shares for cost in share.result())
            found.append(Throughput(workers, time.perf_counter() - begin, costs))
        return found
    finally:
        for pool in pools:
            pool.shutdown()


def exponent(costs: Sequence[Cost]) -> float:
    """Fits p of seconds ~ objects ** p: the slope by least squares of the logarithms."""
    return float(np.polyfit(np.log([c.num_objects for c in costs]), np.log([c.seconds for c in costs]), 1)[0])


def growth_table(costs: Sequence[Cost]) -> str:
    """Returns a table of median seconds by number of objects and method, and the exponents."""
    names = list(dict.fromkeys(c.method for c in costs))
    lines = ["objects" + "".join(f"{name:>18} s{'clean':>8}" for name in names)]
    for n in sorted({c.num_objects for c in costs}):
        chosen = [[c for c in costs if (c.num_objects, c.method) == (n, name)] for name in names]
        cells = (f"{median(c.seconds for c in own):20.3f}{sum(c.is_clean for c in own):>6}/{len(own)}" for own in chosen)
        lines.append(f"{n:>7}" + "".join(cells))
    return "\n".join([*lines, *(f"{name}: exponent {exponent([c for c in costs if c.method == name]):.2f}" for name in names)])


def main(
    dataset: Annotated[Path, typer.Argument(help="Folder in the MesaTask-10K format.")],
    scenes: Annotated[int, typer.Option(help="Number of its scenes, those nearest to 15 objects.")] = 12,
    rounds: Annotated[int, typer.Option(help="Number of coarse layouts of each scene.")] = 4,
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Measures the cost of corrections."""
    try:
        rates = throughput(dataset, scenes, rounds, workers)
        print(*rates, sep="\n")
        bench = _bench(dataset, scenes)
        crowds = bench.crowds()
    except StableDataError as error:
        raise SystemExit(str(error)) from error
    growth = [cost for name in bench.methods for cost in bench.costs(name, tqdm(crowds, desc=name, unit="scene"))]
    print(growth_table(growth))
    full = [bench.cost("certify", scene, share) for share, scene in tqdm(bench.full_tables(), desc="full tables", unit="scene")]
    rows = [[str(c.num_objects), f"{c.occupancy:.0%}", f"{c.seconds:.1f}", str(c.num_dropped), str(c.is_clean)] for c in full]
    print(align_columns([["objects", "occupancy", "s", "left out", "clean"], *rows], 0))
    if file is not None:
        figures = {"throughput": [asdict(rate) for rate in rates]}
        figures |= {"growth": [asdict(cost) for cost in growth], "full": [asdict(cost) for cost in full]}
        file.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
