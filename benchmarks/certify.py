"""How clean, how near and how fast `certify` makes crowded and shifted layouts.

``python -m benchmarks.certify DATASET [--layouts FILE] [--scenes N] [--json FILE]``. Layouts are start poses by number of
collisions, one JSON object a line (``collision_buckets.jsonl``), over the meshes of the dataset; besides, the dataset's own scenes
with their objects shifted by 2 cm and turned by 0.1 rad (standard deviations). Seconds are processor time of one core, reading
left out. Run with ``OMP_NUM_THREADS=1 IGL_NUM_THREADS=1``.
"""

import itertools
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean, median
from typing import Annotated

import numpy as np
import typer
from tqdm import tqdm

from benchmarks.audit import readable_scenes
from benchmarks.layouts import read_layouts
from models.physics_corrector.certify import Status, certify
from stable_data.assets import AssetStore
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.kept import RelationsKept, relations_kept
from stable_data.scene import Scene

_SHIFT, _TURN = 0.02, 0.1  # standard deviations of the noise, metres and radians


@dataclass(frozen=True, slots=True)
class Correction:
    """One layout.

    Attributes:
        scene_id: The layout.
        bucket: Its group.
        num_objects: Objects.
        status: How it came out.
        num_dropped: Objects that were dropped.
        kept: Relations before and after; None where there is no scene after.
        moves: How far each object was moved, metres.
        seconds: Processor time.
    """

    scene_id: str
    bucket: str
    num_objects: int
    status: Status
    num_dropped: int
    kept: RelationsKept | None
    moves: tuple[float, ...]
    seconds: float


@dataclass(frozen=True, slots=True)
class CertifyBenchmark:
    """What :func:`run` measured."""

    corrections: tuple[Correction, ...]

    def __str__(self) -> str:
        """The figures by group as a table."""
        names = (
            "bucket",
            "scenes",
            "objects",
            "certified",
            "dropped",
            "infeasible",
            "on/in kept",
            "directional kept",
            "move mm",
        )
        lines = [" ".join(f"{name:>16}" for name in (*names, "seconds", "slowest"))]
        for bucket in sorted({c.bucket for c in self.corrections}):
            row = _row([c for c in self.corrections if c.bucket == bucket])
            lines += [" ".join(f"{cell:>16}" for cell in row)]
        return "\n".join(lines)


def _row(corrections: list[Correction]) -> Iterator[str]:
    counts = [c.kept for c in corrections if c.kept is not None]
    yield corrections[0].bucket
    yield str(len(corrections))
    yield f"{median(c.num_objects for c in corrections):.0f}"
    yield str(sum(c.status is Status.CERTIFIED for c in corrections))
    yield f"{sum(c.num_dropped for c in corrections)} in {sum(c.num_dropped > 0 for c in corrections)}"
    yield str(sum(c.status is Status.INFEASIBLE for c in corrections))
    yield f"{sum(k.on_in_kept for k in counts)}/{sum(k.on_in_held for k in counts)}"
    yield f"{sum(k.directional_kept for k in counts)}/{sum(k.directional_held for k in counts)}"
    moves = [move for c in corrections for move in c.moves]
    yield f"{1e3 * mean(moves):.1f}" if moves else "-"
    yield f"{median(c.seconds for c in corrections):.2f}"
    yield f"{max(c.seconds for c in corrections):.2f}"


def run(root: Path, layouts: Path | None = None, num_scenes: int | None = None) -> CertifyBenchmark:
    """Corrects the layouts.

    Args:
        root: A folder in the MesaTask-10K format, whose meshes the layouts name.
        layouts: Start poses, one JSON object a line.
        num_scenes: At most so many of each kind.
    """
    dataset = MesaTaskDataset(root)
    store = AssetStore(dataset, max_bytes=2**31)
    scenes = [(_shifted(scene), "shifted") for scene in itertools.islice(readable_scenes(dataset), num_scenes)]
    if layouts is not None:
        every = list(read_layouts(layouts, store))
        step = max(1, len(every) // num_scenes) if num_scenes else 1
        scenes += [(_bare(layout.start), layout.bucket) for layout in every[::step]]
    return CertifyBenchmark(tuple(_correct(store, scene, bucket) for scene, bucket in tqdm(scenes)))


def _bare(scene: Scene) -> Scene:
    """A layout without what it means: its relations and what carries what are for `certify` to see."""
    return replace(scene, relations=(), objects=tuple(replace(o, support=None) for o in scene.objects))


def _shifted(scene: Scene) -> Scene:
    rng = np.random.default_rng(len(scene.objects))
    noise = rng.normal(0.0, (_SHIFT, _SHIFT, 0.0, _TURN), (len(scene.objects), 4))
    return scene.with_poses(scene.poses() + noise)


def _correct(store: AssetStore, scene: Scene, bucket: str) -> Correction:
    scene, shapes, _ = store.resolved(scene)
    start = time.process_time()
    result = certify(scene, shapes)
    seconds = time.process_time() - start
    objects = () if result.scene is None else result.scene.objects
    kept = None if result.scene is None else relations_kept(scene, result.scene, shapes)
    moves = tuple(float(np.linalg.norm(np.subtract(o.position, scene[o.instance].position))) for o in objects)
    return Correction(scene.scene_id, bucket, len(shapes), result.status, len(result.dropped), kept, moves, seconds)


def main(
    dataset: Annotated[Path, typer.Argument(help="Folder in the MesaTask-10K format.")],
    layouts: Annotated[Path | None, typer.Option(help="Start poses over its meshes, one JSON object a line.")] = None,
    scenes: Annotated[int | None, typer.Option(help="At most so many of each kind.")] = None,
    file: Annotated[Path | None, typer.Option("--json", help="Where the figures are written.")] = None,
) -> None:
    """Corrects crowded and shifted layouts."""
    result = run(dataset, layouts, scenes)
    print(result)
    if file is not None:
        file.write_text(json.dumps(asdict(result), indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
