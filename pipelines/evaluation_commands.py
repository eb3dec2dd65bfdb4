"""The command line of the jobs that evaluate."""

import json
from pathlib import Path
from typing import Annotated

import typer

from pipelines.job_options import DryRun, JobSettings, NumWorkers, RunOfScenes, RunOut, worker_count
from stable_data.cli import SOME_FAILED, Address, with_clear_errors


@with_clear_errors
def views(
    scenes: RunOfScenes,
    out: RunOut,
    where: Annotated[str, typer.Option(help="Which scenes, such as \"clean and split == 'test'\".")] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table views is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Draw the scenes of a run from the front and in perspective, and describe the pictures. Run again to continue after a stop.

    Pictures and features are in the table views, for distances between sets of pictures (FID, KID) and their diversity. Status 0:
    done. 1: some scenes could not be drawn; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings
    from pipelines.views.job import ViewsJob, draw_views
    from pipelines.views.settings import ViewsSettings

    count = worker_count(workers, address)
    settings = resolve_settings(ViewsSettings, "views", config, set_ or [])
    if dry_run:
        typer.echo(json.dumps(describe(ViewsJob(scenes, settings, where)), indent=2))
        return
    manifest = draw_views(scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    typer.echo(
        f"{out}: {counts['views']} of {manifest['num_scenes']} scenes drawn, features {manifest['features']}, {counts['failures']} "
        "failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)
