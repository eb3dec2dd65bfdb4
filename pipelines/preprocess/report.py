"""The report page of a preprocess run: counts, histograms, and scenes to look at."""

from collections.abc import Iterable
from functools import partial
from html import escape
from typing import Any

import numpy as np
import polars as pl
import pyarrow.compute as pc

from pipelines.reports.html import bars, head, histogram, notices, page, table, tiles
from pipelines.reports.scene_pictures import SceneGrids, ShownScene
from stable_data.assets.store import AssetStore
from stable_data.metrics.summary import summarise
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row


def write_report(folder: RunFolder, manifest: dict[str, Any], store: AssetStore, num_pictures: int) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
        store: The geometry of the assets, for the pictures.
        num_pictures: Number of scenes that are drawn: half of them the worst, half evenly chosen.
    """
    columns = [
        c for c in folder.dataset("scenes").schema.names if c not in ("source_json", "relations", "task", "restricted_zone")
    ]
    scenes = pl.from_arrow(folder.table("scenes", columns))
    assert isinstance(scenes, pl.DataFrame)
    body = [
        head(manifest),
        _tiles(manifest["counts"], manifest),
        *_audit(scenes),
        *_pictures(folder, scenes, SceneGrids(folder, store), num_pictures),
        *_staging(folder, scenes),
        *_assets(folder),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: preprocess", body))


def _tiles(counts: dict[str, Any], manifest: dict[str, Any]) -> str:
    figures = [
        (f"{counts['scenes']} / {manifest['num_scenes']}", "scenes usable"),
        (str(counts["failed_scenes"]), "unusable scenes"),
        (f"{counts['assets']} / {manifest['num_assets']}", "assets usable"),
        (str(manifest["num_assets_without_mesh"]), "assets without a mesh file"),
        (str(counts["samples"]), "staged samples"),
        (str(counts["sdf"]), "signed-distance grids"),
        (str(counts.get("features", 0)), f"point features of encoder {(manifest.get('encoder') or 'none')[:8]}"),
        (str(counts["warnings"]), "warnings"),
    ]
    return tiles(figures)


def _audit(scenes: pl.DataFrame) -> Iterable[str]:
    summary = summarise(scenes)
    rows = [(x.label, f"{x.count}", f"{x.total}", f"{100 * x.share:.1f} %", str(x.unknown or "")) for x in summary.lines]
    yield "<h2>Audit</h2><p class=note>Exact audit of the triangle meshes of the input scenes.</p>"
    yield table(("", "count", "of", "share", "unknown"), rows)
    yield table(("", ""), summary.figures)
    yield "<h2>Distributions</h2><div class=grid>"
    yield histogram("Objects per scene", scenes["num_objects"], [0, 4, 8, 12, 16, 20, 25, 30, 1000])
    yield histogram("Deepest penetration per scene, mm", scenes["max_penetration_mm"], [0, 1e-9, 0.5, 1, 3, 10, 30, 1000])
    yield histogram("Largest gap per scene, mm", scenes["max_gap_mm"], [0, 0.5, 1, 3, 10, 30, 1000])
    yield bars("Table type", scenes["table_type"])
    yield bars("Split", scenes["split"])
    yield "</div>"
    if summary.worst:
        yield "<h2>Worst scenes</h2>" + table(("scene", "problem"), summary.worst)


def _staging(folder: RunFolder, scenes: pl.DataFrame) -> Iterable[str]:
    objects = scenes.select(pl.col("objects").explode()).drop_nulls().unnest("objects") if scenes.height else pl.DataFrame()
    origins = folder.table("scenes", ["task"])["task"].to_pylist()
    yield "<h2>Tasks and stages</h2><div class=grid>"
    if objects.height:
        yield bars("Objects by stage", objects["stage"])
    yield bars("Task infos by origin", pl.Series("origin", [t["origin"] if t else "none" for t in origins], dtype=pl.String))
    yield histogram("Stacked objects per scene", scenes["num_stacked"], [0, 1, 2, 3, 5, 8, 1000])
    yield histogram("Contained objects per scene", scenes["num_contained"], [0, 1, 2, 3, 5, 8, 1000])
    yield "</div>"


def _assets(folder: RunFolder) -> Iterable[str]:
    reports = pl.DataFrame(folder.table("assets", ["report"])["report"].to_pylist())
    parts = folder.table("meshes", ["parts_method"])["parts_method"].to_pylist()
    errors = folder.table("sdf", ["mean_error", "sign_error", "spacing"]).to_pylist()
    if not reports.height:
        return
    faces = reports["num_faces"].to_numpy()
    rows = [
        ("watertight before repair", f"{reports['was_watertight'].sum()} of {reports.height}"),
        ("watertight after repair", f"{reports['is_watertight'].sum()} of {reports.height}"),
        ("open sheets, treated as thin shells", f"{reports['is_sheet'].sum()} of {reports.height}"),
        ("faces, median and maximum", f"{np.median(faces):.0f}, {faces.max()}"),
        ("convex parts: one hull is sufficient", f"{sum(p == 'hull' for p in parts)} of {len(parts)}"),
    ]
    if errors:
        share = [float(np.median([e[key] for e in errors])) for key in ("mean_error", "spacing")]
        rows.append(("grid error near the surface, median", f"{100 * share[0]:.3f} % of the largest extent"))
        rows.append(("grid spacing, median", f"{100 * share[1]:.2f} % of the largest extent"))
        rows.append(("wrong signs away from the surface, mean", f"{100 * np.mean([e['sign_error'] for e in errors]):.3f} %"))
    yield "<h2>Assets</h2>" + table(("", ""), rows)


def _pictures(folder: RunFolder, scenes: pl.DataFrame, grids: SceneGrids, count: int) -> Iterable[str]:
    if not scenes.height or count <= 0:
        return
    worst_first = scenes.sort(["clean", "max_penetration_mm", "scene_id"], descending=[False, True, False], nulls_last=True)
    worst = worst_first["scene_id"].to_list()[: count // 2]
    rest = sorted(set(scenes["scene_id"]) - set(worst))
    chosen = [*worst, *rest[:: max(1, len(rest) // (count - len(worst)))]][:count]
    rows = folder.table("scenes", where=pc.field("scene_id").isin(chosen)).to_pylist()
    ordered = sorted(rows, key=lambda r: chosen.index(r["scene_id"]))
    yield "<h2>Pictures</h2>"
    yield from grids.grid((row["scene_id"], partial(_shown, row)) for row in ordered)


def _shown(row: dict[str, Any]) -> list[ShownScene]:
    verdict = {True: '<span class="good">clean</span>', False: '<span class="bad">not clean</span>', None: "unknown"}[
        row["clean"]
    ]
    task = escape(row["task"]["task"]) if row["task"] else ""
    return [ShownScene(scene_from_row(row), f"<b>{escape(row['scene_id'])}</b> {verdict}<br>{task}", row=row)]
