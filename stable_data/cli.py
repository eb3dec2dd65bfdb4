"""The command line of the library: ``stable-data VERB``."""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn, ParamSpec, TypeVar

import typer

from stable_data.errors import ConfigError, SceneError, StableDataError

if TYPE_CHECKING:
    from tqdm import tqdm

    from stable_data.embedded_world import EmbeddedWorld

P = ParamSpec("P")
R = TypeVar("R")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Tabletop scenes as data. Jobs on Ray (preprocess, generate, correct, ...) are `python -m pipelines` in a checkout.",
)

DONE, SOME_FAILED, NOT_STARTED, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses: all well; some items failed, all accounted for; could not start or go on; Ctrl-C."""

DEBUG = "STABLE_DATA_DEBUG"
"""Environment variable: where it is set, an error ends a command with its traceback."""

EXTRA_OF_MODULE = {
    **dict.fromkeys(("fast_simplification", "fcl", "igl", "manifold3d", "networkx", "scipy"), "geometry,sim"),
    **dict.fromkeys(("shapely", "threadpoolctl", "trimesh", "vhacdx", "mujoco", "PIL", "OpenGL"), "geometry,sim"),
    "torch": "torch",
    **dict.fromkeys(("peft", "safetensors", "tensorboard", "transformers"), "geometry,models"),
    **dict.fromkeys(("jsonschema", "ray"), "geometry,sim,pipelines"),
}
"""What to install where a module is missing: all that the commands which import it need, so that it is asked for once."""


def with_clear_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Ends a command with one line and status 2 where it cannot start or go on."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise  # an end that was meant, or a reader such as `head` that has seen enough
        except KeyboardInterrupt as error:
            typer.echo("interrupted; what is in place stays", err=True)
            raise typer.Exit(INTERRUPTED) from error
        except Exception as error:  # the outermost level: nobody is helped by a traceback that they did not ask for
            if os.environ.get(DEBUG):
                raise
            typer.echo(f"error: {_line(error)}", err=True)
            raise typer.Exit(NOT_STARTED) from error

    return run


def _line(error: Exception) -> str:
    """What a person is told of an error."""
    if isinstance(error, StableDataError):
        return str(error)
    missing = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if extra := EXTRA_OF_MODULE.get(missing):
        return f"needs stable-data[{extra}], but {missing} is not installed: pip install '.[{extra}]' in a checkout"
    found = str(error).strip().partition("\n")[0]
    return f"unexpected {type(error).__name__}: {found}; please report it with what {DEBUG}=1 shows"


@app.callback()
def main() -> None:
    """Tabletop scenes as data: read, audit, look at, export."""


SynthOut = Annotated[Path, typer.Argument(help="Folder to write, in the MesaTask-10K format; run again to go on.")]
NumScenes = Annotated[int, typer.Option("--scenes", help="How many scenes.")]
Seed = Annotated[int, typer.Option(help="Scene k depends on the seed and k alone.")]
Tables = Annotated[list[str] | None, typer.Option("--table", help="Kind of table; may be repeated. All kinds by default.")]
Edits = Annotated[bool, typer.Option("--edits", help="An edit of every scene too: an instruction and the scene afterwards.")]
Pictures = Annotated[bool, typer.Option(help="Draw front.png of every scene.")]
WholeLibrary = Annotated[bool, typer.Option("--whole-library", help="Write all assets, not only those that the scenes use.")]
Address = Annotated[str | None, typer.Option(help="An existing Ray cluster, such as auto or ray://host:10001.")]


@app.command()
@with_clear_errors
def synth(
    out: SynthOut,
    scenes: NumScenes = 24,
    seed: Seed = 0,
    table: Tables = None,
    edits: Edits = False,
    pictures: Pictures = True,
    whole_library: WholeLibrary = False,
    workers: Annotated[int, typer.Option(help="Worker processes on a local Ray; 0 works in this process.")] = 0,
    address: Address = None,
) -> None:
    """Make a set of the embedded world: parametric assets and scenes at rest, clean, with tasks; no download.

    Status 0: done. 1: some scenes could not be made; synth_failures says why. 2: could not start.
    """
    from stable_data.embedded_world import EmbeddedWorld, write_world

    world = EmbeddedWorld(seed, tuple(table or ()), pictures, edits, whole_library)
    if workers or address:
        raise typer.Exit(_on_ray(out, scenes, world, workers, address))
    with tqdm_bar(scenes) as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        failures = write_world(out, scenes, world, show)
    tell_world(out, scenes, failures)


def tqdm_bar(total: int) -> "tqdm[NoReturn]":
    """The progress of making scenes."""
    from tqdm import tqdm

    return tqdm(total=total, desc="synth", unit="scene")


def tell_world(out: Path, num_scenes: int, failures: Sequence[SceneError]) -> None:
    """Says what was made, and ends with status 1 where something could not be."""
    for error in failures:
        typer.echo(f"not made: {error}", err=True)
    typer.echo(f"{out}: {num_scenes - len(failures)} of {num_scenes} scenes, {len(failures)} not made; README.md is its card")
    if failures:
        raise typer.Exit(SOME_FAILED)


def _on_ray(out: Path, scenes: int, world: "EmbeddedWorld", workers: int, address: str | None) -> int:
    """Hands over to ``python -m pipelines synth``, for Ray is not this package's; gives its exit status."""
    checkout = Path(__file__).resolve().parents[1]
    if not (checkout / "pipelines").is_dir():
        raise ConfigError(
            "--workers and --address need a checkout, for pipelines/ is not installed; run it there", "no_pipelines"
        )
    command = [sys.executable, "-m", "pipelines", "synth", str(out), "--scenes", str(scenes), "--seed", str(world.seed)]
    command += [part for table in world.tables for part in ("--table", table)]
    command += ["--edits"] * world.edits + ["--whole-library"] * world.whole_library
    command += ["--pictures" if world.pictures else "--no-pictures"]
    command += ["--workers", str(workers)] * bool(workers) + (["--address", address] if address else [])
    path = os.pathsep.join([str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(command, check=False, env=os.environ | {"PYTHONPATH": path}).returncode


@app.command("draft-edits")
@with_clear_errors
def draft_edits(
    run: Annotated[str, typer.Argument(help="A run over the embedded world, with its scenes; a folder or its URI.")],
    out: Annotated[str | None, typer.Argument(help="Folder to write the table edits in; the run's own by default.")] = None,
    per_scene: Annotated[int, typer.Option(min=1, help="Edits a scene; the kinds take turns.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="A scene's edits depend on the seed and the scene alone.")] = 0,
) -> None:
    """Draft edits of the scenes of a run, to train on: the table edits; run again to go on.

    Nothing is settled or judged: synth --edits makes edits that are. Status 0: done. 1: some scenes are not of the embedded
    world; they are listed. 2: could not start.
    """
    from stable_data.embedded_world.edit_table import write_edits
    from stable_data.storage.run_folder import RunFolder

    source, target = RunFolder(run), RunFolder(out or run)
    num_edits, failures = 0, []
    with target.locked():
        for count, failed in write_edits(source, target, per_scene, seed):
            num_edits += count
            failures += failed
    for error in failures:
        typer.echo(f"no edits: {error}", err=True)
    typer.echo(f"{target.uri}: {num_edits} edits added, {len(failures)} scenes without; {target.num_rows('edits')} rows in all")
    if failures:
        raise typer.Exit(SOME_FAILED)


@app.command()
@with_clear_errors
def lint(
    folder: Annotated[Path, typer.Argument(help="A folder in the MesaTask-10K format.")],
    table: Annotated[Path | None, typer.Option(help="Where to write one row a scene (Parquet).")] = None,
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
) -> None:
    """Audit every scene exactly: collisions with depth, floating, sunk, out of bounds.

    Runs in this process: a file that crashes its parser ends it. Status 0: every scene could be read and judged. 1: some could
    not; they are listed.
    """
    from stable_data.mesatask.lint import lint_folder, prepare_place

    if table is not None:
        prepare_place(table)
    result = lint_folder(folder, progress=not quiet and sys.stderr.isatty())
    typer.echo(str(result))
    if table is not None:
        result.write(table)
    if result.failures:
        raise typer.Exit(SOME_FAILED)


@app.command()
@with_clear_errors
def inspect(run: Annotated[str, typer.Argument(help="A run folder or its URI.")]) -> None:
    """Say what a run folder holds: its tables, rows, settings and failures."""
    from stable_data.storage.run_folder import RunFolder
    from stable_data.storage.schemas import SCHEMAS

    folder = RunFolder(run)
    content = folder.read_bytes("manifest.json")
    if content is None:
        raise ConfigError(f"{run}: no manifest.json, expected the folder of a run; was preprocess run into it?", "not_a_run")
    typer.echo(content.decode())
    for name in SCHEMAS:
        files = folder.files(name)
        if files:
            typer.echo(f"{name:<10} {folder.num_rows(name):>8} rows in {len(files)} files")


@app.command()
@with_clear_errors
def query(
    run: Annotated[str, typer.Argument(help="A run folder or its URI.")],
    where: Annotated[str, typer.Argument(help='Which scenes, such as "clean and num_stacked >= 2".')],
    to: Annotated[str | None, typer.Option(help="Folder or URI to write them to, with all that belongs to them.")] = None,
) -> None:
    """Count the scenes of a run that a condition takes, or write them to a run of their own.

    Conditions compare columns of the table scenes with constants and are joined by and, or and not. What is unknown passes
    none, unless it is asked for: "aws is None or aws >= 1".
    """
    from stable_data.storage.run_folder import RunFolder
    from stable_data.storage.subset import count_selected, select

    folder = RunFolder(run)
    if to is None:
        found, total = count_selected(folder, where)
        typer.echo(f"{run}: {found} of {total} scenes")
        return
    target = RunFolder(to)
    count_selected(folder, where)  # refuses what is no condition before anything is written
    with target.locked():
        counts = select(folder, where, target)
    typer.echo(f"{to}: {counts['scenes']} of {folder.num_rows('scenes')} scenes, {counts.get('assets', 0)} assets")


@app.command()
@with_clear_errors
def export(
    run: Annotated[str, typer.Argument(help="A run folder or its URI, with the tables scenes, assets and meshes.")],
    out: Annotated[Path, typer.Argument(help="Folder to write; run again to go on.")],
    format_name: Annotated[str, typer.Option("--format", help="Such as mjcf, glb or mesatask.")],
    where: Annotated[str | None, typer.Option(help='Which scenes, such as "clean and num_stacked >= 2".')] = None,
    scene: Annotated[list[str] | None, typer.Option("--scene", help="This scene; may be repeated.")] = None,
    limit: Annotated[int | None, typer.Option(min=0, help="The first so many of them.")] = None,
    settled: Annotated[bool, typer.Option(help="Objects where the physics engine left them (table settled).")] = False,
) -> None:
    """Write scenes of a run in another format, each at once with all that it needs.

    Status 0: done. 1: some scenes could not be exported; they are listed. 2: could not start.
    """
    from tqdm import tqdm

    from stable_data.export.exporter import export_run
    from stable_data.simulation.run_reader import SceneSelection
    from stable_data.storage.run_folder import RunFolder

    with tqdm(desc="export", unit="scene", disable=None) as bar:

        def show(done: int, total: int, num_failed: int) -> None:
            bar.total = total
            bar.update(done - bar.n)
            bar.set_postfix_str(f"{num_failed} failed" if num_failed else "", refresh=False)

        result = export_run(RunFolder(run), out, format_name, SceneSelection(where, tuple(scene or ()), limit, settled), show)
    for line in result.failures:
        typer.echo(f"not exported: {line}", err=True)
    typer.echo(
        f"{out}: {result.made + result.there} of {result.total} scenes as {format_name}, {result.there} of them were there; "
        "README.md says how to open them" + (f"; {result.boxes} objects have no mesh and are boxes" if result.boxes else "")
    )
    if result.failures:
        raise typer.Exit(SOME_FAILED)


@app.command()
@with_clear_errors
def schemas(folder: Annotated[Path, typer.Argument(help="Where to write them.")] = Path("schemas")) -> None:
    """Write the contracts: JSON Schemas and the columns of every table."""
    from stable_data.storage.json_schemas import write_contracts

    write_contracts(folder)
