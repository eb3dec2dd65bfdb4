"""The time and memory of a round of the batched refinement, by the size of the batch.

``OMP_NUM_THREADS=1 python -m benchmarks.refinement PLACE [--layouts N] [--device cpu] [--json FILE]``. PLACE is a generate run, whose
layouts of each stage before the correction are taken, or a folder in the MesaTask-10K format. Layouts that are clean already are left
out. Audits are not counted; meshes and grids are made before. What the refinement reaches is measured by ``benchmarks.correction``.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Annotated

import torch
import typer

from benchmarks.layouts import proposed_layouts
from models.physics_corrector.refinement.contact_shapes import ContactShapeCache
from models.physics_corrector.refinement.problem import RefinementProblem
from models.physics_corrector.refinement.refiner import refine_poses
from pipelines.sources.scenes import contact_grid_cache, scene_source
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder

_BATCHES = (1, 16, 64, 256)


@dataclass(frozen=True, slots=True, eq=False)
class StartLayout:
    """A layout before its correction.

    Attributes:
        scene: The layout, resolved.
        shapes: The geometry of its objects.
        audit: Its exact audit.
    """

    scene: Scene
    shapes: Sequence[Shape]
    audit: Audit


def folder_scenes(dataset: MesaTaskDataset) -> list[Scene]:
    """Returns the readable scenes of a folder."""
    found = []
    for scene_id in dataset.scene_ids:
        try:
            found.append(dataset.read(scene_id)[0])
        except SceneError:
            continue
    return found


def start_layouts(scenes: Sequence[Scene], store: AssetStore, most: int) -> list[StartLayout]:
    """Returns the first layouts that are known not to be clean."""
    found: list[StartLayout] = []
    for scene in scenes:
        resolved, shapes, _ = store.resolved(scene)
        audit = audit_scene(resolved, shapes)
        if audit.card().clean is False:
            found.append(StartLayout(resolved, shapes, audit))
        if len(found) == most:
            break
    return found


def seconds_by_batch(
    layouts: Sequence[StartLayout], store: AssetStore, grids: ContactGrids, device: str
) -> list[dict[str, float]]:
    """Returns the seconds a layout of one round of refinement for each size of a batch, and the megabytes of its tensors a layout."""
    cache, found = ContactShapeCache(store, grids), []
    for size in _BATCHES:
        some = [layouts[k % len(layouts)] for k in range(max(size, min(64, len(layouts))))]
        parts = [some[start : start + size] for start in range(0, len(some), size)]
        seconds, megabytes = 0.0, 0.0
        for part in parts:
            scenes, shapes = [one.scene for one in part], [one.shapes for one in part]
            cache.shapes_of(scenes, shapes)
            began = time.perf_counter()
            with torch.no_grad():
                problem = RefinementProblem.of(scenes, shapes, [frozenset()] * len(part), scenes, cache).to(device)
                refine_poses(problem, 4e-4, 60)
            if device != "cpu":
                torch.cuda.synchronize()
            seconds += time.perf_counter() - began
            tensors = problem.shapes.tensors
            sizes = (tensors.atlas.values, problem.shapes.samples, problem.shapes.outline)
            megabytes += sum(t.numel() * t.element_size() for t in sizes) / 2**20
        found.append({"batch": size, "seconds": seconds / len(some), "megabytes": megabytes / len(some)})
    return found


def main(
    place: Annotated[str, typer.Argument(help="A generate run, or a folder in the MesaTask-10K format.")],
    layouts: Annotated[int, typer.Option(help="Largest number of layouts.")] = 128,
    device: Annotated[str, typer.Option(help="Device of the refinement.")] = "cpu",
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints the seconds of the refinement by the size of the batch."""
    torch.set_num_threads(1)
    run = RunFolder(place)
    is_run = bool(run.files("turns"))
    store = scene_source(place).store
    scenes = [layout.start for layout in proposed_layouts(run)] if is_run else folder_scenes(MesaTaskDataset(Path(place)))
    starts = start_layouts(scenes, store, layouts)
    if not starts:
        print(f"{place}: no layout is known not to be clean, so nothing is to be refined")
        return
    grids = ContactGrids(contact_grid_cache())
    ContactShapeCache(store, grids).shapes_of([one.scene for one in starts], [one.shapes for one in starts])
    print(f"{len(starts)} layouts, {mean(len(one.scene.objects) for one in starts):.1f} objects each")
    batches = seconds_by_batch(starts, store, grids, device)
    for batch in batches:
        print(f"batch {batch['batch']:>3}: {1e3 * batch['seconds']:6.1f} ms and {batch['megabytes']:.2f} MB a layout")
    if json_file is not None:
        document = {"layouts": len(starts), "device": device, "batches": batches}
        json_file.write_text(json.dumps(document, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
