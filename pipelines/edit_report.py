"""The report page of an edit run: what was asked, what was done, and pictures before and after."""

from collections.abc import Iterable
from html import escape
from typing import Any

import polars as pl
import pyarrow.compute as pc

from pipelines.correct_report import drawn
from pipelines.page import bars, head, histogram, image_uri, notices, page, table, tiles
from stable_data.assets import AssetStore
from stable_data.errors import ConfigError
from stable_data.scene import Scene
from stable_data.shards import RunFolder
from stable_data.tables import Row, object_from_row, scene_from_row


def write_edit_report(folder: RunFolder, manifest: dict[str, Any], store: AssetStore, num_pictures: int) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run; its tables are complete.
        manifest: Its manifest, with counts.
        store: Geometry of the assets, for the pictures.
        num_pictures: Edits that are drawn before and after, the first of each kind in turn.
    """
    counts = manifest["counts"]
    edits = folder.table("edits", ["edit_id", "kind", "instruction"]).to_pylist()
    cards = pl.from_arrow(folder.table("scenes", ["scene_id", "clean", "move_max_mm"]))
    assert isinstance(cards, pl.DataFrame)
    figures = [
        (f"{counts['scenes']} / {manifest['num_edits']}", "edits done"),
        (str(int(cards["clean"].sum())), "scenes clean afterwards"),
        (str(counts["warnings_by_code"].get("others_moved", 0)), "edits for which other things moved too"),
        (str(counts["warnings_by_code"].get("nothing_changed", 0)), "replies that changed nothing"),
        (str(counts["failures"]), "rows in failures"),
        (str(counts["warnings"]), "warnings"),
    ]
    body = [
        head(manifest),
        f'<p class="note">Reasoner: {escape(manifest["engine"])}</p>',
        tiles(figures),
        '<div class="grid">',
        bars("What the replies do", pl.Series([row["kind"] for row in edits], dtype=pl.String)),
        histogram(
            "Largest move in correction, mm (unknown: not corrected)",
            cards["move_max_mm"],
            [0, 1e-9, 1, 3, 10, 30, 100, 10_000],
        ),
        "</div>",
        *_pictures(folder, edits, store, num_pictures),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: edit", body))


def _pictures(folder: RunFolder, edits: list[Row], store: AssetStore, count: int) -> Iterable[str]:
    chosen = [row["edit_id"] for row in _in_turn(edits)[: max(count, 0)]]
    if not chosen:
        return
    befores = {row["edit_id"]: row for row in folder.table("edits", where=pc.field("edit_id").isin(chosen)).to_pylist()}
    afters = {row["scene_id"]: row for row in folder.table("scenes", where=pc.field("scene_id").isin(chosen)).to_pylist()}
    yield "<h2>Pictures</h2><p class=note>Left before, right after.</p>"
    for edit_id in chosen:
        was, now = befores[edit_id], scene_from_row(afters[edit_id])
        name = escape(edit_id)
        try:
            pictures = [(drawn(scene, store), title) for scene, title in ((_before(was, now), "before"), (now, "after"))]
        except ConfigError as error:  # this machine draws nothing at all
            yield f'<p class="note">{escape(str(error))}</p>'
            return
        except Exception as error:  # noqa: BLE001 - a scene that cannot be drawn is no reason to be without the page
            yield f'<p class="note">{name} cannot be drawn: {escape(f"{type(error).__name__}: {error}")}</p>'
            continue
        yield f"<h3>{escape(was['instruction'])}</h3><div class=grid>"
        for picture, title in pictures:
            yield f'<figure><img alt="{name} {title}" src="{image_uri(picture)}">'
            yield f"<figcaption><b>{name}</b> {title}</figcaption></figure>"
        yield "</div>" + table(("", ""), [("goes", ", ".join(was["removed"])), ("new or changed", _names(was))])


def _in_turn(edits: list[Row]) -> list[Row]:
    """Edits with the kinds taking turns."""
    seen: dict[str, int] = {}
    rank = []
    for k, row in enumerate(edits):
        seen[row["kind"]] = seen.get(row["kind"], 0) + 1
        rank.append((seen[row["kind"]], k))
    return [edits[k] for _, k in sorted(rank)]


def _before(row: Row, after: Scene) -> Scene:
    return Scene(row["scene_id"], after.table, tuple(object_from_row(o) for o in row["objects_in"]))


def _names(row: Row) -> str:
    return ", ".join(f"{o['instance']} ({o['description']})" for o in row["objects_out"])
