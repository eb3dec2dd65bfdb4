"""The jobs: ``python -m pipelines VERB``."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from models.baselines.systems import SYSTEMS
from pipelines.evaluation_commands import evaluate, rate, views
from pipelines.job_options import SETTINGS_HINT, DryRun, JobSettings, NumWorkers, RunOut, worker_count
from pipelines.retired import CommandGroup
from pipelines.robot_commands import demonstrate, evaluate_policy, reach
from pipelines.scene_files import commands as scene_files
from pipelines.supports.commands import supports
from pipelines.training_commands import app as training
from stable_data.commands.command_line import SOME_FAILED, Address, echo, with_clear_errors
from stable_data.commands.worlds import Edits, NumScenes, Pictures, Seed, SynthOut, Tables, WholeLibrary, tell_world, tqdm_bar
from stable_data.errors import ConfigError

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Jobs on tabletop scenes.",
)
app.add_typer(training)

Kind = Annotated[
    str,
    typer.Argument(metavar="KIND", help="Format of the files: mesh, sdformat, urdf, mjcf or usd (docs/import.md)."),
]
SourceFolder = Annotated[
    str, typer.Argument(metavar="DIR", help="Source folder, as its authors ship it; nothing outside is read.")
]
LibraryOut = Annotated[
    str, typer.Option(metavar="LIBRARY", help="Run folder for the library, outside of DIR; --assets takes it.")
]
Preset = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="For mesh, the layout of a known set: objaverse, graspnet_infinite, graspnet, ycb, kaykit or sweethome3d.",
    ),
]
Manifest = Annotated[
    str,
    typer.Option(
        metavar="FILE", help="For mesh, a CSV or JSONL file in DIR with a row for each asset; docs/import.md lists its columns."
    ),
]
Licence = Annotated[
    str,
    typer.Option(
        metavar="NAME", help="Licence of assets whose source names no known one, such as CC-BY-4.0; else they are refused."
    ),
]
AllowedLicence = Annotated[
    list[str] | None,
    typer.Option(
        "--allow-licence", metavar="NAME", help="Also take assets of this licence, such as CC-BY-NC-4.0; may be repeated."
    ),
]
Scenes = Annotated[
    str, typer.Option(help="A folder in the MesaTask-10K format, or a run with a table scenes; every node must see it.")
]
Assets = Annotated[
    list[str] | None,
    typer.Option(
        help="A run or a folder in the MesaTask-10K format to take assets from; real: the 93 real meshes in the repository; or embedded: "
        "the embedded world's library, which is made if it is missing. May be repeated: libraries are searched in order "
        "for the wanted thing. Default: embedded."
    ),
]
EditAssets = Annotated[
    list[str] | None,
    typer.Option(
        "--assets",
        help="A folder in the MesaTask-10K format, a run, real (the real meshes in the repository), or embedded (the embedded world's "
        "library, which is made if it is missing), "
        "to take assets from that the scenes' own library lacks. May be repeated: libraries are searched in order, after that of "
        "the scenes. Default: embedded. none: only the scenes' own library.",
    ),
]


@app.callback()
def main() -> None:
    """Jobs on tabletop scenes, in this process, on a local Ray or on a cluster."""


@app.command("import", epilog=SETTINGS_HINT.format("import"))
@with_clear_errors
def import_assets(
    kind: Kind,
    folder: SourceFolder,
    out: LibraryOut,
    preset: Preset = "",
    manifest: Manifest = "",
    licence: Licence = "",
    allow_licence: AllowedLicence = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table import is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Make a library of the assets in a folder, with scale, mass, resting poses, colliders, textures and licence.

    Run again to continue after a stop.

    Status 0: all assets are usable. 1: some were refused; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.asset_import.job import ImportJob
    from pipelines.asset_import.job import import_assets as run
    from pipelines.asset_import.settings import ImportSettings
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings

    count = worker_count(workers, address)
    given = {"preset": preset, "manifest": manifest, "licence": licence, "licences": allow_licence}
    asked = [f"{key}={json.dumps(value)}" for key, value in given.items() if value]
    settings = resolve_settings(ImportSettings, "import", config, [*(set_ or []), *asked])
    if dry_run:
        echo(json.dumps(describe(ImportJob(kind, folder, settings)), indent=2))
        return
    manifest_ = run(kind, folder, out, settings, WorkerPool(count, address))
    counts = manifest_["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    echo(
        f"{out}: {counts['assets']} of {manifest_['num_assets']} assets, {counts['textures']} textures, {counts['warnings']} warnings, "
        f"{counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    if counts["failures_by_code"].keys() & {"licence_refused", "licence_unknown", "licence_conflict"}:
        echo(
            "assets were refused for their licence (table failures): --licence NAME states one that the source does not name, "
            "--allow-licence NAME allows a further one; use a new --out",
            err=True,
        )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@app.command(epilog=SETTINGS_HINT.format("preprocess"))
@with_clear_errors
def preprocess(
    data: Annotated[
        str, typer.Option(help="A folder in the MesaTask-10K format; every node of a cluster must see it under this path.")
    ],
    out: RunOut,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table preprocess is read.")] = None,
    set_: JobSettings = None,
    workers: Annotated[
        int,
        typer.Option(
            help="Worker processes on a local Ray, or shards at once with --address; -1: one for each core of the machine or "
            "the cluster. 0: this process; a file that crashes or blocks its parser then stops the run."
        ),
    ] = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Turn a dataset into tables with stages and geometry. Run again to continue after a stop.

    Status 0: done. 1: some scenes or assets are not usable; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.preprocess.job import PreprocessJob
    from pipelines.preprocess.job import preprocess as run
    from pipelines.preprocess.settings import PreprocessSettings
    from pipelines.settings import resolve_settings
    from stable_data.geometry.sdf.second_opinion import INSTALL, has_pysdf

    count = worker_count(workers, address)
    settings = resolve_settings(PreprocessSettings, "preprocess", config, set_ or [])
    if dry_run:
        echo(json.dumps(describe(PreprocessJob(data, settings, WorkerPool())), indent=2))
        return
    if not has_pysdf():
        echo(f"the columns sdf_agreement and sign_disagreement stay null, because pysdf is not installed; {INSTALL}", err=True)
    manifest = run(data, out, settings, WorkerPool(count, address))
    counts = manifest["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    echo(
        f"{out}: {counts['scenes']} of {manifest['num_scenes']} scenes, {counts['assets']} of {manifest['num_assets']} assets, "
        f"{counts['warnings']} warnings, {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@app.command(epilog=SETTINGS_HINT.format("correct"))
@with_clear_errors
def correct(
    scenes: Scenes,
    out: RunOut,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table correct is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Turn scenes into scenes that are exactly clean: repair, or rearrangement. Run again to continue after a stop.

    Corrected scenes are in the table scenes, the changes in the table corrections. For a folder in the MesaTask-10K format,
    OUT/dataset is the corrected folder. Status 0: done. 1: some scenes could not be corrected; the table failures gives the
    reasons. 2: could not start.
    """
    from pipelines.correct.job import CorrectJob
    from pipelines.correct.job import correct as run
    from pipelines.correct.settings import CorrectSettings
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings

    count = worker_count(workers, address)
    settings = resolve_settings(CorrectSettings, "correct", config, set_ or [])
    if dry_run:
        echo(json.dumps(describe(CorrectJob(scenes, settings, WorkerPool())), indent=2))
        return
    manifest = run(scenes, out, settings, WorkerPool(count, address))
    counts = manifest["counts"]
    status = ", ".join(f"{counts['by_status'][key]} {key}" for key in sorted(counts["by_status"]))
    echo(
        f"{out}: {counts['scenes']} of {manifest['num_scenes']} scenes ({status}), {counts['warnings']} warnings, "
        f"{counts['failures']} failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@app.command(epilog=SETTINGS_HINT.format("edit"))
@with_clear_errors
def edit(
    scenes: Scenes,
    edits: Annotated[
        Path,
        typer.Option(
            help='One edit in each line: {"scene_id": ..., "instruction": ...}; optional are "edit_id", the id of the new scene, and '
            '"reply", which is applied without the reasoner.'
        ),
    ],
    out: RunOut,
    assets: EditAssets = None,
    engine: Annotated[
        str | None,
        typer.Option(
            help="The language model: embedded, transformers:FOLDER, vllm:FOLDER, openai:MODEL (--set engine.http.base_url=URL, and "
            "engine.http.key_variable=NAME of the variable that holds the key) or scripted:FILE. Default: embedded."
        ),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table edit is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Change scenes by instructions, and nothing else in them. Run again to continue after a stop.

    Edited scenes are in the table scenes, the changes in the table edits, the assets in assets and meshes. For a folder in the
    MesaTask-10K format, OUT/dataset is the folder of edited scenes. Status 0: done. 1: some edits failed; the table failures
    gives the reasons. 2: could not start.
    """
    from pipelines.edit.job import EditJob
    from pipelines.edit.job import edit as run
    from pipelines.edit.settings import EditSettings
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.settings import resolve_settings
    from stable_data.embedded_world.library import NAME as EMBEDDED

    count = worker_count(workers, address)
    asked = [f"engine.engine={json.dumps(engine)}"] if engine is not None else []
    settings = resolve_settings(EditSettings, "edit", config, [*(set_ or []), *asked])
    places = _further_libraries(assets or [EMBEDDED])
    if dry_run:
        echo(json.dumps(describe(EditJob(scenes, edits, settings, WorkerPool(), places)), indent=2))
        return
    manifest = run(scenes, edits, out, settings, WorkerPool(count, address), places)
    counts = manifest["counts"]
    kinds = ", ".join(f"{counts['by_kind'][key]} {key}" for key in sorted(counts["by_kind"]))
    echo(
        f"{out}: {counts['scenes']} of {manifest['num_edits']} edits ({kinds}), {counts['warnings']} warnings, "
        f"{counts['failures']} failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@app.command(epilog=SETTINGS_HINT.format("generate"))
@with_clear_errors
def generate(
    out: RunOut,
    tasks: Annotated[
        Path | None,
        typer.Option(
            help="Tasks: .jsonl, .csv or .parquet with instruction, table_type, table_size_cm and, optionally, scene_id and "
            "restricted_zone_cm."
        ),
    ] = None,
    scenes: Annotated[
        str | None, typer.Option(help="Take the tasks of these scenes: a run, or a folder in the MesaTask-10K format.")
    ] = None,
    where: Annotated[str, typer.Option(help="Which scenes of a run, such as \"split == 'test'\".")] = "",
    vary: Annotated[
        str | None,
        typer.Option(
            metavar="AXIS",
            help="Make variants of the scenes of a run, which keep all but one axis: layout, assets, task or clutter.",
        ),
    ] = None,
    variants: Annotated[int | None, typer.Option(help="Variants of each scene, with --vary. Default: 1.")] = None,
    limit: Annotated[int | None, typer.Option(help="Scenes that are varied, at most, with --vary. Default: all.")] = None,
    count: Annotated[
        int | None,
        typer.Option(
            help="Sample this many tasks of the embedded world, for things that the libraries have (only_served). A larger number makes "
            "further scenes in the same folder."
        ),
    ] = None,
    instruction: Annotated[str | None, typer.Option(help="One task: its instruction, with --table and --size.")] = None,
    table: Annotated[
        list[str] | None,
        typer.Option(
            help="Table type, such as office_table: of --instruction, or of the tasks of --count, where it may be repeated and all "
            "types are the default."
        ),
    ] = None,
    size: Annotated[
        tuple[float, float] | None, typer.Option(help="Width and depth of the table of --instruction, centimetres.")
    ] = None,
    restricted: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="x_min x_max y_min y_max of the restricted zone of the table of --instruction, centimetres."),
    ] = None,
    supports: Annotated[
        str | None,
        typer.Option(
            metavar="RUN",
            help="Lay the tasks out on the surfaces of this run, in turn: a run of supports or import scenes.",
        ),
    ] = None,
    assets: Assets = None,
    engine: Annotated[
        str | None,
        typer.Option(help="embedded, transformers:FOLDER, vllm:FOLDER, openai:MODEL or scripted:FILE; overrides the file."),
    ] = None,
    system: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Use the settings of a system of the paper's comparison (docs/systems.md): {', '.join(SYSTEMS)}; overrides the file, and "
            "--set overrides it.",
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of tasks and random choices; overrides the file.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table generate is read.")] = None,
    set_: JobSettings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    write_tasks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the tasks to this file (.jsonl), for another system, and stop."),
    ] = None,
    dry_run: DryRun = False,
) -> None:
    """Make simulation-ready scenes by Algorithm 1; every scene is audited and simulated. Run again to continue after a stop.

    Accepted scenes are in the table scenes, others in rejected, every turn of the two systems in turns, the assets in assets
    and meshes. Status 0: done. 1: some tasks have no accepted scene; the table failures gives the reasons. 2: could not start.
    """
    from models.baselines.systems import system_named
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.generate.job import GenerateJob
    from pipelines.generate.job import generate as run
    from pipelines.generate.settings import GenerateSettings
    from pipelines.settings import resolve_settings
    from pipelines.sources.generation_tasks import (
        sample_tasks,
        task_of_instruction,
        tasks_of_file,
        tasks_of_scenes,
        tasks_on_supports,
        variants_of_scenes,
    )
    from pipelines.sources.tasks import write_tasks as tasks_to_file

    _check_generate_options(
        sources=sum(source is not None for source in (tasks, scenes, count, instruction)),
        scenes=scenes,
        where=where,
        vary=vary,
        counts_variants=variants is not None or limit is not None,
        count=count,
        instruction=instruction,
        tables=table or (),
        has_size=size is not None,
        has_zone=restricted is not None,
        supports=supports,
    )
    workers = worker_count(workers, address)
    asked = [f"engine.engine={json.dumps(engine)}"] * (engine is not None) + [f"seed={seed}"] * (seed is not None)
    of_system = [] if system is None else system_named(system).overrides
    settings = resolve_settings(GenerateSettings, "generate", config, [*of_system, *(set_ or []), *asked])
    if tasks is not None:
        found = tasks_of_file(tasks)
    elif scenes is not None and vary is not None:
        found = variants_of_scenes(scenes, vary, 1 if variants is None else variants, where, limit, settings.seed)
    elif scenes is not None:
        found = tasks_of_scenes(scenes, where)
    elif instruction is not None:
        found = task_of_instruction(instruction, (table or ["table"])[0], size or _ANY_SIZE, restricted)
    else:
        found = sample_tasks(count or 0, settings.seed, table or ())
    if supports is not None:
        _check_no_table(size, restricted)
        found = tasks_on_supports(found, supports)
    if dry_run:
        echo(json.dumps(describe(GenerateJob(found, settings, assets or ())), indent=2))
        return
    if write_tasks is not None:
        number = tasks_to_file(write_tasks, GenerateJob(found, settings, assets or ()).layout_tasks())
        echo(f"{write_tasks}: {number} tasks")
        return
    manifest = run(found, out, settings, WorkerPool(workers, address), assets or ())
    counts = manifest["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    echo(
        f"{out}: {counts['scenes']} of {manifest['num_tasks']} scenes accepted, {counts['assets']} assets, {counts['warnings']} "
        f"warnings, {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html, report/contact_sheet.png"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


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
    workers: Annotated[
        int, typer.Option(help="Worker processes on a local Ray, or shards at once with --address. -1: one a core.")
    ] = -1,
    address: Address = None,
) -> None:
    """Make a set of the embedded world with many workers: the same files as ``stable-data synth``.

    Status 0: done. 1: some scenes could not be made; synth_failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.synth.job import synth as run
    from stable_data.embedded_world import EmbeddedWorld

    world = EmbeddedWorld(seed, tuple(table or ()), pictures, edits, whole_library)
    with tqdm_bar(scenes) as bar:

        def show(done: int, failed: int) -> None:
            bar.update(done - bar.n)
            bar.set_postfix(failed=failed)

        failures = run(out, scenes, world, WorkerPool(worker_count(workers, address), address), show)
    tell_world(out, scenes, failures)


@app.command("settings")
@with_clear_errors
def show_settings(
    verb: Annotated[str, typer.Argument(metavar="JOB", help="The job, such as generate.")],
    preset: Annotated[str, typer.Option(help="For a training job: show the values of this preset.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object for each setting.")] = False,
) -> None:
    """List every setting of a job: its key, default, unit and meaning."""
    from pipelines.settings import list_settings, settings_text

    found = list_settings(verb, preset)
    echo("\n".join(json.dumps(asdict(setting)) for setting in found) if as_json else settings_text(found))


app.command("repair")(scene_files.repair)
app.command("import-scenes")(scene_files.import_scenes)
app.command("import-tabletopgen")(scene_files.import_tabletopgen)
app.command("supports")(supports)
app.command("reach", epilog=SETTINGS_HINT.format("reach"))(reach)
app.command("evaluate", epilog=SETTINGS_HINT.format("evaluate"))(evaluate)
app.command("views", epilog=SETTINGS_HINT.format("views"))(views)
app.command("rate", epilog=SETTINGS_HINT.format("rate"))(rate)
app.command("demonstrate", epilog=SETTINGS_HINT.format("demonstrate"))(demonstrate)
app.command("evaluate-policy", epilog=SETTINGS_HINT.format("evaluate-policy"))(evaluate_policy)


_ANY_SIZE = (100.0, 60.0)  # centimetres; the surface of a support replaces the table of an instruction


def _check_generate_options(
    *,
    sources: int,
    scenes: str | None,
    where: str,
    vary: str | None,
    counts_variants: bool,
    count: int | None,
    instruction: str | None,
    tables: Sequence[str],
    has_size: bool,
    has_zone: bool,
    supports: str | None,
) -> None:
    """Refuses options of generate that do not belong together."""
    if sources != 1:
        raise ConfigError("expected one of --tasks FILE, --scenes DATA, --count N and --instruction TEXT", "usage")
    if where and scenes is None:
        raise ConfigError("--where belongs to --scenes; leave it out, or name the scenes", "usage")
    if vary is None and counts_variants:
        raise ConfigError("--variants and --limit belong to --vary; leave them out, or name an axis", "usage")
    if vary is not None and (scenes is None or supports is not None):
        raise ConfigError("--vary AXIS needs the scenes of a run, expected --scenes RUN and no --supports", "usage")
    if tables and count is None and instruction is None:
        raise ConfigError("--table belongs to --count or --instruction; leave it out, or name one of those", "usage")
    if (has_size or has_zone) and instruction is None:
        raise ConfigError("--size and --restricted belong to --instruction; leave them out, or name it", "usage")
    if instruction is not None and supports is None and (not has_size or len(tables) != 1):
        raise ConfigError("--instruction TEXT has no table, expected one --table TYPE and --size W D", "usage")


def _check_no_table(size: object, restricted: object) -> None:
    """Refuses a table of its own where supports have the tables."""
    if size or restricted:
        raise ConfigError(
            "--size and --restricted are those of a table, but --supports has the tables; leave them out", "usage"
        )


def _further_libraries(assets: list[str]) -> list[str]:
    """The libraries after that of the scenes; none for ``none``."""
    if "none" in assets and len(assets) > 1:
        raise ConfigError("--assets none means no further library, but another one is named; leave out one of them", "usage")
    return [place for place in assets if place != "none"]


if __name__ == "__main__":
    app()
