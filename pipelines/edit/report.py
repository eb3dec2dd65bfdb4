"""The report page of an edit run: edits by kind, results, and pictures before and after."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from html import escape
from typing import Any

import polars as pl
import pyarrow.compute as pc

from pipelines.edit.settings import EditSettings
from pipelines.reports.agreement import judge_agreement
from pipelines.reports.html import bars, head, histogram, notices, page, tiles
from pipelines.reports.reach import reach_figures
from pipelines.reports.scene_pictures import SceneGrids, ShownScene
from stable_data.assets.store import AssetStore
from stable_data.scene import Scene
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import object_from_row, scene_from_row


def write_edit_report(folder: RunFolder, manifest: dict[str, Any], store: AssetStore, settings: EditSettings) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
        store: The geometry of the assets, for the pictures.
        settings: The job's settings; ``num_pictures`` edits are drawn before and after, the kinds alternate.
    """
    counts = manifest["counts"]
    edits = folder.table("edits", ["edit_id", "kind", "instruction"]).to_pylist()
    cards = pl.from_arrow(folder.table("scenes", ["scene_id", "clean", "move_max_mm"]))
    assert isinstance(cards, pl.DataFrame)
    figures = [
        (f"{counts['scenes']} / {manifest['num_edits']}", "edits completed"),
        (str(int(cards["clean"].sum())), "clean edited scenes"),
        (str(counts["warnings_by_code"].get("others_moved", 0)), "edits that moved other objects too"),
        (str(counts["warnings_by_code"].get("nothing_changed", 0)), "replies without changes"),
        (str(counts["failures"]), "rows in failures"),
        (str(counts["warnings"]), "warnings"),
    ]
    body = [
        head(manifest),
        f'<p class="note">Reasoner: {escape(manifest["engine"])}</p>',
        tiles(figures),
        '<div class="grid">',
        bars("Edits by kind", pl.Series([row["kind"] for row in edits], dtype=pl.String)),
        histogram(
            "Largest move by the correction, mm (unknown: not corrected)",
            cards["move_max_mm"],
            [0, 1e-9, 1, 3, 10, 30, 100, 10_000],
        ),
        "</div>",
        *judge_agreement(folder, ("scenes",), settings.judge_names),
        *reach_figures(folder, ("scenes",)),
        *_pictures(folder, edits, SceneGrids(folder, store), settings.num_pictures),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: edit", body))


def _pictures(folder: RunFolder, edits: list[Row], grids: SceneGrids, count: int) -> Iterable[str]:
    chosen = [row["edit_id"] for row in _in_turn(edits)[: max(count, 0)]]
    if not chosen:
        return
    befores = {row["edit_id"]: row for row in folder.table("edits", where=pc.field("edit_id").isin(chosen)).to_pylist()}
    afters = {row["scene_id"]: row for row in folder.table("scenes", where=pc.field("scene_id").isin(chosen)).to_pylist()}
    yield "<h2>Pictures</h2><p class=note>Left: before. Right: after.</p>"
    yield from grids.grid((name, partial(_shown, befores[name], afters[name])) for name in chosen)


def _shown(was: Row, row: Row) -> list[ShownScene]:
    now, name = scene_from_row(row), escape(was["edit_id"])
    goes = f"<br>removed: {escape(', '.join(was['removed']))}" if was["removed"] else ""
    return [
        ShownScene(_before(was, now), f"<b>{name}</b> before<br>{escape(was['instruction'])}", "before"),
        ShownScene(now, f"<b>{name}</b> after{goes}<br>new or changed: {escape(_names(was))}", "after", row),
    ]


def _in_turn(edits: list[Row]) -> list[Row]:
    """The edits in an order in which the kinds alternate."""
    seen: dict[str, int] = {}
    rank = []
    for k, row in enumerate(edits):
        seen[row["kind"]] = seen.get(row["kind"], 0) + 1
        rank.append((seen[row["kind"]], k))
    return [edits[k] for _, k in sorted(rank)]


def _before(row: Row, after: Scene) -> Scene:
    """The scene before an edit, with the surroundings that no edit changes."""
    objects = (*after.surroundings, *(object_from_row(o) for o in row["objects_in"]))
    return replace(after, scene_id=row["scene_id"], objects=objects, task=None, relations=())


def _names(row: Row) -> str:
    return ", ".join(f"{o['instance']} ({o['description']})" for o in row["objects_out"])
