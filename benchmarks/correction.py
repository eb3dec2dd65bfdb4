"""The paper's Table 2 and its rearrangement table: the corrector and post-hoc optimisers on start layouts.

``python -m benchmarks.correction DATASET [--layouts FILE] [--start POSES] [--per-bucket N] [--every N] [--method NAME ...]
[--settle] [--json FILE]``. Without a file of layouts, scenes of the dataset are perturbed until their collisions fill the
buckets. Every verdict is the exact audit's, at 0.5 mm, on the result of a method; a method's own verdict is the column ``done``.
``start`` is the layout itself, ``flow`` the raw result of the learned flow, ``certify`` certification without it, ``corrector``
both together as the toolkit uses them. ``given``: with the layout's own scene graph, whose broken relations are restored.
``settled``: with MuJoCo's verdict on stability. If Drake is installed, Steerable's projection runs in it too.

- clean: scenes without collision, floating, sinking or out of bounds; drop: dropped objects;
- free: scenes without collision; pairs: remaining colliding pairs, median; oc: their share; unknown counts as colliding;
- float, out: share of objects that float; that are out of bounds or in the table;
- move: mean movement of objects, millimetres, with identical objects matched; farthest: the largest one, unmatched;
- emd: earth mover's distance to the target layout, millimetres, if it is known;
- on/in, dir: relations to other objects that still hold, of those that held at the start; back: ``on`` and ``in`` relations of
  the layout's scene graph that hold again, of those that the noise broke;
- rest: objects that stay at rest in MuJoCo, of all; lie: the same of whole layouts (``--settle``), and again without layouts in
  which an obliquely tilted object is shifted out of its carrier, which no yaw can repair;
- done: scenes that the method itself counts as solved; s: seconds a scene, median, without the preparation of assets.

Below: the median seconds of each baseline, divided by those of ``certify`` and ``corrector``, by bucket.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from statistics import mean, median
from typing import Annotated

import numpy as np
import typer
from tqdm import tqdm

from benchmarks.audit import readable_scenes
from benchmarks.baselines.methods import METHODS
from benchmarks.baselines.outcome import Baseline, BaselineResult
from benchmarks.layouts import StartLayout, read_layouts, shaken_layouts
from benchmarks.steerable_drake import in_drake
from benchmarks.text_table import align_columns
from models.physics_corrector.certify import CorrectionStatus
from models.physics_corrector.certify.correction import CorrectionOptions
from models.physics_corrector.corrector import Flow, PhysicsCorrector
from models.physics_corrector.flow.checkpoint import DEFAULT_WEIGHTS
from models.physics_corrector.learned_flow import AUTO, load_flow
from stable_data.assets.store import AssetStore
from stable_data.errors import MeshError, StableDataError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import PosedScene, audit_posed_scene, audit_scene
from stable_data.metrics.collision import ROUNDING
from stable_data.metrics.rearrangement import distance_moved, emd_to_truth
from stable_data.metrics.related_scene import relate_scene
from stable_data.metrics.relations_kept import RelationsKept, relations_kept
from stable_data.scene import Scene, SceneObject
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT, settle

_START = "start"
_TIMED = ("certify", "corrector")
_OBLIQUE = math.radians(5)  # a tilt that is this far from every right angle


class IdentityBaseline:
    """A baseline that changes nothing."""

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Returns the scene itself."""
        return BaselineResult(scene, True, 0.0)


@dataclass(frozen=True, slots=True)
class CorrectorBaseline:
    """The corrector, whole or in parts, with the interface of the baselines.

    Attributes:
        weights: Weights of the flow; ``none``: certification alone.
        certifies: Whether the flow's result is certified.
        is_told: Whether it knows the scene graph of the layout; else it infers the relations from the poses.
        settles: Whether MuJoCo tests what stays at rest.
    """

    weights: str = AUTO
    certifies: bool = True
    is_told: bool = False
    settles: bool = False

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Corrects the layout; returns it unchanged if it is infeasible."""
        corrector = PhysicsCorrector(_flow(self.weights), judges_raw=False)
        options = CorrectionOptions(asks_engine=self.settles)
        corrector.move([scene], store, options)  # encodes the shapes: preparation of assets, like convex parts
        if self.settles:
            bodies_of(scene, shapes, store)
        audit = audit_scene(scene, shapes)  # a correction needs it only for its figures
        told = scene if self.is_told else replace(scene, relations=())
        begin = time.process_time()
        known = scene
        if corrector.flow is not None and not self.is_told:  # the flow gets the supports of the layout as it is
            posed = PosedScene(scene, shapes)
            known = relate_scene(posed, audit_posed_scene(posed), {}).scene
        (request,) = corrector.move([replace(known, relations=told.relations)], store, options, [audit])
        if not self.certifies:
            return BaselineResult(request.raw or scene, request.raw is not None, time.process_time() - begin)
        done = corrector.certify(request, store)
        seconds = time.process_time() - begin
        is_clean = done.status in (CorrectionStatus.CERTIFIED, CorrectionStatus.DROPPED)
        return BaselineResult(done.certified or scene, is_clean, seconds, done.reason)


@lru_cache(maxsize=2)
def _flow(weights: str) -> Flow | None:
    return load_flow(weights)


def ours() -> dict[str, Baseline]:
    """Returns the corrector and its parts, by name; those with the flow only if its weights exist."""
    alone: dict[str, Baseline] = {
        "certify": CorrectorBaseline("none"),
        "certify, given": CorrectorBaseline("none", is_told=True),
        "certify, settled": CorrectorBaseline("none", settles=True),
    }
    if not DEFAULT_WEIGHTS.is_file():
        return alone
    return {
        "flow": CorrectorBaseline(certifies=False),
        **alone,
        "corrector": CorrectorBaseline(),
        "corrector, given": CorrectorBaseline(is_told=True),
    }


@dataclass(frozen=True, slots=True)
class Result:
    """The result of one method on one layout.

    Attributes:
        method: Name of the method.
        layout: Name of the layout.
        bucket: Its bucket.
        num_objects: Number of objects.
        clean: Verdict of the exact audit; None if unknown.
        num_dropped: Dropped objects.
        num_collisions: Colliding pairs; unknown counts as colliding.
        num_floating: Floating objects; unknown counts as floating.
        num_outside: Objects that are out of bounds or in the table.
        oc: Colliding pairs as a share of all.
        move_mean_mm: Mean movement, with identical objects matched.
        move_max_mm: Largest movement, unmatched.
        emd_mm: Earth mover's distance to the target; None without a target, or if objects were dropped.
        kept: Relations that held at the start, and those that still hold.
        num_resting: Objects that stay at rest in MuJoCo; None if there was no simulation.
        can_rest: Whether yaw and shift could bring all objects to rest: no oblique object is out of its carrier.
        converged: Verdict of the method itself.
        seconds: Time of the method, without the preparation of assets.
        reason: Why it did not converge.
    """

    method: str
    layout: str
    bucket: str
    num_objects: int
    clean: bool | None
    num_dropped: int
    num_collisions: int
    num_floating: int
    num_outside: int
    oc: float
    move_mean_mm: float
    move_max_mm: float
    emd_mm: float | None
    kept: RelationsKept
    num_resting: int | None
    can_rest: bool
    converged: bool
    seconds: float
    reason: str


def judged(name: str, method: Baseline, layout: StartLayout, store: AssetStore, *, settles: bool = False) -> Result:
    """Corrects a layout with a method, and judges the result."""
    scene, shapes, _ = store.resolved(layout.start)
    outcome = method.correct(scene, shapes, store)
    left, left_shapes, _ = store.resolved(outcome.scene)
    audit = audit_posed_scene(PosedScene(left, left_shapes))
    start = replace(scene, objects=tuple(scene[o.instance] for o in left.objects))
    moves = 1e3 * np.linalg.norm(left.poses()[:, :3] - start.poses()[:, :3], axis=1)
    sunk, count = audit.tolerance + ROUNDING, len(left.objects)
    num_collisions = sum(p.penetration is None or p.penetration > audit.tolerance for p in audit.pairs)
    is_whole = count == len(scene.objects)
    kept = relations_kept(scene, left, shapes, left_shapes)
    return Result(
        method=name,
        layout=scene.scene_id,
        bucket=layout.bucket,
        num_objects=len(scene.objects),
        clean=audit.card().clean,
        num_dropped=len(scene.objects) - count,
        num_collisions=num_collisions,
        num_floating=sum(o.floats is not False for o in audit.objects),
        num_outside=sum(o.is_outside is not False or o.table_penetration > sunk for o in audit.objects),
        oc=num_collisions / max(1, count * (count - 1) // 2),
        move_mean_mm=1e3 * distance_moved(start, left) if count else 0.0,
        move_max_mm=float(moves.max(initial=0.0)),
        emd_mm=None if layout.target is None or not is_whole else 1e3 * emd_to_truth(left, layout.target).cost,
        kept=kept,
        num_resting=_num_resting(left, left_shapes, store) if settles else None,
        can_rest=kept.asked_broken == 0 or not _has_displaced_oblique(scene),
        converged=outcome.converged,
        seconds=outcome.seconds,
        reason=outcome.reason,
    )


def _num_resting(scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> int | None:
    """Counts objects that MuJoCo moves at most 10 mm and turns at most 5 degrees in 4 seconds; None if it cannot simulate them."""
    try:
        result = settle(bodies_of(scene, shapes, store), scene.table)
    except MeshError:
        return None
    if result.stable is None:
        return None
    return int(((result.moves <= MOVE_LIMIT) & (result.turns <= TURN_LIMIT)).sum())


def _has_displaced_oblique(scene: Scene) -> bool:
    """Whether an obliquely tilted object, which leaned on its carrier in the scene graph, is far from that carrier's middle."""
    for relation in scene.relations:
        o, names = scene[relation.subject], {other.instance for other in scene.objects}
        if relation.target not in names or not _is_oblique(o):
            continue
        carrier = scene[relation.target]
        if math.dist(o.position[:2], carrier.position[:2]) > max(carrier.size[:2]) / 2:
            return True
    return False


def _is_oblique(o: SceneObject) -> bool:
    return all(abs(o.tilt_angle - right) > _OBLIQUE for right in (0.0, math.pi / 2, math.pi))


def run(
    layouts: Sequence[StartLayout],
    store: AssetStore,
    methods: Mapping[str, Baseline],
    limit: float = np.inf,
    *,
    settles: bool = False,
) -> list[Result]:
    """Runs every method on every layout.

    Args:
        layouts: The layouts.
        store: Meshes of the assets.
        methods: Name -> method; the layouts themselves are judged as well, as ``start``.
        limit: Seconds after which no further layout is started; a started one is finished.
        settles: Whether MuJoCo tests what stays at rest.
    """
    end, results, everyone = time.monotonic() + limit, list[Result](), {_START: IdentityBaseline(), **methods}
    with tqdm(total=len(layouts) * len(everyone), desc="correction", unit="scene") as bar:
        for layout in layouts:
            if time.monotonic() > end:
                print(f"out of time after {limit:g} s: the layouts from {layout.start.scene_id} on are left out")
                break
            for name, method in everyone.items():
                bar.set_postfix_str(f"{layout.start.scene_id} {name}")
                results.append(judged(name, method, layout, store, settles=settles))
                bar.update()
    return results


def table(results: Sequence[Result]) -> str:
    """Returns a table of the figures, by method and bucket."""
    columns = (
        "method", "bucket", "scenes", "clean", "drop", "free", "pairs", "oc %", "float", "out", "move", "farthest", "emd", "on/in", "dir",
        "back", "rest", "lie", "done", "s",
    )  # fmt: skip
    rows: list[tuple[str, ...]] = [columns]
    names, buckets = (list(dict.fromkeys(getattr(r, key) for r in results)) for key in ("method", "bucket"))
    for name in names:
        for bucket in (*buckets, ""):
            chosen = [r for r in results if r.method == name and bucket in ("", r.bucket)]
            if chosen:
                rows.append(_row(name, bucket or "all", chosen))
    return align_columns(rows, 2)


def ratios(results: Sequence[Result]) -> str:
    """Returns a table of the time ratios of baselines to our methods, by bucket; empty if one of the two was not run."""
    buckets = [*dict.fromkeys(r.bucket for r in results), ""]
    names = dict.fromkeys(r.method for r in results)

    def seconds(name: str, bucket: str) -> float:
        return median(r.seconds for r in results if r.method == name and bucket in ("", r.bucket))

    rows = [
        (baseline, own, *(f"{seconds(baseline, bucket) / seconds(own, bucket):.3g}" for bucket in buckets))
        for baseline in names
        for own in names
        if baseline in (*METHODS, *in_drake()) and own in _TIMED
    ]
    return align_columns([("seconds of", "over", *(bucket or "all" for bucket in buckets)), *rows], 2) if rows else ""


def _row(name: str, bucket: str, results: Sequence[Result]) -> tuple[str, ...]:
    count, objects = len(results), sum(r.num_objects - r.num_dropped for r in results)
    emds = [r.emd_mm for r in results if r.emd_mm is not None]
    settled = [r for r in results if r.num_resting is not None]
    lying = [(r.num_resting == r.num_objects - r.num_dropped, r.can_rest) for r in settled]

    def of(part: str, whole: str) -> str:
        return f"{sum(getattr(r.kept, part) for r in results)}/{sum(getattr(r.kept, whole) for r in results)}"

    return (
        name,
        bucket,
        f"{count}",
        f"{sum(r.clean is True for r in results)}/{count}",
        f"{sum(r.num_dropped for r in results)}",
        f"{sum(r.num_collisions == 0 for r in results)}/{count}",
        f"{median(r.num_collisions for r in results):g}",
        f"{100 * mean(r.oc for r in results):.2f}",
        f"{sum(r.num_floating for r in results)}/{objects}",
        f"{sum(r.num_outside for r in results)}/{objects}",
        f"{mean(r.move_mean_mm for r in results):.1f}",
        f"{max(r.move_max_mm for r in results):.0f}",
        f"{mean(emds):.1f}" if emds else "-",
        of("on_in_kept", "on_in_held"),
        of("directional_kept", "directional_held"),
        of("asked_restored", "asked_broken"),
        f"{sum(r.num_resting or 0 for r in settled)}/{sum(r.num_objects - r.num_dropped for r in settled)}" if settled else "-",
        f"{sum(lies for lies, _ in lying)}/{len(lying)}, {sum(lies for lies, can in lying if can)}/{sum(can for _, can in lying)}"
        if settled
        else "-",
        f"{sum(r.converged for r in results)}/{count}",
        f"{median(r.seconds for r in results):.3f}",
    )


def chosen_layouts(
    dataset: MesaTaskDataset, store: AssetStore, file: Path | None, per_bucket: int, start: str = "start", every: int = 1
) -> list[StartLayout]:
    """Returns the first layouts of each bucket from every n-th line of a file, or as many made from the dataset's scenes."""
    if file is None:
        scenes = sorted(readable_scenes(dataset), key=lambda scene: -len(scene.objects))
        return list(shaken_layouts(scenes, store, per_bucket))
    read = list(read_layouts(file, store, start))[::every]
    buckets = dict.fromkeys(layout.bucket for layout in read)
    return [layout for bucket in buckets for layout in [x for x in read if x.bucket == bucket][:per_bucket]]


def main(
    data: Annotated[Path, typer.Argument(help="Folder in the MesaTask-10K format: the layouts' meshes.")],
    layouts: Annotated[
        Path | None, typer.Option(help="File of start layouts; without it, scenes of the dataset are perturbed.")
    ] = None,
    per_bucket: Annotated[int, typer.Option(help="Layouts of each bucket.")] = 4,
    every: Annotated[int, typer.Option(min=1, help="Only every n-th layout of the file.")] = 1,
    method: Annotated[list[str] | None, typer.Option(help="A baseline, or certify, flow, corrector; all by default.")] = None,
    start: Annotated[str, typer.Option(help="Poses of the file to start from, such as start_xyz.")] = "start",
    settles: Annotated[bool, typer.Option("--settle", help="Test in MuJoCo what stays at rest.")] = False,
    limit: Annotated[float, typer.Option(help="Seconds after which no further layout is started.")] = np.inf,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Runs the corrector and the baselines on start layouts."""
    known = {**METHODS, **in_drake(), **ours()}
    if unknown := sorted(set(method or ()) - set(known)):
        raise typer.BadParameter(f"{', '.join(unknown)}, expected of {', '.join(known)}")
    dataset = MesaTaskDataset(data)
    store = AssetStore(dataset, max_bytes=2**30)
    try:
        chosen = chosen_layouts(dataset, store, layouts, per_bucket, start, every)
        results = run(chosen, store, {name: known[name] for name in method or known}, limit, settles=settles)
    except StableDataError as error:
        raise SystemExit(str(error)) from error
    print(table(results), ratios(results), sep="\n\n")
    if file is not None:
        file.write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
