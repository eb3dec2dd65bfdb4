"""The report page of an evaluate-policy run: success by task, by asset and by scene, with intervals, and why episodes failed."""

from typing import Any

import polars as pl

from pipelines.reports.html import bars, head, histogram, notices, page, table, tiles
from stable_data.scores.intervals import wilson_interval
from stable_data.storage.run_folder import RunFolder

_HEAD = ("episodes", "successes", "rate", "95 % interval")
_SHOWN = 300  # scenes of the table


def write_evaluation_report(folder: RunFolder, manifest: dict[str, Any], rows: pl.DataFrame) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
        rows: Its attempts, see :func:`pipelines.evaluate_policy.job.attempts`.
    """
    counts = manifest["counts"]
    low, high = counts["interval"]
    figures = [
        (f"{counts['successes']} / {counts['attempts']}", "episodes that fulfil their goal"),
        (f"{low:.0%} – {high:.0%}", "95 % interval of the success rate (Wilson)"),
        (str(manifest["num_scenes"]), "scenes"),
        (str(counts["never_began"]), "episodes that could not begin"),
    ]
    by_scene = _lines(rows, "scene_id")
    more = f'<p class="note">{len(by_scene) - _SHOWN} more scenes are in the table episodes.</p>' if by_scene[_SHOWN:] else ""
    body = [
        head(manifest),
        f'<p class="note">Policy {manifest["policy"]}, {manifest["settings"]["robot"]}, {manifest["settings"]["control"]}.</p>',
        tiles(figures),
        "<h2>By kind of task</h2>",
        table(("task", *_HEAD), _lines(rows, "task_kind")),
        "<h2>By assets that the task acts on</h2>",
        table(("assets", *_HEAD), _lines(rows, "assets")),
        '<div class="grid">',
        bars("Why episodes failed", rows.filter(~pl.col("success"))["reason"].str.split(":").list.first()),
        histogram("Length of successes, seconds", rows.filter("success")["seconds"], [0, 2, 4, 6, 8, 10, 15, 20, 60]),
        "</div>",
        "<h2>By scene</h2>",
        table(("scene", *_HEAD), by_scene[:_SHOWN]),
        more,
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: evaluate-policy {manifest['policy']}", body))


def _lines(rows: pl.DataFrame, key: str) -> list[list[str]]:
    found = rows.group_by(key).agg(pl.len().alias("n"), pl.col("success").sum().alias("done")).sort(key)
    return [[str(name), str(n), str(done), f"{done / n:.0%}", _interval(done, n)] for name, n, done in found.iter_rows()]


def _interval(done: int, n: int) -> str:
    low, high = wilson_interval(done, n)
    return f"{low:.0%} – {high:.0%}"
