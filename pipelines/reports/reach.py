"""What a robot reaches and holds in the scenes of a run, for report pages."""

from collections import Counter
from collections.abc import Iterable, Sequence

import polars as pl

from pipelines.reports.html import bars, table
from stable_data.metrics.reach_columns import REACH_COLUMNS
from stable_data.robot.reach import reason_codes
from stable_data.storage.run_folder import RunFolder

OK = "ok"
"""Where a reason is null."""


def reach_figures(folder: RunFolder, tables: Sequence[str]) -> Iterable[str]:
    """Yields the shares of tasks by verdict, and the objects by reason; nothing if no robot was asked.

    Args:
        folder: The run.
        tables: ``scenes``, and ``rejected`` if it has rejected scenes.
    """
    rows = [row for name in tables for row in folder.table(name, list(REACH_COLUMNS)).to_pylist() if row["robot"] is not None]
    if not rows:
        return
    robots = ", ".join(sorted({row["robot"] for row in rows}))
    yield f"<h2>Reach and grasps: {robots}</h2>"
    yield table(
        ("", "scenes"),
        [
            ("all", str(len(rows))),
            ("task reachable", _share([row["task_reachable"] for row in rows])),
            ("task graspable", _share([row["task_graspable"] for row in rows])),
        ],
    )
    reasons = [code for row in rows for code in dict.fromkeys(reason_codes(row["task_reason"])) or [OK]]
    found = Counter((one["role"], (one["reason"] or OK).partition(":")[0]) for row in rows for one in row["reach"])
    yield '<div class="grid">' + bars("Tasks by reason", pl.Series(reasons, dtype=pl.String)) + "</div>"
    yield table(("object is", "reason", "objects"), [(role, reason, str(n)) for (role, reason), n in sorted(found.items())])


def _share(values: Sequence[bool | None]) -> str:
    unknown = values.count(None)
    return f"{values.count(True)} of {len(values)}" + (f", {unknown} unknown" if unknown else "")
