"""The speed of the audit against the usual collision check, and whether both find the same crossing pairs.

``python -m benchmarks.audit DATASET [--scenes N] [--json FILE]``. The scenes have 14 to 16 objects. Each is measured as written
and with its objects shifted by 2 cm and turned by 0.1 rad (standard deviations):

- trimesh: ``CollisionManager`` filled with the posed meshes, then ``in_collision_internal(return_names=True)``: the crossing
  pairs;
- ours: ``audit_scene`` on loaded meshes with empty caches: the crossing pairs and their depths, floating objects, objects out of
  bounds.

Run with ``OMP_NUM_THREADS=1 IGL_NUM_THREADS=1``.
"""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Annotated

import numpy as np
import trimesh
import typer

from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.lint import lint_folder
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Scene

_NUM_OBJECTS = range(14, 17)
_SHIFT, _TURN = 0.02, 0.1  # standard deviations of the noise, metres and radians


@dataclass(frozen=True, slots=True)
class AuditTiming:
    """One scene, audited both ways.

    Attributes:
        scene_id: The scene.
        is_shifted: Whether noise was added to its poses.
        num_objects: Number of objects.
        num_faces: Triangles of all objects.
        num_crossing: Pairs whose meshes cross.
        trimesh_seconds: Time of trimesh for the crossing pairs.
        ours_seconds: Time of the whole audit.
        is_same: Whether both found the same crossing pairs.
    """

    scene_id: str
    is_shifted: bool
    num_objects: int
    num_faces: int
    num_crossing: int
    trimesh_seconds: float
    ours_seconds: float
    is_same: bool


@dataclass(frozen=True, slots=True)
class AuditBenchmark:
    """The measurements of :func:`run`.

    Attributes:
        timings: Scene by scene.
        lint_scenes_per_second: Speed of the lint of the whole folder, with the reading and repair of its meshes.
    """

    timings: tuple[AuditTiming, ...]
    lint_scenes_per_second: float

    def ratio(self, is_shifted: bool | None = None) -> float:
        """Returns the median time of trimesh divided by the median time of the audit."""
        chosen = [t for t in self.timings if is_shifted in (None, t.is_shifted)]
        return median(t.trimesh_seconds for t in chosen) / median(t.ours_seconds for t in chosen)

    def __str__(self) -> str:
        """Returns a table of the figures."""
        lines = [f"{'poses':<12}{'scenes':>8}{'faces':>10}{'trimesh ms':>12}{'audit ms':>10}{'ratio':>8}{'same verdicts':>15}"]
        for name, is_shifted in (("as written", False), ("shifted", True), ("all", None)):
            chosen = [t for t in self.timings if is_shifted in (None, t.is_shifted)]
            theirs, ours = (1e3 * median(getattr(t, key) for t in chosen) for key in ("trimesh_seconds", "ours_seconds"))
            same = f"{sum(t.is_same for t in chosen)}/{len(chosen)}"
            faces = median(t.num_faces for t in chosen)
            lines.append(f"{name:<12}{len(chosen):>8}{faces:>10.0f}{theirs:>12.1f}{ours:>10.1f}{theirs / ours:>8.1f}{same:>15}")
        return "\n".join([*lines, f"lint of the folder: {self.lint_scenes_per_second:.1f} scenes/s"])


def run(root: Path, num_scenes: int | None = None, repeats: int = 3) -> AuditBenchmark:
    """Measures a dataset.

    Args:
        root: A folder in the MesaTask-10K format.
        num_scenes: Largest number of scenes; None: all with 14 to 16 objects, or, without such scenes, the 12 fullest ones.
        repeats: Each time is the best of this number.
    """
    dataset = MesaTaskDataset(root)
    store = AssetStore(dataset, max_bytes=2**31)
    read = list(readable_scenes(dataset))
    scenes = [scene for scene in read if len(scene.objects) in _NUM_OBJECTS]
    if not scenes:  # a dataset of smaller or larger scenes
        scenes = sorted(read, key=lambda scene: -len(scene.objects))[:12]
    timings = []
    for scene in scenes[:num_scenes]:
        shapes = store.shapes(scene)[0]
        timings += [_time(posed, shapes, posed is not scene, repeats) for posed in (scene, _shifted(scene))]
    start = time.process_time()
    lint_folder(root)
    return AuditBenchmark(tuple(timings), len(dataset) / (time.process_time() - start))


def readable_scenes(dataset: MesaTaskDataset) -> Iterator[Scene]:
    """Yields the scenes that can be used."""
    for scene_id in dataset.scene_ids:
        with suppress(SceneError):
            yield dataset.read(scene_id)[0]


def _shifted(scene: Scene) -> Scene:
    rng = np.random.default_rng(len(scene.objects))
    noise = rng.normal(0.0, (_SHIFT, _SHIFT, _SHIFT, _TURN), (len(scene.objects), 4))
    return scene.with_poses(scene.poses() + noise)


def _time(scene: Scene, shapes: Sequence[Shape], is_shifted: bool, repeats: int) -> AuditTiming:
    num_faces = sum(len(s.faces) for s in shapes)
    trimesh_seconds, ours_seconds = [], []
    for theirs, ours in _alternately(scene, shapes, repeats):
        trimesh_seconds.append(theirs[0])
        ours_seconds.append(ours[0])
        pairs, audited = theirs[1], ours[1]
    best, best_ours = min(trimesh_seconds), min(ours_seconds)
    return AuditTiming(scene.scene_id, is_shifted, len(shapes), num_faces, len(pairs), best, best_ours, pairs == audited)


Timed = tuple[float, frozenset[tuple[str, str]]]


def _alternately(scene: Scene, shapes: Sequence[Shape], repeats: int) -> Iterator[tuple[Timed, Timed]]:
    """Yields seconds and crossing pairs by trimesh, and by the audit."""
    meshes = [trimesh.Trimesh(s.vertices, s.faces, process=False) for s in shapes]
    for _ in range(repeats):
        fresh = [Shape(s.vertices, s.faces, s.is_exact) for s in shapes]  # with empty caches
        start = time.process_time()
        manager = trimesh.collision.CollisionManager()
        for o, mesh, pose in zip(scene.objects, meshes, scene.poses(), strict=True):
            manager.add_object(
                o.instance,
                mesh,
                trimesh.transformations.translation_matrix(pose[:3])
                @ trimesh.transformations.rotation_matrix(pose[3], (0, 0, 1)),
            )
        crossing = manager.in_collision_internal(return_names=True)[1]
        middle = time.process_time()
        audit = audit_scene(scene, fresh)
        end = time.process_time()
        audited = frozenset((min(p.first, p.second), max(p.first, p.second)) for p in audit.pairs)
        yield (middle - start, frozenset(crossing)), (end - middle, audited)


def main(
    dataset: Annotated[Path, typer.Argument(help="Folder in the MesaTask-10K format.")],
    scenes: Annotated[int | None, typer.Option(help="Largest number of scenes.")] = None,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Compares the speed of the audit with trimesh."""
    result = run(dataset, scenes)
    print(result)
    if file is not None:
        file.write_text(json.dumps(asdict(result), indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
