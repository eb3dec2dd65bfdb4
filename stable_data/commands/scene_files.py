"""Commands on assets and scene files of other projects, which are Ray jobs of a checkout."""

from typing import Annotated

import typer

from stable_data.commands.checkout import run_pipelines
from stable_data.commands.command_line import with_clear_errors

app = typer.Typer()
_PANEL = "Assets and scene files of other projects"


_PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


@app.command("import", rich_help_panel=_PANEL, context_settings=_PASSED_ON)
@with_clear_errors
def import_(
    context: typer.Context,
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="mesh, sdformat, urdf, mjcf, usd, scenes or tabletopgen.")
    ] = "--help",
) -> None:
    """Make a library of the assets in a folder: import KIND DIR --out LIBRARY. Or a run of scene files: import scenes FILE|DIR --out RUN.

    Or a dataset of what TabletopGen has made: import tabletopgen DIR --out DIR. import --help and import KIND --help list the options.
    """
    verb = [f"import-{kind}"] if kind in ("scenes", "tabletopgen") else ["import", kind]
    raise typer.Exit(run_pipelines([*verb, *context.args]))


@app.command(rich_help_panel=_PANEL, context_settings=_PASSED_ON)
@with_clear_errors
def repair(context: typer.Context) -> None:
    """Repair scene files of other projects: stable-data repair FILE|DIR --out DIR; repair --help lists the options."""
    raise typer.Exit(run_pipelines(["repair", *context.args]))


@app.command(rich_help_panel=_PANEL, context_settings=_PASSED_ON)
@with_clear_errors
def supports(context: typer.Context) -> None:
    """Find the surfaces of furniture, for scenes on them: supports LIBRARY --out RUN; supports --help lists the options."""
    raise typer.Exit(run_pipelines(["supports", *context.args]))
