"""The jobs: ``python -m pipelines VERB``."""

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from stable_data.cli import SOME_FAILED, with_clear_errors
from stable_data.errors import ConfigError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, help="Jobs on tabletop scenes.")


@app.callback()
def main() -> None:
    """Jobs on tabletop scenes, in this process, on a local Ray or on a cluster."""


@app.command()
@with_clear_errors
def preprocess(
    data: Annotated[
        str, typer.Option(help="A folder in the MesaTask-10K format; every node of a cluster must see it under this path.")
    ],
    out: Annotated[str, typer.Option(help="Run folder: a path that every node sees, or a URI such as s3://bucket/prefix.")],
    config: Annotated[Path | None, typer.Option(help="TOML file; its table [preprocess] is read.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="key=value, stronger than the file; may be repeated.")] = None,
    workers: Annotated[
        int,
        typer.Option(
            help="Worker processes on a local Ray, or shards at once with --address; -1 is one a core of the machine or the "
            "cluster. 0 runs in this process, where a file that crashes or hangs its parser ends or holds the run."
        ),
    ] = -1,
    address: Annotated[str | None, typer.Option(help="An existing Ray cluster, such as auto or ray://host:10001.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the settings and the plan, and stop.")] = False,
) -> None:
    """Turn a dataset into staged, geometry-complete tables. Run again to go on where it was stopped.

    Status 0: done. 1: some scenes or assets could not be used; the table failures says which and why. 2: could not start.
    """
    from pipelines.plan import PreprocessSettings
    from pipelines.preprocess import describe_plan
    from pipelines.preprocess import preprocess as run
    from pipelines.runner import Workers
    from pipelines.settings import resolve

    if address and workers == 0:
        raise ConfigError(f"--workers 0 is this process, but --address is {address}; leave out one of them", "config_invalid")
    settings = resolve(PreprocessSettings, "preprocess", config, set_ or [])
    if dry_run:
        typer.echo(json.dumps(describe_plan(data, settings), indent=2))
        return
    count = workers if workers >= 0 else 0 if address else os.cpu_count() or 1
    manifest = run(data, out, settings, Workers(count, address))
    counts = manifest["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    typer.echo(
        f"{out}: {counts['scenes']} of {manifest['num_scenes']} scenes, {counts['assets']} of {manifest['num_assets']} assets, "
        f"{counts['warnings']} warnings, {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


if __name__ == "__main__":
    app()
