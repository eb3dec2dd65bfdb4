"""The taste of generated scenes: the distance to held-out scenes in each of a list of statistics.

``python -m benchmarks.taste GENERATED HELD_OUT [--split test,validation] [--generated-split SPLITS] [--json FILE] [--sheet
FILE.png]``. GENERATED is a generate run. HELD_OUT is a preprocess run: its scenes of ``--split`` are compared with, and its
split train says which categories occur together, and how large things of a category are. :mod:`stable_data.scores.taste` defines the
statistics and the distance.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from PIL import Image

from pipelines.reports.text_table import align_columns
from pipelines.sources.scenes import mesh_cache
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.commands.command_line import with_clear_errors
from stable_data.geometry.mesh import Mesh
from stable_data.scene import Scene
from stable_data.scores.taste import POOLED, STATISTICS, StatisticComparison, TrainingStatistics, compare_scenes, read_scenes
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.render import contact_sheet, object_colour, render_scene
from stable_data.storage.row_groups import SPLITS
from stable_data.storage.run_folder import RunFolder

_SHOWN, _SHEET_COLUMNS, _PICTURE = 12, 6, (384, 320)  # scenes of each set, and pixels


def figures_table(comparisons: Mapping[str, StatisticComparison]) -> str:
    """The figures of one kind of table as text."""
    rows = [("", "generated", "held out", "distance", "floor", "ratio")]
    for key, c in comparisons.items():
        statistic = STATISTICS[key]
        means = [_shown(x, 2) if statistic.has_mean else "" for x in (c.generated, c.held_out)]
        rows.append((statistic.label, means[0], means[1], _shown(c.distance, 3), _shown(c.floor, 3), _shown(c.ratio, 1)))
    return align_columns(rows, 1)


def kinds_table(comparisons: Mapping[str, Mapping[str, StatisticComparison]]) -> str:
    """The distances of all kinds of table as text, each with its ratio to the floor in brackets."""
    kinds = [kind for kind in comparisons if kind != POOLED]
    rows = [["", *kinds]]
    for key, statistic in STATISTICS.items():
        found = [comparisons[kind][key] for kind in kinds]
        rows.append([statistic.label, *("unknown" if c.distance is None else _distance_and_ratio(c) for c in found)])
    return align_columns(rows, 1)


def _distance_and_ratio(c: StatisticComparison) -> str:
    return f"{_shown(c.distance, 3)} ({_shown(c.ratio, 1)})"


def _shown(value: float | None, digits: int) -> str:
    return "unknown" if value is None else f"{value:.{digits}f}"


def draw_sheet(sets: Sequence[tuple[str, str, Sequence[Scene]]]) -> Picture:
    """Draws some scenes of each set from above, spread over the kinds of table.

    Args:
        sets: The name of each set, its run and its scenes.

    Raises:
        ConfigError: The machine cannot render (``no_gl``).
    """
    images, labels = list[Picture](), list[str]()
    for name, run, scenes in sets:
        store = AssetStore(RunAssets(RunFolder(run), mesh_cache()))
        ordered = sorted(scenes, key=lambda s: (s.table.table_type, s.scene_id))
        for k in np.unique(np.linspace(0, len(ordered) - 1, min(_SHOWN, len(ordered))).astype(int)).tolist():
            images.append(_seen_from_above(ordered[k], store))
            labels.append(f"{name}: {ordered[k].table.table_type}, {len(ordered[k].objects)} objects")
        missing = -len(images) % _SHEET_COLUMNS  # the next set begins a row of its own
        images += [np.full((_PICTURE[1], _PICTURE[0], 3), 255, np.uint8)] * missing
        labels += [""] * missing
    return contact_sheet(images, labels, _SHEET_COLUMNS)


def _seen_from_above(scene: Scene, store: AssetStore) -> Picture:
    shapes, _ = store.shapes(scene)
    meshes = [Mesh(shape.vertices, shape.faces) if shape.is_exact else None for shape in shapes]
    colours = [store.paint_of(o) or object_colour(o) for o in scene.objects]
    return render_scene(scene, meshes, size=_PICTURE, view="top", colors=colours)


def main(
    generated: Annotated[str, typer.Argument(help="Folder of a generate run.")],
    held_out: Annotated[str, typer.Argument(help="Folder of a preprocess run.")],
    split: Annotated[str, typer.Option(help="Splits of the held-out scenes, joined by commas.")] = "test,validation",
    generated_split: Annotated[str, typer.Option(help="Splits of the generated scenes; empty for all scenes.")] = "",
    json_file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
    sheet: Annotated[Path | None, typer.Option(help="File for pictures of scenes of both runs, seen from above, PNG.")] = None,
) -> None:
    """Prints the distance of each statistic, of all tables and by kind of table."""
    sets = list[tuple[str, str, list[Scene]]]()
    for name, run, text in (("generated", generated, generated_split), ("held out", held_out, split)):
        splits = [word for word in text.split(",") if word]
        if unknown := sorted({*splits} - {*SPLITS}):
            raise typer.BadParameter(f"splits are {unknown}, expected some of {', '.join(SPLITS)}")
        sets.append((name, run, list(read_scenes(run, splits))))
        if not sets[-1][2]:
            raise typer.BadParameter(f"{run}: no scenes{f' of the splits {text}' if splits else ''}, expected some")
    training = TrainingStatistics(read_scenes(held_out, ["train"]))
    scenes, others = (found for _, _, found in sets)
    comparisons = compare_scenes(scenes, others, training)
    print(f"{len(scenes)} generated scenes, {len(others)} held-out ones ({split}), {training.num_scenes} of training\n")
    print(f"{POOLED}\n{figures_table(comparisons[POOLED])}\n")
    print(f"distance by kind of table, in brackets its ratio to the floor\n{kinds_table(comparisons)}")
    if json_file is not None:
        found = {kind: {key: asdict(c) for key, c in of_kind.items()} for kind, of_kind in comparisons.items()}
        counts = {"generated": len(scenes), "held_out": len(others), "training": training.num_scenes}
        document = {"split": split, "generated_split": generated_split, "scenes": counts, "tables": found}
        json_file.write_text(json.dumps(document, indent=2) + "\n", "utf-8")
    if sheet is not None:
        Image.fromarray(draw_sheet(sets)).save(sheet, "png")


if __name__ == "__main__":
    typer.run(with_clear_errors(main))
