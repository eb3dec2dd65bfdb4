"""Commands that make scenes of the embedded world, and edits."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from stable_data.commands.checkout import run_pipelines
from stable_data.commands.command_line import SOME_FAILED, Address, echo, with_clear_errors
from stable_data.errors import SceneError

if TYPE_CHECKING:
    from tqdm import tqdm

    from stable_data.embedded_world import EmbeddedWorld

app = typer.Typer()
_PANEL = "Make scenes"


SynthOut = Annotated[
    Path, typer.Argument(metavar="OUT", help="Output folder, in the MesaTask-10K format; run again to continue.")
]
NumScenes = Annotated[int, typer.Option("--scenes", help="Number of scenes.")]
Seed = Annotated[int, typer.Option(help="Random seed; scene k depends only on the seed and on k.")]
Tables = Annotated[list[str] | None, typer.Option("--table", help="Kind of table; may be repeated. Default: all kinds.")]
Edits = Annotated[bool, typer.Option("--edits", help="Also make one edit per scene: an instruction and the edited scene.")]
Pictures = Annotated[bool, typer.Option(help="Render front.png of every scene.")]
WholeLibrary = Annotated[bool, typer.Option("--whole-library", help="Write all assets, not only those in the scenes.")]


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def synth(
    out: SynthOut,
    scenes: NumScenes = 24,
    seed: Seed = 0,
    table: Tables = None,
    edits: Edits = False,
    pictures: Pictures = True,
    whole_library: WholeLibrary = False,
    workers: Annotated[int, typer.Option(help="Number of worker processes on a local Ray; 0: work in this process.")] = 0,
    address: Address = None,
) -> None:
    """Make scenes of the embedded world: parametric assets, clean scenes at rest, and tasks; no download.

    Status 0: done. 1: some scenes could not be made; synth_failures lists the reasons. 2: could not start.
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
    """Creates the progress bar of scene synthesis."""
    from tqdm import tqdm

    return tqdm(total=total, desc="synth", unit="scene")


def tell_world(out: Path, num_scenes: int, failures: Sequence[SceneError]) -> None:
    """Prints the number of scenes made, and exits with status 1 if some could not be made."""
    for error in failures:
        echo(f"not made: {error}", err=True)
    echo(
        f"{out}: {num_scenes - len(failures)} of {num_scenes} scenes made, {len(failures)} failed; README.md describes the set"
    )
    if failures:
        raise typer.Exit(SOME_FAILED)


def _on_ray(out: Path, scenes: int, world: "EmbeddedWorld", workers: int, address: str | None) -> int:
    """Runs ``python -m pipelines synth``, because this package does not depend on Ray; returns its exit status."""
    command = ["synth", str(out), "--scenes", str(scenes), "--seed", str(world.seed)]
    command += [part for table in world.tables for part in ("--table", table)]
    command += ["--edits"] * world.edits + ["--whole-library"] * world.whole_library
    command += ["--pictures" if world.pictures else "--no-pictures"]
    command += ["--workers", str(workers)] * bool(workers) + (["--address", address] if address else [])
    return run_pipelines(command)


@app.command("draft-edits", rich_help_panel=_PANEL)
@with_clear_errors
def draft_edits(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with scenes of the embedded world; folder or URI.")],
    out: Annotated[
        str | None, typer.Argument(metavar="OUT", help="Folder for the table edits; default: the run itself.")
    ] = None,
    per_scene: Annotated[int, typer.Option(min=1, help="Edits per scene, of each kind in turn.")] = 4,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed; the edits of a scene depend only on the seed and on the scene.")
    ] = 0,
) -> None:
    """Draft training edits for the scenes of a run, in the table edits; run again to continue.

    The edits are neither simulated nor audited; synth --edits makes edits that are. Status 0: done. 1: some scenes are not of the
    embedded world; they are listed. 2: could not start.
    """
    from stable_data.embedded_world.edit_table import record_edits, write_edits
    from stable_data.storage.run_folder import RunFolder

    source, target = RunFolder(run), RunFolder(out or run)
    num_edits, failures = 0, []
    with target.locked():
        for count, failed in write_edits(source, target, per_scene, seed):
            num_edits += count
            failures += failed
        record_edits(source, target, per_scene, seed)
    for error in failures:
        echo(f"no edits: {error}", err=True)
    echo(
        f"{target.uri}: {num_edits} edits added, {len(failures)} scenes without edits; {target.num_rows('edits')} rows in total"
    )
    if failures:
        raise typer.Exit(SOME_FAILED)
