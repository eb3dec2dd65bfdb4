"""The command line of the rate job."""

import json
from pathlib import Path
from typing import Annotated

import typer

from pipelines.job_options import DryRun, JobSettings, NumWorkers, RunOut, worker_count
from stable_data.cli import SOME_FAILED, Address, with_clear_errors


@with_clear_errors
def rate(
    scenes: Annotated[
        str,
        typer.Option(
            help="A run with the tables scenes, assets and meshes, such as one of generate or preprocess; every node must see it."
        ),
    ],
    out: RunOut,
    where: Annotated[str, typer.Option(help="Which scenes, such as \"split == 'test'\".")] = "",
    judge: Annotated[
        str | None,
        typer.Option(
            help="symbolic (rules on the geometry), or openai:MODEL, a model that sees pictures (--set rating.http.base_url=URL, and "
            "rating.http.key_variable=NAME of the variable that holds the key); overrides the file. Default: symbolic."
        ),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table rate is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Rate scenes by the five criteria of the paper's GPT-score. Run again to continue after a stop.

    The table ratings has a row for each scene: the scores with their rationales, their average, and whether the scene passes (clean
    with an average above 7). What cannot be scored is null, with a code and the reason. Status 0: done. 1: some scenes could not be
    used; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.rate.job import RateJob
    from pipelines.rate.job import rate as run
    from pipelines.rate.settings import RateSettings
    from pipelines.settings import resolve_settings
    from stable_data.rating.criteria import KEYS

    count = worker_count(workers, address)
    asked = [f"rating.judge={json.dumps(judge)}"] if judge is not None else []
    settings = resolve_settings(RateSettings, "rate", config, [*(set_ or []), *asked])
    if dry_run:
        typer.echo(json.dumps(describe(RateJob(scenes, settings, where)), indent=2))
        return
    manifest = run(scenes, out, settings, WorkerPool(count, address), where=where)
    counts = manifest["counts"]
    unknown = ", ".join(f"{code} {n}" for code, n in counts["unknown_by_code"].items())
    means = ", ".join(f"{key.upper()} {counts['averages'][key]:.1f}" for key in KEYS if key in counts["averages"])
    average = "unknown" if counts["average"] is None else f"{counts['average']:.1f}"
    num_unknown = counts["ratings"] - counts["rated"]
    typer.echo(
        f"{out}: {counts['judge']} rated {counts['rated']} of {manifest['num_scenes']} scenes, average {average}"
        f"{f' ({means})' if means else ''}; {counts['passed']} of {counts['passes_known']} pass; {num_unknown} unknown"
        f"{f' ({unknown})' if unknown else ''}, {counts['failures']} failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)
