"""The corrector's parts and post-hoc optimisers on start layouts: the paper's Table 2, its rearrangement table, and more.

``python -m benchmarks.correction PLACE [--layouts FILE] [--kind KIND] [--method NAME ...] [--settle] [--json FILE]``. PLACE is a folder
in the MesaTask-10K format, a preprocess run or a generate run. The start layouts are those of the file, or of a kind: ``shaken``
(scenes of the folder, perturbed until their collisions fill the buckets), ``given`` (the scenes themselves), ``perturbed`` (held-out
scenes of a preprocess run with each kind of error of the training), ``proposed`` and ``proposed_whole`` (the layouts of each stage of a
generate run before their correction, or the last ones alone), ``dropped`` and ``dropped_whole`` (the same after the stage's new objects
were dropped onto their carriers, as generation does first).

Methods: ``flow``, ``refine``, ``certify`` and their combinations, and the optimisers. Every verdict is the exact audit's, at 0.5 mm, on
the result of a method; its own verdict is the column ``done``. ``start`` is the layout itself. With ``--given``, the corrector knows
the layout's own scene graph, whose broken relations are restored; else it infers the relations from the poses. If Drake is installed,
Steerable's projection runs in it too.

- clean: scenes without collision, floating, sinking or out of bounds; drop: dropped objects;
- free: scenes without collision; pairs: remaining colliding pairs, median; oc: their share deeper than 0.5 mm, unknown counts;
  oc 0, 1, 10: touching, deeper than 1 and than 10 mm; sdf: by the paper's rule;
- float: share of objects that float; gap: by the paper's rule; out: share that is out of bounds or in the table;
- move: mean movement of objects, millimetres, with identical objects matched; farthest: the largest one, unmatched;
- emd: earth mover's distance to the target layout, millimetres, if it is known;
- on/in, dir: relations to other objects that still hold, of those that held at the start; back: ``on`` and ``in`` relations of
  the layout's scene graph that hold again, of those that the start broke; meant: directional relations of the target that hold;
- space, align, face: distance of the spacing (mm), alignment (mm) and facing (degrees) of the objects to those of the targets;
- rest: objects that stay at rest in MuJoCo, of all; lie: the same of whole layouts (``--settle``), and again without layouts in
  which an obliquely tilted object is shifted out of its carrier, which no yaw can repair;
- done: scenes that the method itself counts as solved, which for the refinement are those that are clean, steady by statics, on the
  carriers of the scene graph and in the same order; s: seconds a scene, median, without the preparation of assets.

Below: the median seconds of each baseline, divided by those of the corrector's methods, by bucket.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean, median
from typing import Annotated, cast, get_args

import numpy as np
import torch
import typer
from tqdm import tqdm

from benchmarks.audit import readable_scenes
from benchmarks.corrector_parts import CorrectorTerms, corrector_parts
from benchmarks.layouts import (
    StartLayout,
    audit_layout,
    held_out_scenes,
    perturbed_layouts,
    proposed_layouts,
    read_layouts,
    shaken_layouts,
)
from benchmarks.steerable_drake import in_drake
from models.baselines.methods import METHODS
from models.baselines.outcome import Baseline, BaselineResult
from models.physics_corrector.corrector import Purpose
from models.physics_corrector.flow.expected_error import ExpectedError
from models.physics_corrector.learned_flow import AUTO
from models.physics_corrector.training.perturbation import PerturbationSettings
from pipelines.reports.text_table import align_columns
from pipelines.sources.scenes import scene_source
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, MeshError, StableDataError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.rearrangement import distance_moved, emd_to_truth
from stable_data.metrics.relations_kept import RelationsKept, relations_kept
from stable_data.metrics.sampled_collision import add_sampled_collisions
from stable_data.metrics.tidiness import NOTHING, Tidiness
from stable_data.metrics.verdicts import ROUNDING, Audit
from stable_data.scene import Scene, SceneObject
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT, settle
from stable_data.storage.run_folder import RunFolder

START = "start"
"""The name of the layouts themselves among the methods."""

_KINDS = ("shaken", "given", "perturbed", "proposed", "proposed_whole", "dropped", "dropped_whole")
_TIMED = ("certify", "flow + certify", "refine + certify", "flow + refine + certify")
_OBLIQUE = math.radians(5)  # a tilt that is this far from every right angle


class IdentityBaseline:
    """A baseline that changes nothing."""

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> BaselineResult:
        """Returns the scene itself."""
        return BaselineResult(scene, True, 0.0)


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
        oc: Colliding pairs as a share of all; ``oc_0mm``, ``oc_1mm``, ``oc_10mm`` touching ones and deeper ones, ``oc_sdf`` by the
            paper's rule; None if unknown.
        oc_0mm: See above.
        oc_1mm: See above.
        oc_10mm: See above.
        oc_sdf: See above.
        float_gap: Floating objects by the paper's rule, as a share of all; None if unknown.
        tidiness: Spacing, alignment and facing of its objects.
        move_mean_mm: Mean movement, with identical objects matched.
        move_max_mm: Largest movement, unmatched.
        move_category_mm: Mean movement, with objects of one category matched.
        emd_mm: Earth mover's distance to the target; None without a target, or if objects were dropped.
        emd_category_mm: The same with objects of one category matched.
        kept: Relations that held at the start, and those that still hold.
        meant: Directional relations of the target, and those of them that hold; (0, 0) without a target.
        num_resting: Objects that stay at rest in MuJoCo; None if there was no simulation.
        can_rest: Whether yaw and shift could bring all objects to rest: no oblique object is out of its carrier.
        converged: Verdict of the method itself.
        failed: Whether the method gave no layout, so that the figures are those of the start.
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
    oc_0mm: float | None
    oc_1mm: float | None
    oc_10mm: float | None
    oc_sdf: float | None
    float_gap: float | None
    tidiness: Tidiness
    move_mean_mm: float
    move_max_mm: float
    move_category_mm: float
    emd_mm: float | None
    emd_category_mm: float | None
    kept: RelationsKept
    meant: tuple[int, int]
    num_resting: int | None
    can_rest: bool
    converged: bool
    failed: bool
    seconds: float
    reason: str


def judged(name: str, method: Baseline, layout: StartLayout, store: AssetStore, *, settles: bool = False) -> Result:
    """Corrects a layout with a method, and judges the result; a method that fails leaves the layout as it is."""
    scene, shapes, _ = store.resolved(layout.start)
    begin = time.process_time()
    try:
        outcome = method.correct(scene, shapes, store)
    except StableDataError as error:
        outcome = BaselineResult(scene, False, time.process_time() - begin, str(error))
    left, left_shapes, _ = store.resolved(outcome.scene)
    audit = audit_layout(left, left_shapes)
    start = replace(scene, objects=tuple(scene[o.instance] for o in left.objects))
    moves = 1e3 * np.linalg.norm(left.poses()[:, :3] - start.poses()[:, :3], axis=1)
    sunk, count = audit.tolerance + ROUNDING, len(left.objects)
    num_collisions = sum(p.penetration is None or p.penetration > audit.tolerance for p in audit.pairs)
    is_whole = count == len(scene.objects)
    target = layout.target if is_whole else None
    kept = relations_kept(scene, left, shapes, left_shapes, audits=(audit_layout(scene, shapes), audit))
    card = add_sampled_collisions(audit.card(), left, left_shapes, audit)
    return Result(
        method=name,
        layout=scene.scene_id,
        bucket=layout.bucket,
        num_objects=len(scene.objects),
        clean=card.clean,
        num_dropped=len(scene.objects) - count,
        num_collisions=num_collisions,
        num_floating=sum(o.floats is not False for o in audit.objects),
        num_outside=sum(o.is_outside is not False or o.table_penetration > sunk for o in audit.objects),
        oc=num_collisions / max(1, audit.num_pairs),
        **{name: getattr(card, name) for name in ("oc_0mm", "oc_1mm", "oc_10mm", "oc_sdf", "float_gap")},
        tidiness=Tidiness.of(left, left_shapes),
        move_mean_mm=1e3 * distance_moved(start, left) if count else 0.0,
        move_max_mm=float(moves.max(initial=0.0)),
        move_category_mm=1e3 * distance_moved(start, left, "category") if count else 0.0,
        emd_mm=None if target is None else 1e3 * emd_to_truth(left, target).cost,
        emd_category_mm=None if target is None else 1e3 * emd_to_truth(left, target, "category").cost,
        kept=kept,
        meant=_meant(target, left, left_shapes, audit),
        num_resting=_num_resting(left, left_shapes, store) if settles else None,
        can_rest=kept.asked_broken == 0 or not _has_displaced_oblique(scene),
        converged=outcome.converged,
        failed=not outcome.converged and outcome.scene is scene,
        seconds=outcome.seconds,
        reason=outcome.reason,
    )


def _meant(target: Scene | None, left: Scene, shapes: Sequence[Shape], audit: Audit) -> tuple[int, int]:
    """Counts the directional relations of the target, and those of them that hold in a layout of the same objects."""
    if target is None:
        return 0, 0
    meant = replace(target, relations=())
    kept = relations_kept(meant, left, shapes, audits=(audit_layout(meant, shapes), audit))
    return kept.directional_held, kept.directional_kept


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
    end, results, everyone = time.monotonic() + limit, list[Result](), {START: IdentityBaseline(), **methods}
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


def table(results: Sequence[Result], targets: Tidiness = NOTHING) -> str:
    """Returns a table of the figures, by method and bucket; ``targets`` are the tidiness of the targets."""
    columns = (
        "method", "bucket", "scenes", "clean", "drop", "free", "pairs", "oc %", "oc 0", "oc 1", "oc 10", "sdf", "float", "gap %", "out",
        "move", "farthest", "emd", "on/in", "dir", "back", "meant", "space", "align", "face", "rest", "lie", "done", "s",
    )  # fmt: skip
    rows: list[tuple[str, ...]] = [columns]
    names, buckets = (list(dict.fromkeys(getattr(r, key) for r in results)) for key in ("method", "bucket"))
    for name in names:
        for bucket in (*buckets, ""):
            chosen = [r for r in results if r.method == name and bucket in ("", r.bucket)]
            if chosen:
                rows.append(_row(name, bucket or "all", chosen, targets))
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


def _row(name: str, bucket: str, results: Sequence[Result], targets: Tidiness) -> tuple[str, ...]:
    count, objects = len(results), sum(r.num_objects - r.num_dropped for r in results)
    settled = [r for r in results if r.num_resting is not None]
    lying = [(r.num_resting == r.num_objects - r.num_dropped, r.can_rest) for r in settled]

    def of(part: str, whole: str) -> str:
        return f"{sum(getattr(r.kept, part) for r in results)}/{sum(getattr(r.kept, whole) for r in results)}"

    def known(field: str, scale: float, digits: int) -> str:
        values = [value for r in results if (value := getattr(r, field)) is not None]
        return f"{scale * mean(values):.{digits}f}" if values else "-"

    tidiness = Tidiness.joined(r.tidiness for r in results).distance(targets)
    return (
        name,
        bucket,
        f"{count}",
        f"{sum(r.clean is True for r in results)}/{count}",
        f"{sum(r.num_dropped for r in results)}",
        f"{sum(r.num_collisions == 0 for r in results)}/{count}",
        f"{median(r.num_collisions for r in results):g}",
        f"{100 * mean(r.oc for r in results):.2f}",
        *(known(field, 100.0, 2) for field in ("oc_0mm", "oc_1mm", "oc_10mm", "oc_sdf")),
        f"{sum(r.num_floating for r in results)}/{objects}",
        known("float_gap", 100.0, 1),
        f"{sum(r.num_outside for r in results)}/{objects}",
        f"{mean(r.move_mean_mm for r in results):.1f}",
        f"{max(r.move_max_mm for r in results):.0f}",
        known("emd_mm", 1.0, 1),
        of("on_in_kept", "on_in_held"),
        of("directional_kept", "directional_held"),
        of("asked_restored", "asked_broken"),
        f"{sum(r.meant[1] for r in results)}/{sum(r.meant[0] for r in results)}",
        *("-" if value is None else f"{value:.1f}" for value in tidiness),
        f"{sum(r.num_resting or 0 for r in settled)}/{sum(r.num_objects - r.num_dropped for r in settled)}" if settled else "-",
        f"{sum(lies for lies, _ in lying)}/{len(lying)}, {sum(lies for lies, can in lying if can)}/{sum(can for _, can in lying)}"
        if settled
        else "-",
        f"{sum(r.converged for r in results)}/{count}",
        f"{median(r.seconds for r in results):.3f}",
    )


def tidiness_of_targets(layouts: Sequence[StartLayout], store: AssetStore) -> Tidiness:
    """Measures the targets of layouts, each once."""
    targets = {id(layout.target): layout.target for layout in layouts if layout.target is not None}
    return Tidiness.joined(Tidiness.of(target, store.resolved(target)[1]) for target in targets.values())


def chosen_layouts(
    place: str,
    store: AssetStore,
    file: Path | None,
    per_bucket: int,
    start: str = "start",
    every: int = 1,
    kind: str = "shaken",
) -> list[StartLayout]:
    """Returns the first layouts of each bucket from every n-th line of a file, or of a kind.

    Raises:
        ConfigError: The kind is unknown, or PLACE has none of it (``config_invalid``).
    """
    if file is not None:
        found = list(read_layouts(file, store, start))
    elif kind == "shaken":
        scenes = sorted(readable_scenes(MesaTaskDataset(Path(place))), key=lambda scene: -len(scene.objects))
        return list(shaken_layouts(scenes, store, per_bucket))[::every]
    elif kind == "given":
        found = [StartLayout(scene, None, "", 0) for scene in readable_scenes(MesaTaskDataset(Path(place)))]
    elif kind == "perturbed":
        found = list(perturbed_layouts(held_out_scenes(place, per_bucket), store, PerturbationSettings()))
    elif kind in ("proposed", "proposed_whole", "dropped", "dropped_whole"):
        drops = store if kind.startswith("dropped") else None
        found = list(proposed_layouts(RunFolder(place), is_whole=kind.endswith("whole"), store=drops))
    else:
        raise ConfigError(f"kind is {kind!r}, expected one of {', '.join(_KINDS)}", "config_invalid")
    found = found[::every]
    buckets = dict.fromkeys(layout.bucket for layout in found)
    return [layout for bucket in buckets for layout in [x for x in found if x.bucket == bucket][:per_bucket]]


def main(
    place: Annotated[str, typer.Argument(help="Folder in the MesaTask-10K format, preprocess run or generate run.")],
    layouts: Annotated[Path | None, typer.Option(help="File of start layouts over the meshes of PLACE.")] = None,
    kind: Annotated[str, typer.Option(help=f"Without a file, layouts of PLACE: {', '.join(_KINDS)}.")] = "shaken",
    per_bucket: Annotated[int, typer.Option(help="Layouts of each bucket, or of each kind of error.")] = 4,
    every: Annotated[int, typer.Option(min=1, help="Only every n-th layout.")] = 1,
    method: Annotated[list[str] | None, typer.Option(help="A baseline, or parts of the corrector; all by default.")] = None,
    start: Annotated[str, typer.Option(help="Poses of the file to start from, such as start_xyz.")] = "start",
    is_told: Annotated[bool, typer.Option("--given", help="The corrector knows the layout's scene graph.")] = False,
    settles: Annotated[bool, typer.Option("--settle", help="Test in MuJoCo what stays at rest.")] = False,
    asks: Annotated[bool, typer.Option("--ask-engine", help="Certification repairs what MuJoCo moves.")] = False,
    weights: Annotated[str, typer.Option(help="Weights of the flow.")] = AUTO,
    steps: Annotated[int, typer.Option(min=0, help="Solver steps of the flow; 0: those of the weights.")] = 0,
    purpose: Annotated[
        str, typer.Option(help="repair: layouts are meant as they are; rearrange: things go where they belong.")
    ] = "repair",
    position_error: Annotated[float, typer.Option(help="Expected error along x and y, metres; 0: unknown.")] = 0.0,
    yaw_error: Annotated[float, typer.Option(help="Expected error of yaw, radians; 0: unknown.")] = 0.0,
    limit: Annotated[float, typer.Option(help="Seconds after which no further layout is started.")] = np.inf,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Runs the corrector and the baselines on start layouts."""
    if purpose not in get_args(Purpose):
        raise typer.BadParameter(f"purpose is {purpose}, expected {' or '.join(get_args(Purpose))}")
    error = ExpectedError(position_error or None, yaw_error or None)
    terms = CorrectorTerms(weights, steps, is_told, asks, cast(Purpose, purpose), error)
    known = {**METHODS, **in_drake(), **corrector_parts(terms)}
    if unknown := sorted(set(method or ()) - set(known)):
        raise typer.BadParameter(f"{', '.join(unknown)}, expected of {', '.join(known)}")
    torch.set_num_threads(1)
    try:
        store = scene_source(place).store
        chosen = chosen_layouts(place, store, layouts, per_bucket, start, every, kind)
        results = run(chosen, store, {name: known[name] for name in method or known}, limit, settles=settles)
    except StableDataError as error_found:
        raise SystemExit(str(error_found)) from error_found
    print(table(results, tidiness_of_targets(chosen, store)), ratios(results), sep="\n\n")
    if file is not None:
        rows = [{key: value for key, value in asdict(result).items() if key != "tidiness"} for result in results]
        file.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
