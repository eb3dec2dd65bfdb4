"""The report page of a correct run: figures of the scenes before, after the flow and after the correction; with pictures."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from html import escape
from typing import Any

import polars as pl
import pyarrow.compute as pc

from pipelines.correct.settings import CorrectSettings
from pipelines.reports.agreement import judge_agreement
from pipelines.reports.html import bars, head, histogram, notices, page, table, tiles
from pipelines.reports.reach import reach_figures
from pipelines.reports.scene_pictures import SceneGrids, ShownScene
from stable_data.assets.store import AssetStore
from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

_CARDS = (("card_before", "before"), ("card_raw", "flow alone"), ("card_after", "corrected"))


def write_correct_report(folder: RunFolder, manifest: dict[str, Any], store: AssetStore, settings: CorrectSettings) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
        store: The geometry of the assets, for the pictures.
        settings: The job's settings; ``num_pictures`` scenes are drawn before and after, those with the most collisions before.
    """
    corrections = pl.from_arrow(folder.table("corrections"))
    assert isinstance(corrections, pl.DataFrame)
    counts = manifest["counts"]
    by_status = counts["by_status"]
    figures = [
        (f"{by_status.get('certified', 0)} / {manifest['num_scenes']}", "scenes certified clean"),
        (str(by_status.get("dropped", 0)), "clean after removing objects"),
        (str(by_status.get("infeasible", 0)), "infeasible"),
        *([(str(by_status["unclean"]), "not clean: not certified")] if "unclean" in by_status else []),
        (str(by_status.get("unknown", 0)), "unknown: a mesh is missing"),
        (str(counts["failures"]), "rows in failures"),
        (str(counts["warnings"]), "warnings"),
    ]
    body = [
        head(manifest),
        tiles(figures),
        *_before_and_after(corrections),
        *judge_agreement(folder, ("scenes",), settings.judge_names),
        *reach_figures(folder, ("scenes",)),
        *_pictures(folder, corrections, SceneGrids(folder, store), settings.num_pictures),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: correct", body))


def _before_and_after(corrections: pl.DataFrame) -> Iterable[str]:
    if not corrections.height:
        return
    cards = [(title, corrections[column].drop_nulls()) for column, title in _CARDS]
    frames = [(title, column.struct.unnest()) for title, column in cards if len(column)]
    rows = [
        ("scenes", *(str(f.height) for _, f in frames)),
        ("clean", *(_share(f["clean"]) for _, f in frames)),
        ("colliding pairs", *(str(f["num_collisions"].sum()) for _, f in frames)),
        ("mean share of colliding pairs (OC)", *(_percent(f["oc"].mean()) for _, f in frames)),
        ("mean share of floating objects", *(_percent(f["float_rate"].mean()) for _, f in frames)),
        ("mean share of objects out of bounds", *(_percent(f["out_of_bounds_rate"].mean()) for _, f in frames)),
        ("deepest penetration, mm", *(_number(f["max_penetration_mm"].max()) for _, f in frames)),
        ("largest table penetration, mm", *(_number(f["table_penetration_mm"].max()) for _, f in frames)),
    ]
    yield "<h2>Before and after</h2><p class=note>Exact audit of the triangle meshes, tolerance 0.5 mm.</p>"
    yield table(("", *(title for title, _ in frames)), rows)
    sums = corrections.select(pl.col("^(on_in|asked|directional)_.*$").sum()).row(0, named=True)
    kept = [
        ("on and in relations: kept, of those before", _of(sums["on_in_kept"], sums["on_in_held"])),
        ("directional relations: kept, of those before", _of(sums["directional_kept"], sums["directional_held"])),
        (
            "on and in relations: restored, of those that the layout broke",
            _of(sums["asked_restored"], sums["asked_broken"]),
        ),
        ("removed objects", str(int(corrections["dropped"].list.len().sum()))),
    ]
    yield "<h2>Relations kept</h2>" + table(("", ""), kept)
    after = dict(frames).get("corrected")
    if after is not None:
        yield "<h2>Movement</h2><div class=grid>"
        yield histogram("Mean move per scene, mm", after["move_mean_mm"], [0, 1e-9, 1, 3, 10, 30, 100, 10_000])
        yield histogram("Largest move per scene, mm", after["move_max_mm"], [0, 1e-9, 1, 3, 10, 30, 100, 10_000])
        yield bars("Status", corrections["status"])
        yield "</div>"


def _pictures(folder: RunFolder, corrections: pl.DataFrame, grids: SceneGrids, count: int) -> Iterable[str]:
    done = corrections.filter(pl.col("card_after").is_not_null())
    if not done.height or count <= 0:
        return
    worst_first = done.with_columns(pl.col("card_before").struct.field("num_collisions").alias("n"))
    chosen = worst_first.sort(["n", "scene_id"], descending=[True, False])["scene_id"].to_list()[:count]
    starts = {row["scene_id"]: row for row in done.filter(pl.col("scene_id").is_in(chosen)).iter_rows(named=True)}
    rows = {row["scene_id"]: row for row in folder.table("scenes", where=pc.field("scene_id").isin(chosen)).to_pylist()}
    yield "<h2>Pictures</h2><p class=note>Left: before. Right: corrected.</p>"
    yield from grids.grid((name, partial(_shown, rows[name], starts[name])) for name in chosen)


def _shown(row: dict[str, Any], correction: dict[str, Any]) -> list[ShownScene]:
    after = scene_from_row(row)
    # Objects that the correction removed are not in the scene, so the card before it is not that of the scene that is shown.
    card = None if correction["dropped"] else correction["card_before"]
    both = ((_before(after, correction["start"]), "before", card), (after, "corrected", row))
    return [ShownScene(scene, f"<b>{escape(after.scene_id)}</b> {title}", title, facts) for scene, title, facts in both]


def _before(after: Scene, start: list[dict[str, Any]]) -> Scene:
    """The input scene without the objects that the correction removed."""
    poses = {row["instance"]: row for row in start}
    objects = (o.moved(tuple(poses[o.instance]["position"]), poses[o.instance]["yaw"]) for o in after.objects)
    return replace(after, objects=tuple(objects))


def _share(values: pl.Series) -> str:
    unknown = values.null_count()
    return f"{int(values.sum())} of {len(values)}" + (f", {unknown} unknown" if unknown else "")


def _percent(value: Any) -> str:
    return "unknown" if value is None else f"{100 * value:.2f} %"


def _number(value: Any) -> str:
    return "unknown" if value is None else f"{value:.2f}"


def _of(count: Any, total: Any) -> str:
    return f"{count or 0} of {total or 0}" + (f" ({100 * count / total:.1f} %)" if total else "")
