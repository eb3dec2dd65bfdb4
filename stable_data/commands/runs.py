"""Commands on the content of runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stable_data.commands.command_line import echo, with_clear_errors
from stable_data.commands.exports import export_lance, export_scenes
from stable_data.errors import ConfigError

if TYPE_CHECKING:
    from stable_data.storage.run_folder import RunFolder

app = typer.Typer()
_PANEL = "Look at runs, select and change them"


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def inspect(run: Annotated[str, typer.Argument(metavar="RUN", help="A run: folder or URI.")]) -> None:
    """Print the content of a run: its manifest, its tables and their numbers of rows."""
    import json

    from stable_data.storage.manifest import MANIFEST
    from stable_data.storage.run_folder import RunFolder
    from stable_data.storage.schemas import SCHEMAS

    folder = RunFolder(run)
    try:
        document = folder.read_document(MANIFEST)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{run}/manifest.json: {error}; is this the folder of a run?", "manifest_invalid") from error
    if document is None:
        raise ConfigError(f"{run}: no manifest.json, expected the folder of a run; was preprocess run into it?", "not_a_run")
    echo(json.dumps(document, indent=2, ensure_ascii=False))
    for name in SCHEMAS:
        files = folder.files(name)
        if files:
            echo(f"{name:<10} {folder.num_rows(name):>8} rows in {len(files)} files")


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def query(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run: folder or URI.")],
    where: Annotated[
        str, typer.Argument(metavar="WHERE", help='Condition on scenes, for example "clean and num_stacked >= 2".')
    ],
    to: Annotated[str | None, typer.Option(help="Folder or URI for a run of the selected scenes and their assets.")] = None,
    format_name: Annotated[
        str | None,
        typer.Option("--format", help="With --to: write the scenes as export --cached does, in one of its formats."),
    ] = None,
) -> None:
    """Count the scenes of a run that satisfy a condition, or write them to a new run or as files of another format.

    Conditions compare columns of the table scenes with constants and are joined by and, or and not. An unknown value satisfies
    only is None: "aws is None or aws >= 1".
    """
    from stable_data.storage.run_folder import RunFolder
    from stable_data.storage.subset import count_selected, select
    from stable_data.storage.table_scan import TableScan

    folder = RunFolder(run)
    if format_name is not None:
        if to is None:
            raise ConfigError("--format needs a folder for the files; name it with --to", "usage")
        if "://" in to:
            raise ConfigError(f"--to is {to}, but --format writes to a local folder; name a folder", "usage")
        TableScan(folder, "scenes", where)  # refuses an invalid condition before anything is written
        if format_name == "lance":
            export_lance(folder, Path(to), where)
            return
        if format_name == "lerobot":
            raise ConfigError(
                "--format lerobot writes episodes, not scenes: stable-data export RUN OUT --format lerobot", "usage"
            )
        from stable_data.simulation.run_reader import SceneSelection

        export_scenes(folder, Path(to), format_name, SceneSelection(where), is_cached=True)
        return
    if to is None:
        found, total = count_selected(folder, where)
        echo(f"{run}: {found} of {total} scenes")
        return
    target = RunFolder(to)
    TableScan(folder, "scenes", where)  # refuses an invalid condition before anything is written
    _refuse_within(target, [folder])
    with target.locked():
        counts = select(folder, where, target)
    echo(f"{to}: {counts['scenes']} of {folder.num_rows('scenes')} scenes, {counts.get('assets', 0)} assets")


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def join(
    runs: Annotated[list[str], typer.Argument(metavar="RUN...", help="Runs with the table scenes: folders or URIs.")],
    to: Annotated[str, typer.Option(metavar="OUT", help="Folder or URI of the joined run.")],
    where: Annotated[str, typer.Option(help='Only scenes that satisfy this, for example "clean".')] = "scene_id is not None",
) -> None:
    """Join runs to one run: each scene, asset and texture once. A scene that is in several runs is that of the first one."""
    from stable_data.storage.manifest import read_manifest
    from stable_data.storage.run_folder import RunFolder
    from stable_data.storage.subset import select

    first, *others = map(RunFolder, runs)
    target = RunFolder(to)
    _refuse_within(target, [first, *others])
    with target.locked():
        counts = select(first, where, target, others)
    doubles = (read_manifest(target) or {}).get("doubles", {"scenes": 0, "different": 0})
    echo(f"{to}: {counts['scenes']} scenes, {counts.get('assets', 0)} assets; {doubles['scenes']} scenes were in several runs")
    if doubles["different"]:
        echo(f"{doubles['different']} of these differ between the runs; those of the first run were taken", err=True)


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def prune(run: Annotated[str, typer.Argument(metavar="RUN", help="A complete run of generate: folder or URI.")]) -> None:
    """Delete the rejected scenes of a run, and the assets and textures that no accepted scene uses. This cannot be undone."""
    from stable_data.storage import run_changes
    from stable_data.storage.run_folder import RunFolder

    deleted = run_changes.prune(RunFolder(run))
    echo(f"{run}: deleted " + ", ".join(f"{count} rows of {table}" for table, count in deleted.items()))


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def upgrade(run: Annotated[str, typer.Argument(metavar="RUN", help="A run of an older version: folder or URI.")]) -> None:
    """Bring the tables of a run of an older version up to date, in its folder. What did not exist then is null: unknown."""
    from stable_data.storage import run_changes
    from stable_data.storage.run_folder import RunFolder

    echo(f"{run}: {run_changes.upgrade(RunFolder(run))}")


def _refuse_within(target: "RunFolder", runs: Sequence["RunFolder"]) -> None:
    """Refuses a target that is one of some runs, or within one.

    Raises:
        ConfigError: It is (``usage``).
    """
    if any(f"{target.root}/".startswith(f"{run.root}/") for run in runs):
        raise ConfigError(f"--to is {target.uri}, which is one of the runs or within one; name a new folder", "usage")
