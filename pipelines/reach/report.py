"""The report page of a reach run: tasks by verdict and reason, objects, outcomes of the trials."""

from collections import Counter
from typing import Any

from pipelines.reports.html import head, notices, page, table, tiles
from pipelines.reports.reach import reach_figures
from stable_data.storage.run_folder import RunFolder


def write_reach_report(folder: RunFolder, manifest: dict[str, Any]) -> None:
    """Writes ``report/index.html``.

    Args:
        folder: The run, with complete tables.
        manifest: Its manifest, with counts.
    """
    counts = manifest["counts"]
    outcomes = Counter(folder.table("grasps", ["outcome"])["outcome"].to_pylist())
    body = [
        head(manifest),
        tiles(
            [
                (f"{counts['task_reachable']} / {manifest['num_scenes']}", "scenes with a reachable task"),
                (f"{counts['task_graspable']} / {manifest['num_scenes']}", "scenes with a graspable task"),
                (str(counts["grasps"]), "grasps tried"),
                (str(outcomes["held"]), "grasps that held"),
            ]
        ),
        *reach_figures(folder, ("scenes",)),
        "<h2>Trials</h2>",
        table(("outcome", "grasps"), [(outcome, str(n)) for outcome, n in outcomes.most_common()]),
        *notices(folder),
    ]
    folder.write_bytes("report/index.html", page(f"{manifest['dataset']}: reach", body))
