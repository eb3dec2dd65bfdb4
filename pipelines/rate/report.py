"""The report page of a rate run: the row of the paper's table, the distribution of the scores, and why ratings are unknown."""

from typing import Any

import numpy as np
import polars as pl

from pipelines.reports.html import head, histogram, notices, page, table, tiles
from stable_data.rating.criteria import CRITERIA, HIGHEST, KEYS, LOWEST
from stable_data.rating.rating import PASS_MARK, rating_of_row, summarise_ratings
from stable_data.storage.run_folder import RunFolder
from stable_data.totals import total

_WORST = 12  # scenes that the page lists


def summary_counts(folder: RunFolder) -> dict[str, Any]:
    """Returns the figures of a run's ratings as JSON values, for its manifest."""
    rows = folder.table("ratings").to_pylist()
    found = summarise_ratings(map(rating_of_row, rows))
    return {
        "rated": found.num_rated,
        "averages": {key: round(value, 4) for key, value in found.averages.items()},
        "average": None if found.average is None else round(found.average, 4),
        "unknown": dict(found.num_unknown),
        "unknown_by_code": dict(found.codes),
        "passed": found.num_passed,
        "passes_known": found.num_judged,
        "judge": rows[0]["judge"] if rows else None,
        "judge_version": rows[0]["judge_version"] if rows else None,
        "prompt_tokens": found.prompt_tokens,
        "reply_tokens": found.reply_tokens,
        "cost": found.cost,
    }


def write_rate_report(folder: RunFolder, manifest: dict[str, Any]) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
    """
    counts, rows = manifest["counts"], folder.table("ratings").to_pylist()
    known = [row for row in rows if row["average"] is not None]
    columns = [*(c.key.upper() for c in CRITERIA), "Avg."]
    tokens = total((counts["prompt_tokens"], counts["reply_tokens"]))
    averages = [_shown(counts["averages"].get(key)) for key in KEYS] + [_shown(counts["average"])]
    unknown = [str(counts["unknown"][key]) for key in KEYS] + [str(len(rows) - counts["rated"])]
    edges = [*np.arange(LOWEST, HIGHEST).tolist(), HIGHEST + 1e-6]
    body = [
        head(manifest),
        f'<p class="note">judge {counts["judge"]}, version {counts["judge_version"]}</p>',
        tiles(
            [
                (f"{counts['rated']} / {manifest['num_scenes']}", "scenes with a known average"),
                (_shown(counts["average"]), "their average"),
                (f"{counts['passed']} / {counts['passes_known']}", f"clean with an average above {PASS_MARK:g}"),
                ("unknown" if tokens is None else f"{tokens:,}", "tokens"),
            ]
        ),
        "<h2>Averages</h2>",
        table(("", *columns), [("mean of the known scenes", *averages), ("scenes unknown", *unknown)]),
        '<p class="note">' + "; ".join(f"{c.key.upper()}: {c.name}" for c in CRITERIA) + "</p>",
        '<div class="grid">',
        *(histogram(c.name, pl.Series([row[c.key] for row in rows], dtype=pl.Float64), edges) for c in CRITERIA),
        "</div>",
        "<h2>Lowest averages</h2>",
        table(
            ("scene", "average", "lowest criterion", "why"),
            [_worst_row(row) for row in sorted(known, key=lambda row: (row["average"], row["scene_id"]))[:_WORST]],
        ),
        "<h2>Unknown</h2>",
        table(
            ("code", "scenes", "an example"),
            [
                (code, str(n), next(row["reason"] for row in rows if row["code"] == code))
                for code, n in sorted(counts["unknown_by_code"].items())
            ],
        ),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: ratings", body))


def _worst_row(row: dict[str, Any]) -> tuple[str, str, str, str]:
    lowest = min(CRITERIA, key=lambda c: row[c.key])
    score = f"{lowest.name} {row[lowest.key]:.1f}"
    return row["scene_id"], _shown(row["average"]), score, row[f"{lowest.key}_rationale"]


def _shown(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.1f}"
