"""The judge by rules: its speed, its ratings of a run, and what it takes from scenes that are made bad on purpose.

``python -m benchmarks.rating RUN [--scenes N] [--bad N] [--json FILE]``. RUN has the tables ``scenes``, ``assets`` and ``meshes``.

- speed: seconds a scene for the geometry (meshes are read once and kept), the audit with the relations, and each criterion;
- ratings: means of the known scenes, and the share that passes (clean with an average above 7);
- bad scenes: for each kind of change, the mean loss of each criterion over the scenes to which it applies and that are known before
  and after.

Run with ``OMP_NUM_THREADS=1 IGL_NUM_THREADS=1``. Wall times and processor times are printed beside each other.
"""

import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import typer
from tqdm import tqdm

from models.scene_rating.rating_case import RatingCase
from models.scene_rating.symbolic_judge import SymbolicJudge
from pipelines.reports.text_table import align_columns
from stable_data.assets.store import AssetStore
from stable_data.commands.command_line import with_clear_errors
from stable_data.rating.criteria import CRITERIA, KEYS
from stable_data.rating.rating import Rating, summarise_ratings
from stable_data.scene import Scene, SceneObject
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

Change = Callable[[Scene], Scene | None]
"""Makes a scene bad; None if it cannot be made so."""


def _each(scene: Scene, change: Callable[[SceneObject], SceneObject]) -> Scene:
    return replace(scene, objects=tuple(map(change, scene.objects)))


def _first_task_object(scene: Scene) -> str | None:
    there = {o.instance for o in scene.objects}
    return next((name for name in (scene.task.task_objects if scene.task else ()) if name in there), None)


def without_task_object(scene: Scene) -> Scene | None:
    """Removes the first task object."""
    name = _first_task_object(scene)
    return None if name is None else replace(scene, objects=tuple(o for o in scene.objects if o.instance != name))


def with_giant(scene: Scene) -> Scene | None:
    """Makes the smallest object as long as the table is wide, and puts it in the middle."""
    width, depth = scene.table.size_xy
    small = min((o for o in scene.objects if o.scale is not None), key=lambda o: max(o.size), default=None)
    if small is None or small.scale is None:
        return None
    factor = width / max(small.size)
    a, b, c = (factor * side for side in small.size)
    x, y, z = (factor * share for share in small.scale)
    giant = replace(small, size=(a, b, c), scale=(x, y, z), position=(width / 2, depth / 2, c / 2))
    return _each(scene, lambda o: giant if o is small else o)


def with_two_in_one_place(scene: Scene) -> Scene | None:
    """Moves one of the two thickest objects on the table into the other."""
    standing = sorted((o for o in scene.objects if o.bottom < 0.005), key=lambda o: min(o.size))
    if len(standing) < 2:
        return None
    one, other = standing[-2:]
    return _each(scene, lambda o: o.moved(one.position, o.yaw) if o is other else o)


def heaped_up_in_corner(scene: Scene) -> Scene | None:
    """Moves everything to the near left corner, distances divided by five."""
    if len(scene.objects) < 3:
        return None
    return _each(scene, lambda o: o.moved((0.05 + 0.2 * o.position[0], 0.05 + 0.2 * o.position[1], o.position[2]), o.yaw))


def with_all_turned_away(scene: Scene) -> Scene | None:
    """Turns each object by 180 degrees in its place."""
    return _each(scene, lambda o: o.moved(o.position, o.yaw + math.pi))


def with_task_object_under_table(scene: Scene) -> Scene | None:
    """Moves the first task object under the table, towards the back."""
    name, (width, depth) = _first_task_object(scene), scene.table.size_xy
    if name is None:
        return None
    return _each(scene, lambda o: o.moved((width / 2, 0.75 * depth, -o.size[2] / 2 - 0.01), o.yaw) if o.instance == name else o)


BAD: Mapping[str, tuple[Change, str]] = {
    "a task object is removed": (without_task_object, "cwt"),
    "a thing is as long as the table": (with_giant, "osr"),
    "two things are in one place": (with_two_in_one_place, "ppi"),
    "all is heaped up in a corner": (heaped_up_in_corner, "lcr"),
    "all is turned away": (with_all_turned_away, "lcr"),
    "a task object is under the table": (with_task_object_under_table, "ov"),
}
"""What makes scenes bad, and the criterion that has to show it."""


class Clock:
    """Wall and processor seconds by what was done."""

    def __init__(self) -> None:
        self.wall: defaultdict[str, float] = defaultdict(float)
        self.processor: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measures the body."""
        wall, processor = time.perf_counter(), time.process_time()
        yield
        self.wall[name] += time.perf_counter() - wall
        self.processor[name] += time.process_time() - processor


def geometry_of(scene: Scene, run: RunScenes, store: AssetStore) -> SceneGeometry:
    """The geometry of a scene that may be changed."""
    return replace(SceneGeometry.of(scene, store), annotations=run.annotations)


def rate_with_times(judge: SymbolicJudge, case: RatingCase, clock: Clock) -> Rating:
    """Rates a scene, and measures each criterion."""
    assert case.audited is not None
    for criterion in CRITERIA:
        with clock(criterion.name):
            judge.score(criterion.key, case.audited)
    (rating,) = judge.rate([case])
    return rating


def mean_losses(before: list[tuple[Scene, Rating]], rate: Callable[[Scene], Rating]) -> dict[str, dict[str, Any]]:
    """What each change takes from each criterion, on average, with the number of scenes."""
    found: dict[str, dict[str, Any]] = {}
    for name, (change, key) in BAD.items():
        losses: list[dict[str, float]] = []
        for scene, rating in tqdm(before, desc=name, unit="scene"):
            changed = change(scene)
            after = None if changed is None else rate(changed)
            if rating.average is not None and after is not None and after.average is not None:
                losses.append({k: (rating.score(k) or 0.0) - (after.score(k) or 0.0) for k in KEYS})
        means = {k: round(fmean(loss[k] for loss in losses), 2) for k in KEYS} if losses else {}
        shown = sum(loss[key] > 0.5 for loss in losses)
        found[name] = {"criterion": key, "scenes": len(losses), "lowered": shown, "losses": means}
    return found


def main(
    run: Annotated[str, typer.Argument(help="Folder of a run.")],
    scenes: Annotated[int, typer.Option(help="Scenes that are rated, at most.")] = 100,
    bad: Annotated[int, typer.Option(help="Scenes that are made bad, at most.")] = 20,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Prints the figures."""
    chosen = RunScenes(RunFolder(run), SceneSelection(limit=scenes))
    categories = RunFolder(run).table("assets", ["category"])["category"].unique().to_pylist()
    judge, clock = SymbolicJudge(c for c in categories if c), Clock()
    rated: list[tuple[Scene, Rating]] = []
    for row in tqdm(chosen.rows(), total=len(chosen), unit="scene"):
        scene = scene_from_row(row)
        with clock("geometry"):
            geometry = geometry_of(scene, chosen, chosen.store)
        with clock("audit and relations"):
            case = RatingCase.of(geometry)
        rated.append((scene, rate_with_times(judge, case, clock)))
    summary = summarise_ratings(rating for _, rating in rated)
    count = max(1, len(rated))
    parts = {name: (clock.wall[name] / count, clock.processor[name] / count) for name in clock.wall}
    total = tuple(sum(pair[k] for pair in parts.values()) for k in (0, 1))
    rows = [("", "s/scene", "processor"), *((name, f"{a:.4f}", f"{b:.4f}") for name, (a, b) in parts.items())]
    print(align_columns([*rows, ("all", f"{total[0]:.4f}", f"{total[1]:.4f}")], 1))
    print(f"{1 / total[0]:.1f} scenes a second ({1 / total[1]:.1f} a second of processor time)\n" if total[1] else "")
    average = "unknown" if summary.average is None else f"{summary.average:.2f}"
    means = [f"{key.upper()} {value:.2f}" for key, value in summary.averages.items()]
    print(f"{summary.num_rated} of {summary.num_scenes} scenes with a known average: {', '.join(means)}, Avg. {average}")
    print(f"unknown: {dict(summary.num_unknown)}; {summary.num_passed} of {summary.num_judged} pass\n")
    losses = (
        {}
        if not bad
        else mean_losses(
            rated[:bad], lambda changed: judge.rate([RatingCase.of(geometry_of(changed, chosen, chosen.store))])[0]
        )
    )
    head = ("change", "scenes", "lowered", *(key.upper() for key in KEYS))
    lines = [
        (
            name,
            str(of["scenes"]),
            f"{of['criterion'].upper()} {of['lowered']}",
            *(f"{of['losses'].get(k, 0):.2f}" for k in KEYS),
        )
        for name, of in losses.items()
    ]
    if lines:
        print(align_columns([head, *lines], 1))
    if json_file is not None:
        figures = {"seconds": parts, "summary": asdict(summary), "losses": losses}
        json_file.write_text(json.dumps(figures, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    typer.run(with_clear_errors(main))
