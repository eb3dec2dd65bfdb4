"""The commands ``repair``, ``import-scenes`` and ``import-tabletopgen``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from stable_data.commands.command_line import DONE, SOME_FAILED, echo, with_clear_errors
from stable_data.errors import ConfigError, cannot_write
from stable_data.importers.scenes.formats import SUFFIXES, is_gltf, is_usd

if TYPE_CHECKING:
    from pipelines.scene_files.repair import RepairOptions
    from stable_data.importers.scenes.standing import Upright

Source = Annotated[
    Path, typer.Argument(metavar="FILE|DIR", help="A scene file (MuJoCo XML, USD or glTF), or a folder of scene files.")
]
Root = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder outside of which nothing is read; default: the folder of the file. Name it if files above are included.",
    ),
]
Table = Annotated[
    str,
    typer.Option(metavar="BODY", help="Body that carries all free bodies. Default: for each free body, the surface below it."),
]
Key = Annotated[
    str,
    typer.Option(metavar="KEYFRAME", help="Keyframe of the poses, or initial. Default: home if the file has it, else initial."),
]
RepairKey = Annotated[
    str,
    typer.Option(
        "--key",
        metavar="KEYFRAME",
        help="Keyframe of the poses, initial, or all: each that the file states. Default: home if there is one, else initial.",
    ),
]
UprightMode = Annotated[
    str,
    typer.Option(
        metavar="auto|body|keep",
        help="auto: what has fallen over is put on its feet. body: the z axis of each body points up wherever it can stand so. keep: tilts "
        "stay as they are.",
    ),
]


@with_clear_errors
def repair(
    source: Source,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR|FILE",
            help="Folder for the repaired copies, each with all files that it needs; or, for a file, a new file beside it.",
        ),
    ] = None,
    in_place: Annotated[bool, typer.Option("--in-place", help="Change the files themselves.")] = False,
    root: Root = None,
    table: Table = "",
    key: RepairKey = "",
    upright: UprightMode = "auto",
    verdicts: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Table of verdicts (Parquet). Default: repair.parquet in the output folder; none with --in-place.",
        ),
    ] = None,
) -> None:
    """Repair scene files of other projects: free bodies come back upright, clean and at rest, all else stays as it is.

    For a folder, each file is repaired in a separate process.

    Status 0: all files are clean and at rest. 1: some are not, or are not usable; the lines say why. 2: could not start.
    """
    from pipelines.scene_files.folder import VERDICTS, RepairStatus, repair_folder, write_verdicts

    if (out is None) == (not in_place):
        raise ConfigError("expected a folder with --out, or --in-place; name one of them", "usage")
    folder, paths = resolve_source(source, root)
    if out is not None and out.suffix.lower() in SUFFIXES:
        raise typer.Exit(_repair_to_file(folder, paths, out, scene_options(table, key, upright), verdicts))
    if out is not None and folder.resolve() in (out.resolve(), *out.resolve().parents):
        raise ConfigError(f"{out}: is inside the folder of the scene files, expected another folder", "output_invalid")
    found = []
    for verdict in repair_folder(folder, paths, out, scene_options(table, key, upright), progress=paths is None):
        found.append(verdict)
        echo("\n".join(verdict.lines()))
    place = verdicts or (out / VERDICTS if out is not None else None)
    if place is not None:
        write_verdicts(found, place)
    counts = ", ".join(f"{n} {status}" for status in RepairStatus if (n := sum(v.status is status for v in found)))
    echo(f"{source}: {len(found)} scene files: {counts}" + (f"; {place}" if place else ""))
    if any(v.status in (RepairStatus.UNSOLVED, RepairStatus.FAILED) for v in found):
        raise typer.Exit(SOME_FAILED)


def _repair_to_file(folder: Path, paths: list[str] | None, out: Path, options: "RepairOptions", verdicts: Path | None) -> int:
    """Writes the repaired version of one file beside it; returns the exit status.

    Raises:
        ConfigError: The output is not beside the file, or poses stand in other files (``output_invalid``).
    """
    from pipelines.scene_files.folder import FileVerdict, RepairStatus, write_verdicts
    from pipelines.scene_files.repair import repair_states
    from stable_data.atomic_files import write_file_atomically
    from stable_data.importers.boundary import Boundary

    source = folder / paths[0] if paths else folder
    if paths is None or source.parent.resolve() != out.parent.resolve():
        raise ConfigError(
            f"{out}: expected a folder, or a file beside the scene file, whose names of files hold there", "output_invalid"
        )
    if source.suffix.lower() != out.suffix.lower() and (is_gltf(paths[0]) or is_gltf(out.name)):
        raise ConfigError(f"{out}: expected a file {source.suffix} like the scene file; change its name", "output_invalid")
    repairs = repair_states(Boundary(folder), paths[0], options)
    changed = repairs[-1].changed
    if len(changed) > 1 or (changed and Path(next(iter(changed))).parent != Path(paths[0]).parent):
        raise ConfigError(
            f"{out}: poses stand in {', '.join(sorted(changed))}, expected one file; name a folder", "output_invalid"
        )
    if changed and not is_usd(paths[0]) and paths[0] not in changed:
        raise ConfigError(
            f"{out}: poses stand in {next(iter(changed))} alone, expected the file itself; name a folder", "output_invalid"
        )
    try:
        write_file_atomically(out, next(iter(changed.values())) if changed else source.read_bytes())
    except OSError as error:
        raise cannot_write(str(out), error) from error
    found = [FileVerdict.of(repair) for repair in repairs]
    echo("\n".join(line for verdict in found for line in verdict.lines()))
    if verdicts is not None:
        write_verdicts(found, verdicts)
    return DONE if all(v.status in (RepairStatus.FINE, RepairStatus.REPAIRED) for v in found) else SOME_FAILED


@with_clear_errors
def import_scenes(
    source: Source,
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder or URI of the run: tables scenes, assets and meshes.")],
    root: Root = None,
    table: Table = "",
    key: Key = "",
    upright: UprightMode = "keep",
) -> None:
    """Import scene files of other projects as a run, which correct, export and the other jobs read.

    Status 0: done. 1: some files are not usable; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.scene_files.importing import import_scenes as run

    folder, paths = resolve_source(source, root)
    counts = run(folder, paths, out, scene_options(table, key, upright), progress=paths is None)
    for notice in counts.failures:
        echo(f"not imported: {notice.message}", err=True)
    echo(
        f"{out}: {counts.num_scenes} scenes of {counts.num_files} files, {counts.num_assets} assets, {len(counts.failures)} failures"
    )
    if counts.failures:
        raise typer.Exit(SOME_FAILED)


@with_clear_errors
def import_tabletopgen(
    source: Annotated[
        Path, typer.Argument(metavar="DIR", help="TabletopGen's folder output_scene, with a folder for each scene.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the dataset; empty or not there yet.")],
    tasks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Tasks that the scenes were made for, as generate --write-tasks wrote them: scene_K gets the id of the K-th. Default: "
            "scenes keep their names.",
        ),
    ] = None,
) -> None:
    """Import scenes of TabletopGen as a folder in the MesaTask-10K format, for evaluate --system files=DIR, lint and the other jobs.

    What is not on the table, or has no mesh, is left out with a warning.

    Status 0: done. 1: some scenes are not usable; the lines say why. 2: could not start.
    """
    from pipelines.scene_files.tabletopgen import import_tabletopgen as run

    made = run(source, out, tasks, progress=True)
    for notice in made.warnings:
        echo(f"warning: {notice.message}", err=True)
    for notice in made.failures:
        echo(f"not imported: {notice.message}", err=True)
    echo(f"{out}: {made.num_scenes} scenes, {len(made.warnings)} warnings, {len(made.failures)} failures")
    if made.failures:
        raise typer.Exit(SOME_FAILED)


def resolve_source(source: Path, root: Path | None) -> tuple[Path, list[str] | None]:
    """The source folder, and the file in it; None for all its files.

    Raises:
        ConfigError: The source does not exist (``source_missing``), or the file is not in the folder (``path_outside``).
    """
    if source.is_dir():
        if root is not None:
            raise ConfigError(f"--root is for a single file, but {source} is a folder; leave it out", "usage")
        return source, None
    if not source.is_file():
        raise ConfigError(
            f"{source}: does not exist, expected a scene file or a folder of scene files; check the path", "source_missing"
        )
    folder = source.parent if root is None else root
    try:
        return folder, [source.resolve().relative_to(folder.resolve()).as_posix()]
    except ValueError as error:
        raise ConfigError(
            f"{source}: is not in {folder}, expected a folder that contains it; change --root", "path_outside"
        ) from error


def scene_options(table: str, key: str, upright: str) -> "RepairOptions":
    """What the user says about scene files.

    Raises:
        ConfigError: ``upright`` is not known (``usage``).
    """
    from pipelines.scene_files.repair import RepairOptions

    if upright not in ("auto", "body", "keep"):
        raise ConfigError(f"--upright is {upright!r}, expected auto, body or keep", "usage")
    return RepairOptions(table, key, cast("Upright", upright))
