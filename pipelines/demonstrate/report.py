"""The report page of a demonstrate run: success by kind of task, why episodes failed, and pictures."""

from collections import Counter
from collections.abc import Iterable
from html import escape
from typing import Any

import numpy as np
import polars as pl
import pyarrow.compute as pc

from pipelines.reports.html import bars, head, histogram, image_uri, notices, page, table, tiles
from stable_data.geometry.images import decode_png
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row

_MOMENTS = 5  # pictures of an episode


def write_demonstrate_report(folder: RunFolder, manifest: dict[str, Any], num_pictures: int) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
        num_pictures: Episodes that are shown, if pictures were recorded.
    """
    counts = manifest["counts"]
    columns = ["episode_id", "task_kind", "instruction", "success", "reason", "num_steps", "fps"]
    rows = folder.table("episodes", columns).to_pylist()
    seconds = pl.Series([row["num_steps"] / row["fps"] for row in rows], dtype=pl.Float64)
    share = f"{counts['successes']} / {len(rows)}"
    figures = [
        (share, "episodes that fulfil their goal"),
        (str(manifest["num_scenes"]), "scenes"),
        (str(counts["failed_episodes"]), "episodes that could not begin"),
        (f"{float(seconds.sum()) / max(1, len(rows)):.1f} s", "mean length"),
    ]
    by_task = [[kind, str(total), f"{done} ({done / total:.0%})"] for kind, (done, total) in counts["by_task"].items()]
    body = [
        head(manifest),
        tiles(figures),
        "<h2>By kind of task</h2>",
        table(["task", "episodes", "successes"], by_task),
        '<div class="grid">',
        bars("Why episodes failed", pl.Series(_reasons(rows), dtype=pl.String)),
        histogram("Length of the episodes, seconds", seconds, [0, 2, 4, 6, 8, 10, 15, 20, 60]),
        "</div>",
        "<h2>Failures of the expert</h2>",
        table(["reason", "task", "episodes"], _failed(rows)),
        *_pictures(folder, rows, num_pictures),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: demonstrate", body))


def _reasons(rows: Iterable[Row]) -> list[str]:
    return [str(row["reason"]).partition(":")[0] for row in rows if not row["success"]]


def _failed(rows: Iterable[Row]) -> list[list[str]]:
    """Reasons by kind of task, the most frequent first."""
    found = Counter((str(row["reason"]).partition(":")[0], row["task_kind"]) for row in rows if not row["success"])
    return [[reason, kind, str(count)] for (reason, kind), count in found.most_common()]


def _pictures(folder: RunFolder, rows: list[Row], count: int) -> Iterable[str]:
    chosen = [row["episode_id"] for row in _in_turn(rows)[:count]]
    if not chosen:
        return
    columns = ["episode_id", "instruction", "success", "reason", "pictures"]
    found = folder.table("episodes", columns, where=pc.field("episode_id").isin(chosen)).to_pylist()
    shown = {row["episode_id"]: row for row in found if row["pictures"]}
    if not shown:
        return
    yield "<h2>Pictures</h2>"
    for name in chosen:
        if name in shown:
            row = shown[name]
            result = "fulfilled" if row["success"] else f"failed: {row['reason']}"
            caption = f"<b>{escape(name)}</b>: {escape(row['instruction'])} <i>{escape(result)}</i>"
            yield f'<p>{caption}<br><img src="{image_uri(_strip(row))}" style="max-width:100%"></p>'


def _strip(row: Row) -> Any:
    """Moments of an episode in one row of pictures, those of each camera below each other."""
    lines = []
    for camera in row["pictures"]:
        files = camera["images"]
        moments = np.linspace(0, len(files) - 1, _MOMENTS).round().astype(int)
        lines.append(np.concatenate([decode_png(files[k]) for k in moments], axis=1))
    return np.concatenate(lines)


def _in_turn(rows: list[Row]) -> list[Row]:
    """The episodes in an order in which kinds of task and results alternate."""
    seen: Counter[tuple[str, bool]] = Counter()
    rank = []
    for k, row in enumerate(rows):
        key = row["task_kind"], row["success"]
        seen[key] += 1
        rank.append((seen[key], k))
    return [rows[k] for _, k in sorted(rank)]
