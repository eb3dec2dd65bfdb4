"""The gain of the learned flow before `certify`: both against `certify` alone, on the same layouts.

``python -m benchmarks.flow_gain RUN [DATASET] [--layouts FILE] [--weights FILE ...] [--scenes N] [--json FILE]``. RUN is the
folder of a preprocess run: clean scenes of its split ``validation`` (if too few, then also of other splits except ``train``) are
made coarse by every perturbation of the training. DATASET is a folder in the MesaTask-10K format with the meshes of a file of
start layouts; without a file its own scenes are perturbed. Every method gets the scene graph that is inferred from the layout.

- clean: layouts that become exactly clean, of all; drop: dropped objects;
- move, turn: movement and rotation of objects from the layout, mean over objects, then over layouts, millimetres and degrees;
- farthest: the largest move of a layout, mean over layouts;
- on/in, dir: relations to other objects that still hold, of those that held before, over all layouts;
- flow, certify: milliseconds a layout on one core, mean. The flow processes all layouts together, as the pipeline does; the
  features of shapes, which are computed once each, are not counted.

Run with ``OMP_NUM_THREADS=1 IGL_NUM_THREADS=1``.
"""

import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Annotated

import numpy as np
import torch
import typer
from tqdm import tqdm

from benchmarks.correction import chosen_layouts
from benchmarks.text_table import align_columns
from models.physics_corrector.certify import CorrectionStatus
from models.physics_corrector.certify.flow_start import certify_moved
from models.physics_corrector.corrector import Flow
from models.physics_corrector.geometry.scene_batch import LayoutBatch, pad_scenes
from models.physics_corrector.learned_flow import AUTO, load_flow
from models.physics_corrector.training.dataset import TrainingScenes, clean_targets
from models.physics_corrector.training.perturbation import KINDS, PerturbationSettings, perturb
from stable_data.assets.store import AssetStore
from stable_data.errors import StableDataError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.metrics.movement import movement
from stable_data.metrics.related_scene import relate_scene
from stable_data.metrics.relations_kept import RelationsKept, relations_kept
from stable_data.scene import Scene

ALONE = "certify"
"""The method without a flow."""


@dataclass(frozen=True, slots=True)
class CoarseLayout:
    """A layout to be corrected.

    Attributes:
        group: Its kind of perturbation, or its bucket.
        scene: The layout, with inferred supports.
        shapes: The geometry of its objects.
    """

    group: str
    scene: Scene
    shapes: Sequence[Shape]


@dataclass(frozen=True, slots=True)
class Gain:
    """The result of one method on one layout.

    Attributes:
        method: Name of the method.
        group: The layout's group.
        layout: Its name.
        num_objects: Number of objects.
        status: The outcome.
        num_dropped: Dropped objects.
        move_mean_mm: Mean movement of objects; None if infeasible.
        move_max_mm: Largest movement; None if infeasible.
        turn_mean_deg: Mean rotation of objects; None if infeasible.
        kept: Relations before and after; None if infeasible.
        flow_seconds: Processor time of the flow, its share of a batch.
        certify_seconds: Processor time of `certify`.
    """

    method: str
    group: str
    layout: str
    num_objects: int
    status: CorrectionStatus
    num_dropped: int
    move_mean_mm: float | None
    move_max_mm: float | None
    turn_mean_deg: float | None
    kept: RelationsKept | None
    flow_seconds: float
    certify_seconds: float


def shown(group: str, scene: Scene, shapes: Sequence[Shape]) -> CoarseLayout:
    """Returns a layout with supports inferred from its poses, and without the relations of its source."""
    posed = PosedScene(replace(scene, relations=()), shapes)
    seen = relate_scene(posed, audit_posed_scene(posed), {}).scene
    return CoarseLayout(group, replace(seen, relations=()), shapes)


def held_out(source: TrainingScenes, num_scenes: int) -> list[Scene]:
    """Returns clean scenes of a run that are not in the training split, those of ``validation`` first."""
    scenes, splits, _ = clean_targets(source.uri)
    chosen = [scene for split in (1, 2) for scene, own in zip(scenes, splits, strict=True) if own == split]
    return chosen[:num_scenes]


def perturbed(
    scenes: Sequence[Scene], store: AssetStore, settings: PerturbationSettings, seed: int = 0
) -> Iterator[CoarseLayout]:
    """Makes every scene coarse by every kind of perturbation.

    Args:
        scenes: Clean scenes.
        store: Their meshes.
        settings: Sizes of the errors.
        seed: Seed of the errors; each kind has its own random stream.

    Yields:
        The layouts, kind by kind.
    """
    resolved = [store.resolved(scene)[:2] for scene in scenes]
    arrays = pad_scenes([scene for scene, _ in resolved], [own for _, own in resolved], [frozenset()] * len(resolved))
    tensors = {name: torch.from_numpy(value) for name, value in arrays.items()}
    batch = LayoutBatch(shape_index=torch.zeros_like(tensors["parent"]), **tensors)
    for number, kind in enumerate(KINDS):
        poses, _ = perturb(batch, settings, torch.Generator().manual_seed(seed + number), kind)
        for (scene, own), at in zip(resolved, poses.double().numpy(), strict=True):
            yield shown(kind, scene.with_poses(at[: len(own)]), own)


def compared(layouts: Sequence[CoarseLayout], flows: Mapping[str, Flow]) -> list[Gain]:
    """Runs `certify` alone, and after each flow.

    Args:
        layouts: The layouts.
        flows: Name of the method -> flow.

    Returns:
        Figures of every layout and method. The order of methods changes from layout to layout, because the first one fills caches.
    """
    raws: dict[str, Sequence[Scene | None]] = {ALONE: [None] * len(layouts)}
    seconds = {ALONE: 0.0}
    for name, flow in flows.items():
        asked = [c.scene for c in layouts], [c.shapes for c in layouts], [frozenset[str]()] * len(layouts)
        flow(*asked)  # computes the features of shapes, which are cached
        begin = time.process_time()
        raws[name] = flow(*asked)
        seconds[name] = (time.process_time() - begin) / len(layouts)
    names, gains = list(raws), list[Gain]()
    for number, coarse in enumerate(tqdm(layouts, desc="flow_gain", unit="layout")):
        turn = number % len(names)
        for name in names[turn:] + names[:turn]:
            gains.append(_gain(name, coarse, raws[name][number], seconds[name]))
    return gains


def _gain(method: str, coarse: CoarseLayout, raw: Scene | None, flow_seconds: float) -> Gain:
    scene = coarse.scene
    begin = time.process_time()
    done, _ = certify_moved(scene, raw, coarse.shapes)
    seconds = time.process_time() - begin
    move = farthest = turned = kept = None
    if done.scene is not None:
        move, farthest, _ = movement(scene, done.scene)
        kept = relations_kept(scene, done.scene, coarse.shapes)
        turns = [o.yaw - scene[o.instance].yaw for o in done.scene.objects]
        turned = float(np.degrees(np.abs(np.arctan2(np.sin(turns), np.cos(turns)))).mean()) if turns else 0.0
    return Gain(
        method=method,
        group=coarse.group,
        layout=scene.scene_id,
        num_objects=len(scene.objects),
        status=done.status,
        num_dropped=len(done.dropped),
        move_mean_mm=move,
        move_max_mm=farthest,
        turn_mean_deg=turned,
        kept=kept,
        flow_seconds=flow_seconds,
        certify_seconds=seconds,
    )


def table(gains: Sequence[Gain]) -> str:
    """Returns a table of the figures by group and method."""
    rows: list[Sequence[str]] = [
        ("group", "method", "clean", "drop", "move mm", "farthest", "turn deg", "on/in", "dir", "flow ms", "certify ms")
    ]
    groups, methods = (list(dict.fromkeys(getattr(g, key) for g in gains)) for key in ("group", "method"))
    for group in (*groups, "all"):
        rows += [
            _row(group, method, [g for g in gains if g.method == method and group in (g.group, "all")])
            for method in sorted(methods, key=lambda name: name != ALONE)
        ]
    return align_columns(rows, 2)


def _row(group: str, method: str, gains: Sequence[Gain]) -> Sequence[str]:
    kept = [g.kept for g in gains if g.kept is not None]

    def average(name: str) -> str:
        values = [value for g in gains if (value := getattr(g, name)) is not None]
        return f"{mean(values):.1f}" if values else "-"

    def share(part: str) -> str:
        held = sum(getattr(k, f"{part}_held") for k in kept)
        return f"{100 * sum(getattr(k, f'{part}_kept') for k in kept) / held:.1f} %" if held else "-"

    return (
        group,
        method,
        f"{sum(g.status in (CorrectionStatus.CERTIFIED, CorrectionStatus.DROPPED) for g in gains)}/{len(gains)}",
        f"{sum(g.num_dropped for g in gains)}",
        *(average(name) for name in ("move_mean_mm", "move_max_mm", "turn_mean_deg")),
        share("on_in"),
        share("directional"),
        *(f"{1e3 * mean(getattr(g, name) for g in gains):.0f}" for name in ("flow_seconds", "certify_seconds")),
    )


def main(
    run: Annotated[Path, typer.Argument(help="Folder of a preprocess run.")],
    dataset: Annotated[Path | None, typer.Argument(help="Folder in the MesaTask-10K format: meshes of start layouts.")] = None,
    layouts: Annotated[
        Path | None, typer.Option(help="File of start layouts with them; without it, its scenes are perturbed.")
    ] = None,
    weights: Annotated[list[str] | None, typer.Option(help="Weights of flows; by default those of the repository.")] = None,
    scenes: Annotated[int, typer.Option(help="Held-out scenes of the run.")] = 40,
    per_bucket: Annotated[int, typer.Option(help="Start layouts of each bucket.")] = 6,
    seed: Annotated[int, typer.Option(help="Seed of the errors.")] = 0,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Compares `certify` alone with `certify` after the flow."""
    torch.set_num_threads(1)
    try:
        flows = {f"flow {name} + certify": flow for name in weights or [AUTO] if (flow := load_flow(name)) is not None}
        with tempfile.TemporaryDirectory() as cache:
            source = TrainingScenes(str(run), Path(cache))
            chosen = list(perturbed(held_out(source, scenes), source.store(), PerturbationSettings(), seed))
            if dataset is not None:
                store = AssetStore(MesaTaskDataset(dataset), max_bytes=2**30)
                for layout in chosen_layouts(MesaTaskDataset(dataset), store, layouts, per_bucket):
                    scene, shapes, _ = store.resolved(layout.start)
                    chosen.append(shown(layout.bucket, scene, shapes))
            gains = compared(chosen, flows)
    except StableDataError as error:
        raise SystemExit(str(error)) from error
    print(table(gains))
    if file is not None:
        file.write_text(json.dumps([asdict(gain) for gain in gains], indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(main)
