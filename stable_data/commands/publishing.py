"""Commands that verify and publish runs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, cast

import typer

from stable_data.commands.command_line import SOME_FAILED, echo, with_clear_errors
from stable_data.errors import ConfigError

if TYPE_CHECKING:
    from stable_data.verification.verifier import Verdicts

app = typer.Typer()
_PANEL = "Verify and publish runs"
_ASSETS = "Folder in the MesaTask-10K format, or run, with the meshes of a run that has none: correct made it of a folder."


@app.command(rich_help_panel=_PANEL)
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
    assets: Annotated[str | None, typer.Option(metavar="PLACE", help=_ASSETS)] = None,
    quiet: Annotated[bool, typer.Option(help="Show no progress bar.")] = False,
) -> None:
    """Check whether a run is whole: manifest, checksums, rows, ids, references, and a sample of the verdicts. One line for each finding.

    Status 0: whole. 1: damaged, not finished, or something cannot be known; the last line says which. 2: there is no run.
    """
    from stable_data.storage.run_folder import RunFolder
    from stable_data.verification.evaluation_folder import is_evaluation, verify_evaluation
    from stable_data.verification.verifier import VerifyOptions, verify_run

    folder = RunFolder(run)
    options = VerifyOptions(sample, seed, _verdicts(verdicts), None if source is None else RunFolder(source), assets)
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


@app.command(rich_help_panel=_PANEL)
@with_clear_errors
def publish(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A complete run: folder or URI.")],
    out: Annotated[str, typer.Argument(metavar="OUT", help="New local folder, which a dataset hub takes as it is.")],
    title: Annotated[str, typer.Option(help="Title of the dataset. Default: the name of the run.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the rows themselves, such as CC-BY-4.0. Default: not stated.")] = "",
    url: Annotated[str, typer.Option(help="Where the dataset will be, for its metadata.")] = "",
    creator: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="A person who made the dataset, for its metadata; may be repeated.")
    ] = None,
    organization: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="An organization that made the dataset; may be repeated.")
    ] = None,
    citation: Annotated[str, typer.Option(help="How to cite the dataset, for its card and its metadata.")] = "",
    dataset_version: Annotated[
        str,
        typer.Option(metavar="X.Y.Z", help="Version of the dataset, for its metadata: raise it where you publish a run again."),
    ] = "1.0.0",
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
    assets: Annotated[str | None, typer.Option(metavar="PLACE", help=_ASSETS)] = None,
    quiet: Annotated[bool, typer.Option(help="Show no progress bar.")] = False,
) -> None:
    """Write a run as a dataset: card, Parquet by split, pictures, schemas, licences of assets, Croissant metadata. It is verified first.

    Status 0: done. 2: refused or could not start; nothing is written.
    """
    from stable_data.publishing.publisher import PublishOptions
    from stable_data.publishing.publisher import publish as write
    from stable_data.storage.run_folder import RunFolder
    from stable_data.verification.verifier import VerifyOptions

    verify_options = VerifyOptions(sample, verdicts=_verdicts(verdicts), assets=assets)
    options = PublishOptions(
        title,
        licence,
        url,
        tuple(creator or ()),
        tuple(organization or ()),
        citation,
        dataset_version,
        allow_unknown_licences,
        allow_no_derivatives,
        unverified,
        verify_options,
    )
    with files_bar(quiet=quiet) as show:
        found = write(RunFolder(run), out, options, lambda finding: echo(str(finding), err=True), show)
    for name in found.left_out:
        echo(f"left out: table {name} is none of this library", err=True)
    if found.missing:
        options_of = {"creator": "--creator or --organization", "url": "--url"}
        said = " and ".join(f"{name} ({options_of[name]})" for name in found.missing)
        echo(f"croissant.json lacks {said}, which Croissant 1.0 requires", err=True)
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
