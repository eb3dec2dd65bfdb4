"""The paper's post-hoc optimisers and plain baselines on start layouts, by how many pairs collide in them.

``python -m benchmarks.baselines DATASET [--layouts FILE] [--per-bucket N] [--method NAME ...] [--limit SECONDS] [--json FILE]``.
Without a file of layouts, scenes of the dataset are shaken until their collisions fill the buckets. Every verdict is the exact
audit's, at 0.5 mm, of what a method gives back; a method's own opinion is the column ``done``. ``start`` is the layout itself.

- clean: scenes without collision, floating, sinking or out of bounds;
- free: scenes without collision; pairs: colliding pairs left, median; unknown counts as colliding;
- float, out: objects that float, that are out of bounds or in the table, of all;
- oc: share of all pairs that collide, mean over scenes, percent;
- move: mean distance by which objects were moved, identical ones matched; farthest: the largest, unmatched, in millimetres;
- emd: earth mover's distance to where things belong, millimetres, mean over the scenes where that is known;
- on/in: relations to other objects that held at the start and still hold, of those that held;
- done: scenes that the method itself counts as solved; s: processor seconds a scene, median, without the
  preparation of assets.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean, median
from typing import Annotated

import numpy as np
import typer
from tqdm import tqdm

from benchmarks.audit import readable_scenes
from benchmarks.layouts import Layout, read_layouts, shaken_layouts
from models.baselines.methods import METHODS
from models.baselines.outcome import Method, Outcome
from stable_data.assets import AssetStore
from stable_data.errors import StableDataError
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import PosedScene, audit_posed
from stable_data.metrics.collision import ROUNDING
from stable_data.metrics.rearrangement import distance_moved, emd_to_truth
from stable_data.relations import scene_graph
from stable_data.scene import RelationKind, Scene
from stable_data.shape import Shape

_CONTACT_GAP = 3e-3  # what carries an object in the scene graph's sense may be this far below it, metres
_START = "start"

Held = frozenset[tuple[str, RelationKind, str]]


class Nothing:
    """The baseline that leaves everything where it is."""

    def correct(self, scene: Scene, shapes: Sequence[Shape], store: AssetStore) -> Outcome:
        """Nothing."""
        return Outcome(scene, True, 0.0)


@dataclass(frozen=True, slots=True)
class Result:
    """One layout as one method left it.

    Attributes:
        method: The method's name.
        layout: The layout's.
        bucket: Its bucket.
        num_objects: Objects.
        clean: By the exact audit; None where that is unknown.
        num_collisions: Pairs that collide or may.
        num_floating: Objects that float or may.
        num_outside: Objects that are out of bounds or in the table.
        oc: Those pairs as a share of all.
        move_mean_mm: How far objects were moved, identical ones matched.
        move_max_mm: The farthest, unmatched.
        emd_mm: Earth mover's distance to the target; None where there is none.
        num_held: on/in relations that held at the start.
        num_kept: Those that still hold.
        converged: By the method's own account.
        seconds: Of the method, without the preparation of assets.
        reason: Why it did not converge.
    """

    method: str
    layout: str
    bucket: str
    num_objects: int
    clean: bool | None
    num_collisions: int
    num_floating: int
    num_outside: int
    oc: float
    move_mean_mm: float
    move_max_mm: float
    emd_mm: float | None
    num_held: int
    num_kept: int
    converged: bool
    seconds: float
    reason: str


def held(posed: PosedScene, containers: Mapping[str, bool | None]) -> Held:
    """The on/in relations of objects to other objects in a posed scene, by exact contact and containment."""
    contacts = {name: posed.supports(index, _CONTACT_GAP) or () for index, name in enumerate(posed.instances)}
    scene = posed.scene
    footprints = {o.instance: s.posed_footprint(p) for o, s, p in zip(scene.objects, posed.shapes, scene.poses(), strict=True)}
    graph = scene_graph(scene, contacts, footprints, containers)
    kinds, names = (RelationKind.ON, RelationKind.IN), set(posed.instances)
    return frozenset((a, RelationKind(kind), b) for a, b, kind in graph.edges(keys=True) if kind in kinds and b in names)


def judged(name: str, method: Method, layout: Layout, dataset: MesaTaskDataset, store: AssetStore) -> Result:
    """Lets a method correct a layout, and judges what it gives back."""
    scene, shapes, _ = store.resolved(layout.start)
    flags = {o.instance: dataset.annotation(o.asset_id).is_container if o.asset_id else None for o in scene.objects}
    before = held(PosedScene(scene, shapes), flags)
    outcome = method.correct(scene, shapes, store)
    posed = PosedScene(outcome.scene, store.shapes(outcome.scene)[0])
    audit = audit_posed(posed)
    moves = 1e3 * np.linalg.norm(outcome.scene.poses()[:, :3] - scene.poses()[:, :3], axis=1)
    sunk, count = audit.tolerance + ROUNDING, len(scene.objects)
    num_collisions = sum(p.penetration is None or p.penetration > audit.tolerance for p in audit.pairs)
    return Result(
        method=name,
        layout=scene.scene_id,
        bucket=layout.bucket,
        num_objects=count,
        clean=audit.card().clean,
        num_collisions=num_collisions,
        num_floating=sum(o.floats is not False for o in audit.objects),
        num_outside=sum(o.is_outside is not False or o.table_penetration > sunk for o in audit.objects),
        oc=num_collisions / max(1, count * (count - 1) // 2),
        move_mean_mm=1e3 * distance_moved(scene, outcome.scene),
        move_max_mm=float(moves.max(initial=0.0)),
        emd_mm=None if layout.target is None else 1e3 * emd_to_truth(outcome.scene, layout.target).cost,
        num_held=len(before),
        num_kept=len(before & held(posed, flags)),
        converged=outcome.converged,
        seconds=outcome.seconds,
        reason=outcome.reason,
    )


def run(
    layouts: Sequence[Layout],
    dataset: MesaTaskDataset,
    store: AssetStore,
    methods: Mapping[str, Method],
    limit: float = np.inf,
) -> list[Result]:
    """Every method on every layout.

    Args:
        layouts: The layouts.
        dataset: Says what is a container.
        store: Meshes of the assets.
        methods: By name; the layouts themselves are judged besides, as ``start``.
        limit: Seconds after which no further layout is begun; what was begun is finished.
    """
    end, results, everyone = time.monotonic() + limit, list[Result](), {_START: Nothing(), **methods}
    with tqdm(total=len(layouts) * len(everyone), desc="baselines", unit="scene") as bar:
        for layout in layouts:
            if time.monotonic() > end:
                print(f"out of time after {limit:g} s: the layouts from {layout.start.scene_id} on are left out")
                break
            for name, method in everyone.items():
                bar.set_postfix_str(f"{layout.start.scene_id} {name}")
                results.append(judged(name, method, layout, dataset, store))
                bar.update()
    return results


def table(results: Sequence[Result]) -> str:
    """The figures, by method and bucket."""
    columns = (
        "method", "bucket", "scenes", "clean", "free", "pairs", "oc %", "float", "out", "move", "farthest", "emd", "on/in", "done", "s",
    )  # fmt: skip
    rows: list[tuple[str, ...]] = [columns]
    names, buckets = (list(dict.fromkeys(getattr(r, key) for r in results)) for key in ("method", "bucket"))
    for name in names:
        for bucket in (*buckets, ""):
            chosen = [r for r in results if r.method == name and bucket in ("", r.bucket)]
            if chosen:
                rows.append(_row(name, bucket or "all", chosen))
    widths = [max(len(row[k]) for row in rows) for k in range(len(columns))]
    return "\n".join(
        "  ".join(cell.rjust(w) if k > 1 else cell.ljust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    )


def _row(name: str, bucket: str, results: Sequence[Result]) -> tuple[str, ...]:
    count, objects = len(results), sum(r.num_objects for r in results)
    emds = [r.emd_mm for r in results if r.emd_mm is not None]
    return (
        name,
        bucket,
        f"{count}",
        f"{sum(r.clean is True for r in results)}/{count}",
        f"{sum(r.num_collisions == 0 for r in results)}/{count}",
        f"{median(r.num_collisions for r in results):g}",
        f"{100 * mean(r.oc for r in results):.2f}",
        f"{sum(r.num_floating for r in results)}/{objects}",
        f"{sum(r.num_outside for r in results)}/{objects}",
        f"{mean(r.move_mean_mm for r in results):.1f}",
        f"{max(r.move_max_mm for r in results):.0f}",
        f"{mean(emds):.1f}" if emds else "-",
        f"{sum(r.num_kept for r in results)}/{sum(r.num_held for r in results)}",
        f"{sum(r.converged for r in results)}/{count}",
        f"{median(r.seconds for r in results):.3f}",
    )


def chosen_layouts(dataset: MesaTaskDataset, store: AssetStore, file: Path | None, per_bucket: int) -> list[Layout]:
    """The first layouts of each bucket of a file, or as many made of the dataset's own scenes."""
    if file is None:
        scenes = sorted(readable_scenes(dataset), key=lambda scene: -len(scene.objects))
        return list(shaken_layouts(scenes, store, per_bucket))
    every = list(read_layouts(file, store))
    buckets = dict.fromkeys(layout.bucket for layout in every)
    return [layout for bucket in buckets for layout in [x for x in every if x.bucket == bucket][:per_bucket]]


def main(
    data: Annotated[Path, typer.Argument(help="Folder in the MesaTask-10K format: the layouts' meshes.")],
    layouts: Annotated[Path | None, typer.Option(help="File of start layouts; else scenes of the dataset are shaken.")] = None,
    per_bucket: Annotated[int, typer.Option(help="Layouts of each bucket.")] = 4,
    method: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(METHODS)}; all by default.")] = None,
    limit: Annotated[float, typer.Option(help="Seconds after which no further layout is begun.")] = np.inf,
    file: Annotated[Path | None, typer.Option("--json", help="Where the figures are written.")] = None,
) -> None:
    """Runs the baselines on start layouts."""
    unknown = sorted(set(method or ()) - set(METHODS))
    if unknown:
        raise typer.BadParameter(f"{', '.join(unknown)}, expected of {', '.join(METHODS)}")
    dataset = MesaTaskDataset(data)
    store = AssetStore(dataset, max_bytes=2**30)
    try:
        chosen = chosen_layouts(dataset, store, layouts, per_bucket)
        results = run(chosen, dataset, store, {name: METHODS[name] for name in method or METHODS}, limit)
    except StableDataError as error:
        raise SystemExit(str(error)) from error
    print(table(results))
    if file is not None:
        file.write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n")


if __name__ == "__main__":
    typer.run(main)
