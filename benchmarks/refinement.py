"""The batched refinement compared with certification, on the proposals of generated scenes or on the scenes of a folder.

``OMP_NUM_THREADS=1 python -m benchmarks.refinement PLACE [--layouts N] [--device cpu] [--json FILE]``. PLACE is a generate run, whose
table ``turns`` has the poses of each stage before its correction (objects have the tilts of the finished scene); or a folder in the
MesaTask-10K format, whose scenes are taken as they are. Layouts that are clean already are left out. All methods get the same layouts:

- given: the layouts themselves;
- flow: the learned flow alone;
- refine: the refinement alone; flow + refine: after the flow;
- certify: certification alone; refine + certify: certification of what the refinement leaves.

Columns: clean by the exact audit, solved (clean, carried by the carriers of the scene, steady, directional relations kept), OC deeper
than 0.5 mm and floating objects, mean movement, relations kept, layouts at rest in MuJoCo (of the clean ones), and core seconds a
layout with the audits. Then the refinement's seconds a layout without audits, for batches of 1, 16, 64 and 256 layouts, and the
memory of its tensors. Meshes, grids and point features are computed before.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Any, TypeAlias

import torch
import typer

from benchmarks.text_table import align_columns
from models.physics_corrector.corrector import PhysicsCorrector
from models.physics_corrector.learned_flow import LearnedFlow, load_flow
from models.physics_corrector.refinement.contact_shapes import ContactShapeCache
from models.physics_corrector.refinement.problem import RefinementProblem
from models.physics_corrector.refinement.refiner import Refiner, refine_poses
from pipelines.sources.scenes import contact_grid_cache, scene_source
from stable_data.assets.contact_grids import ContactGrids
from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.metrics.movement import movement
from stable_data.metrics.relations_kept import relations_kept
from stable_data.scene import TABLE, RelationKind, Scene
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import settle
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

_BATCHES = (1, 16, 64, 256)
_CARRYING = (RelationKind.ON, RelationKind.IN)


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


Outcome: TypeAlias = tuple[Scene | None, Audit | None, bool | None]
"""A scene with its audit, and whether it is solved; None where that is not defined."""


def proposals(run: RunFolder) -> list[Scene]:
    """Returns the layouts of each stage of a generate run before its correction; without those of which an object is not known."""
    finished = {row["scene_id"]: scene_from_row(row) for row in run.table("scenes").to_pylist()}
    found = []
    for turn in run.table("turns").to_pylist():
        scene = finished.get(turn["scene_id"])
        if scene is None or not turn["coarse"]:
            continue
        objects = {o.instance: o for o in scene.objects}
        if not all(pose["instance"] in objects for pose in turn["coarse"]):
            continue
        moved = tuple(objects[p["instance"]].moved(tuple(p["position"]), p["yaw"]) for p in turn["coarse"])
        there = {o.instance for o in moved}
        carried = tuple(
            r for r in scene.relations if r.kind in _CARRYING and r.target != TABLE and {r.subject, r.target} <= there
        )
        on = {r.subject: r.target for r in carried}
        standing = tuple(replace(o, support=on.get(o.instance, TABLE)) for o in moved)
        found.append(replace(scene, scene_id=f"{scene.scene_id}, {turn['stage']}", objects=standing, relations=carried))
    return found


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


def methods(store: AssetStore, grids: ContactGrids, device: str) -> dict[str, Callable[[Sequence[StartLayout]], list[Outcome]]]:
    """Returns the methods by name."""
    flow, refiner = load_flow(), Refiner(store, grids, device=device)
    assert flow is not None

    def corrected(corrector: PhysicsCorrector) -> Callable[[Sequence[StartLayout]], list[Outcome]]:
        def run(layouts: Sequence[StartLayout]) -> list[Outcome]:
            audits = [one.audit for one in layouts]
            done = corrector.correct([one.scene for one in layouts], store, audits=audits)
            return [(c.certified, c.audit, c.certified is not None and not c.dropped) for c in done]

        return run

    def refined(flow: LearnedFlow | None) -> Callable[[Sequence[StartLayout]], list[Outcome]]:
        def run(layouts: Sequence[StartLayout]) -> list[Outcome]:
            corrector = PhysicsCorrector(flow, refiner=refiner, judges_raw=False)
            requests = corrector.move([one.scene for one in layouts], store)
            prepared = [r.prepared for r in corrector.prepare(requests, store)]
            return [(p.refined, p.audit, p.is_solved) if p is not None else (None, None, False) for p in prepared]

        return run

    def flowed(layouts: Sequence[StartLayout]) -> list[Outcome]:
        scenes = flow([one.scene for one in layouts], [one.shapes for one in layouts], [frozenset()] * len(layouts))
        return [(scene, audit_scene(scene, one.shapes), None) for scene, one in zip(scenes, layouts, strict=True)]

    return {
        "given": lambda layouts: [(one.scene, one.audit, None) for one in layouts],
        "flow": flowed,
        "refine": refined(None),
        "flow + refine": refined(flow),
        "certify": corrected(PhysicsCorrector(judges_raw=False)),
        "refine + certify": corrected(PhysicsCorrector(judges_raw=False, refiner=refiner)),
    }


def figures_of(layouts: Sequence[StartLayout], outcomes: Sequence[Outcome], store: AssetStore) -> dict[str, Any]:
    """Returns the figures of a method; shares in percent, lengths in millimetres."""
    audits = [audit for _, audit, _ in outcomes if audit is not None]
    cards = [audit.card() for audit in audits]
    clean = [
        (one, scene) for one, (scene, audit, _) in zip(layouts, outcomes, strict=True) if audit and scene and audit.card().clean
    ]
    kept = held = on_kept = on_held = 0
    moves = []
    for one, (scene, audit, _) in zip(layouts, outcomes, strict=True):
        if scene is None or audit is None or len(scene.objects) != len(one.scene.objects):
            continue
        found = relations_kept(one.scene, scene, one.shapes, audits=(one.audit, audit))
        kept, held = kept + found.directional_kept, held + found.directional_held
        on_kept, on_held = on_kept + found.on_in_kept, on_held + found.on_in_held
        moves.append(movement(one.scene, scene)[0])
    at_rest = [settle(bodies_of(scene, store.resolved(scene)[1], store), scene.table).stable is True for _, scene in clean]
    solved = [is_solved for _, _, is_solved in outcomes if is_solved is not None]
    return {
        "clean": 100 * len(clean) / len(layouts),
        "solved": 100 * sum(solved) / len(layouts) if solved else None,
        "oc": 100 * mean(card.oc for card in cards if card.oc is not None),
        "float": 100 * mean(card.float_rate for card in cards if card.float_rate is not None),
        "moved_mm": mean(moves) if moves else None,
        "directional_kept": 100 * kept / held if held else None,
        "on_in_kept": 100 * on_kept / on_held if on_held else None,
        "at_rest": 100 * mean(at_rest) if at_rest else None,
    }


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
    """Prints the figures of all methods, and the seconds of the refinement by batch."""
    torch.set_num_threads(1)
    run = RunFolder(place)
    is_run = bool(run.files("turns"))
    store = scene_source(place).store
    scenes = proposals(run) if is_run else folder_scenes(MesaTaskDataset(Path(place)))
    starts = start_layouts(scenes, store, layouts)
    if not starts:
        print(f"{place}: no layout is known not to be clean, so nothing is to be refined")
        return
    grids = ContactGrids(contact_grid_cache())
    ContactShapeCache(store, grids).shapes_of([one.scene for one in starts], [one.shapes for one in starts])
    figures: dict[str, Any] = {}
    for name, method in methods(store, grids, device).items():
        method(starts[:2])  # what is computed once
        began = time.process_time()
        outcomes = method(starts)
        seconds = time.process_time() - began
        figures[name] = {**figures_of(starts, outcomes, store), "seconds": seconds / len(starts)}
    columns = list(figures["given"])
    rows = [["", *columns]]
    for name, found in figures.items():
        digits = {key: 3 if key == "seconds" else 2 for key in columns}
        rows.append([name, *("" if found[key] is None else f"{found[key]:.{digits[key]}f}" for key in columns)])
    print(f"{len(starts)} layouts, {mean(len(one.scene.objects) for one in starts):.1f} objects each")
    print(align_columns(rows, 1))
    batches = seconds_by_batch(starts, store, grids, device)
    for batch in batches:
        print(f"batch {batch['batch']:>3}: {1e3 * batch['seconds']:6.1f} ms and {batch['megabytes']:.2f} MB a layout")
    if json_file is not None:
        document = {"layouts": len(starts), "device": device, "methods": figures, "batches": batches}
        json_file.write_text(json.dumps(document, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
