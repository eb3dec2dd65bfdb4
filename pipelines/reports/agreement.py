"""The section of a report on how far judges agree."""

from collections.abc import Iterable, Sequence
from itertools import combinations

import polars as pl
import pyarrow.compute as pc

from pipelines.reports.html import histogram, table
from stable_data.judges.registry import DISAGREE
from stable_data.metrics.judge_columns import FURTHER, JUDGES, SHARE, verdict_columns
from stable_data.storage.run_folder import RunFolder

_SHOWN = 200  # scenes


def judge_agreement(folder: RunFolder, tables: Sequence[str], judges: Sequence[str]) -> Iterable[str]:
    """The agreement of the judges of a run, the scenes on which they disagree, and the shares of robust rest.

    Args:
        folder: The run, with complete tables.
        tables: Its tables of scenes.
        judges: The judges that judged all scenes.
    """
    columns = [verdict_columns(name)[0] for name in ("mujoco", *FURTHER)] + [SHARE]
    scenes = pl.concat([pl.DataFrame(folder.table(name, columns)) for name in tables])
    if len(judges) > 1:
        yield "<h2>Judges</h2><p class=note>Scenes by the verdicts of two physics engines, with the same limits.</p>"
        rows = []
        for first, second in combinations(judges, 2):
            a, b = (scenes[verdict_columns(name)[0]] for name in (first, second))
            unknown = int((a.is_null() | b.is_null()).sum())
            engines = JUDGES[first].engine, JUDGES[second].engine
            counts = (int((a & b).sum()), int((a & ~b).sum()), int((~a & b).sum()), int((~a & ~b).sum()), unknown)
            rows.append((*engines, *map(str, counts)))
        yield table(
            ("first", "second", "stable in both", "in the first only", "in the second only", "in none", "unknown"), rows
        )
        found = folder.table("warnings", where=pc.field("code") == DISAGREE).sort_by("id").to_pylist()
        if found:
            yield f"<h3>Scenes on which judges disagree ({len(found)})</h3>"
            yield table(("scene", "verdicts"), [(row["id"], row["message"].partition(": ")[2]) for row in found[:_SHOWN]])
        if len(found) > _SHOWN:
            yield f'<p class="note">{len(found) - _SHOWN} more are in the table warnings, code {DISAGREE}.</p>'
    if scenes[SHARE].drop_nulls().len():
        yield "<h2>Robust rest</h2><div class=grid>"
        yield histogram("Share of changed repetitions that are stable", scenes[SHARE], [0, 0.5, 0.75, 0.9, 1, 1000])
        yield "</div>"
