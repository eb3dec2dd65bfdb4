"""What the verbs of all jobs share on the command line."""

import os
from typing import Annotated

import typer

from stable_data.errors import ConfigError

SETTINGS_HINT = "python -m pipelines settings {} lists every key of --set and of the file with its default, unit and meaning."
"""Last line of a verb's help; its gap is the verb."""

RunOut = Annotated[str, typer.Option(help="Run folder: a path that every node sees, or a URI such as s3://bucket/prefix.")]
NumWorkers = Annotated[
    int,
    typer.Option(
        help="Worker processes on a local Ray, or shards at once with --address. -1: one for each core. 0: this process."
    ),
]
JobSettings = Annotated[list[str] | None, typer.Option("--set", help="key=value, overrides the file; may be repeated.")]
RunOfScenes = Annotated[
    str,
    typer.Option(help="A run with the tables scenes, assets and meshes, such as one of generate; every node must see it."),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the settings and the plan, and stop.")]


def worker_count(workers: int, address: str | None) -> int:
    """Returns the number of workers of ``--workers`` and ``--address``; -1 is one for each core, of the cluster if there is one.

    Raises:
        ConfigError: The options contradict each other (``config_invalid``).
    """
    if address and workers == 0:
        raise ConfigError(f"--workers 0 is this process, but --address is {address}; leave out one of them", "config_invalid")
    return workers if workers >= 0 else 0 if address else os.cpu_count() or 1
