"""The jobs: ``python -m pipelines VERB``."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pipelines.retired import CommandGroup
from stable_data.cli import (
    SOME_FAILED,
    Address,
    Edits,
    NumScenes,
    Pictures,
    Seed,
    SynthOut,
    Tables,
    WholeLibrary,
    tell_world,
    tqdm_bar,
    with_clear_errors,
)
from stable_data.errors import ConfigError

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Jobs on tabletop scenes.",
)

Scenes = Annotated[
    str, typer.Option(help="A folder in the MesaTask-10K format, or a run with a table scenes; every node must see it.")
]
RunOut = Annotated[str, typer.Option(help="Run folder: a path that every node sees, or a URI such as s3://bucket/prefix.")]
Settings = Annotated[list[str] | None, typer.Option("--set", help="key=value, overrides the file; may be repeated.")]
NumWorkers = Annotated[
    int,
    typer.Option(
        help="Worker processes on a local Ray, or shards at once with --address. -1: one for each core. 0: this process."
    ),
]
Assets = Annotated[
    list[str] | None,
    typer.Option(
        help="A folder in the MesaTask-10K format, or a run, to take assets from, or embedded: the embedded world's library, which "
        "is made if it is missing. May be repeated: libraries are searched in order for the wanted thing. Default: embedded."
    ),
]
EditAssets = Annotated[
    list[str] | None,
    typer.Option(
        "--assets",
        help="A folder in the MesaTask-10K format, a run, or embedded (the embedded world's library, which is made if it is missing), "
        "to take assets from that the scenes' own library lacks. May be repeated: libraries are searched in order, after that of "
        "the scenes. Default: embedded. none: only the scenes' own library.",
    ),
]
_KEYS = "python -m pipelines settings {} lists every key of --set and of the file with its default, unit and meaning."
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the settings and the plan, and stop.")]
Minutes = Annotated[
    float, typer.Option(help="Stop after this many minutes and keep the checkpoint; run again to continue. 0 is no limit.")
]
Trainers = Annotated[
    int, typer.Option(help="Training processes of Ray Train, one GPU each if the cluster has GPUs. 0 trains in this process.")
]


@app.callback()
def main() -> None:
    """Jobs on tabletop scenes, in this process, on a local Ray or on a cluster."""


@app.command(epilog=_KEYS.format("preprocess"))
@with_clear_errors
def preprocess(
    data: Annotated[
        str, typer.Option(help="A folder in the MesaTask-10K format; every node of a cluster must see it under this path.")
    ],
    out: RunOut,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table preprocess is read.")] = None,
    set_: Settings = None,
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

    Status 0: done. 1: some scenes or assets could not be used; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.preprocess.job import PreprocessJob
    from pipelines.preprocess.job import preprocess as run
    from pipelines.preprocess.settings import PreprocessSettings
    from pipelines.settings import resolve_settings
    from stable_data.geometry.sdf.second_opinion import INSTALL, has_pysdf

    count = _count(workers, address)
    settings = resolve_settings(PreprocessSettings, "preprocess", config, set_ or [])
    if dry_run:
        typer.echo(json.dumps(describe(PreprocessJob(data, settings, WorkerPool())), indent=2))
        return
    if not has_pysdf():
        typer.echo(
            f"the columns sdf_agreement and sign_disagreement stay null, because pysdf is not installed; {INSTALL}", err=True
        )
    manifest = run(data, out, settings, WorkerPool(count, address))
    counts = manifest["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    typer.echo(
        f"{out}: {counts['scenes']} of {manifest['num_scenes']} scenes, {counts['assets']} of {manifest['num_assets']} assets, "
        f"{counts['warnings']} warnings, {counts['failures']} failures{f' ({failed})' if failed else ''}; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@app.command(epilog=_KEYS.format("correct"))
@with_clear_errors
def correct(
    scenes: Scenes,
    out: RunOut,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table correct is read.")] = None,
    set_: Settings = None,
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

    count = _count(workers, address)
    settings = resolve_settings(CorrectSettings, "correct", config, set_ or [])
    if dry_run:
        typer.echo(json.dumps(describe(CorrectJob(scenes, settings, WorkerPool())), indent=2))
        return
    manifest = run(scenes, out, settings, WorkerPool(count, address))
    counts = manifest["counts"]
    status = ", ".join(f"{counts['by_status'][key]} {key}" for key in sorted(counts["by_status"]))
    typer.echo(
        f"{out}: {counts['scenes']} of {manifest['num_scenes']} scenes ({status}), {counts['warnings']} warnings, "
        f"{counts['failures']} failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@app.command(epilog=_KEYS.format("edit"))
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
    set_: Settings = None,
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

    count = _count(workers, address)
    asked = [f"engine.engine={json.dumps(engine)}"] if engine is not None else []
    settings = resolve_settings(EditSettings, "edit", config, [*(set_ or []), *asked])
    places = _further_libraries(assets or [EMBEDDED])
    if dry_run:
        typer.echo(json.dumps(describe(EditJob(scenes, edits, settings, WorkerPool(), places)), indent=2))
        return
    manifest = run(scenes, edits, out, settings, WorkerPool(count, address), places)
    counts = manifest["counts"]
    kinds = ", ".join(f"{counts['by_kind'][key]} {key}" for key in sorted(counts["by_kind"]))
    typer.echo(
        f"{out}: {counts['scenes']} of {manifest['num_edits']} edits ({kinds}), {counts['warnings']} warnings, "
        f"{counts['failures']} failures; report/index.html"
    )
    if counts["failures"]:
        raise typer.Exit(SOME_FAILED)


@app.command(epilog=_KEYS.format("generate"))
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
    count: Annotated[
        int | None,
        typer.Option(help="Sample this many tasks of the embedded world, for things that the libraries have (only_served)."),
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
    assets: Assets = None,
    engine: Annotated[
        str | None,
        typer.Option(help="embedded, transformers:FOLDER, vllm:FOLDER, openai:MODEL or scripted:FILE; overrides the file."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of tasks and random choices; overrides the file.")] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table generate is read.")] = None,
    set_: Settings = None,
    workers: NumWorkers = -1,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Make simulation-ready scenes by Algorithm 1; every scene is audited and simulated. Run again to continue after a stop.

    Accepted scenes are in the table scenes, others in rejected, every turn of the two systems in turns, the assets in assets
    and meshes. Status 0: done. 1: some tasks have no accepted scene; the table failures gives the reasons. 2: could not start.
    """
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.execution.shard_job import describe
    from pipelines.generate.job import GenerateJob
    from pipelines.generate.job import generate as run
    from pipelines.generate.settings import GenerateSettings
    from pipelines.settings import resolve_settings
    from pipelines.sources.generation_tasks import sample_tasks, task_of_instruction, tasks_of_file, tasks_of_scenes

    if sum(source is not None for source in (tasks, scenes, count, instruction)) != 1:
        raise ConfigError("expected one of --tasks FILE, --scenes DATA, --count N and --instruction TEXT", "usage")
    if where and scenes is None:
        raise ConfigError("--where belongs to --scenes; leave it out, or name the scenes", "usage")
    if table and count is None and instruction is None:
        raise ConfigError("--table belongs to --count or --instruction; leave it out, or name one of those", "usage")
    if (size or restricted) and instruction is None:
        raise ConfigError("--size and --restricted belong to --instruction; leave them out, or name it", "usage")
    if instruction is not None and (size is None or len(table or ()) != 1):
        raise ConfigError("--instruction TEXT has no table, expected one --table TYPE and --size W D", "usage")
    workers = _count(workers, address)
    asked = [f"engine.engine={json.dumps(engine)}"] * (engine is not None) + [f"seed={seed}"] * (seed is not None)
    settings = resolve_settings(GenerateSettings, "generate", config, [*(set_ or []), *asked])
    if tasks is not None:
        found = tasks_of_file(tasks)
    elif scenes is not None:
        found = tasks_of_scenes(scenes, where)
    elif instruction is not None:
        found = task_of_instruction(instruction, (table or [""])[0], size, restricted)
    else:
        found = sample_tasks(count or 0, settings.seed, table or ())
    if dry_run:
        typer.echo(json.dumps(describe(GenerateJob(found, settings, assets or ())), indent=2))
        return
    manifest = run(found, out, settings, WorkerPool(workers, address), assets or ())
    counts = manifest["counts"]
    failed = ", ".join(f"{code} {n}" for code, n in counts["failures_by_code"].items())
    typer.echo(
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

        failures = run(out, scenes, world, WorkerPool(_count(workers, address), address), show)
    tell_world(out, scenes, failures)


@app.command("fit-encoder")
@with_clear_errors
def fit_encoder(
    data: Annotated[str, typer.Option(help="Folder of a preprocess run, whose shapes are encoded; features=none is enough.")],
    weights: Annotated[
        str, typer.Option(help="Published weights of Point Transformer V3: scannet:FILE, modelnet:FILE or sonata:FILE.")
    ],
    out: Annotated[Path, typer.Option(help="File of the encoder; use it with preprocess --set features=FILE.")],
    device: Annotated[str, typer.Option(help="Device of the encoder, cpu or cuda.")] = "cpu",
) -> None:
    """Read published weights of Point Transformer V3 and fit their projection to 64 point features on the shapes of a run.

    Status 0: done. 2: could not be done.
    """
    import tempfile

    from pipelines.train.point_encoder import fit_encoder as fit

    with tempfile.TemporaryDirectory() as cache:
        typer.echo(fit(data, weights, out, Path(cache), device))


@app.command("train-corrector", epilog=_KEYS.format("train-corrector"))
@with_clear_errors
def train_corrector(
    data: Annotated[
        list[str],
        typer.Option(
            help="Folder of a preprocess run; every node of a cluster must see it under this path. May be repeated: one training on "
            "several runs."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for weights, checkpoint, logs and card; every node must see it too.")],
    proposals: Annotated[
        list[str] | None,
        typer.Option(
            help="Folder of a generate run on assets of --data: its proposals and their corrections are samples too. May be repeated."
        ),
    ] = None,
    preset: Annotated[
        str,
        typer.Option(
            help="paper, paper_tuned, paper_set, embedded or embedded_set: network and training; the file and --set override it."
        ),
    ] = "embedded_set",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table train_corrector is read.")] = None,
    set_: Settings = None,
    minutes: Minutes = 0.0,
    encoder: Annotated[
        str,
        typer.Option(help="Encoder of the run's features, saved beside the weights; auto: the one of the run, or the default."),
    ] = "auto",
    workers: Trainers = 0,
    address: Address = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the settings and a summary of the data, and stop.")] = False,
) -> None:
    """Train the Physics Corrector on the clean scenes of runs, and on proposals of the reasoner. Run again to continue after a stop.

    Status 0: done, or stopped with a checkpoint. 2: could not start or continue.
    """
    from models.physics_corrector.training.settings import CorrectorTrainingSettings, training_preset
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.settings import resolve_settings
    from pipelines.train.corrector import CorrectorTrainingJob

    settings = resolve_settings(CorrectorTrainingSettings, "train_corrector", config, set_ or [], training_preset(preset))
    job = CorrectorTrainingJob(
        data[0],
        out,
        settings,
        minutes=minutes,
        encoder=encoder,
        also=tuple(data[1:]),
        proposals=tuple(proposals or ()),
        repairers=WorkerPool(_count(-1, address), address),
    )
    if dry_run:
        typer.echo(json.dumps(job.describe(), indent=2))
        return
    typer.echo(job.run(_count(workers, address) if address or workers else 0, address))


@app.command("train-reasoner", epilog=_KEYS.format("train-reasoner"))
@with_clear_errors
def train_reasoner(
    data: Annotated[str, typer.Option(help="Folder of a preprocess run, or its URI; every node of a cluster must see it.")],
    out: Annotated[Path, typer.Option(help="Folder for weights, checkpoint and logs; every node must see it too.")],
    preset: Annotated[
        str,
        typer.Option(
            help="embedded: a small Qwen3 from scratch. paper: the paper's fine-tuning of the model in the folder --set base=DIR."
        ),
    ] = "embedded",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table train_reasoner is read.")] = None,
    set_: Settings = None,
    minutes: Minutes = 0.0,
    workers: Trainers = 0,
    address: Address = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print examples, tokens, steps, time and the memory of each process, and stop.")
    ] = False,
) -> None:
    """Train the Semantic Reasoner on the samples and edits of a run. Run again to continue after a stop, with any --workers.

    OUT/weights is a plain Hugging Face folder. Workers that die are started again from the checkpoint, up to three times.
    Status 0: done, or stopped with a checkpoint. 2: could not start or continue.
    """
    from models.semantic_reasoner.training.settings import ReasonerTrainingSettings, training_preset
    from pipelines.settings import resolve_settings
    from pipelines.train.reasoner import ReasonerTrainingJob

    settings = resolve_settings(ReasonerTrainingSettings, "train_reasoner", config, set_ or [], training_preset(preset))
    if preset == "paper" and not settings.base:
        raise ConfigError("preset paper fine-tunes a model: name its folder with --set base=DIR", "config_invalid")
    job = ReasonerTrainingJob(data, out, settings, minutes=minutes)
    count = _count(workers, address) if address or workers else 0
    if dry_run:
        from pipelines.train.estimate import training_plan

        typer.echo(json.dumps(training_plan(job, count), indent=2))
        return
    typer.echo(job.run(count, address))


@app.command("train-reader", epilog=_KEYS.format("train-reader"))
@with_clear_errors
def train_reader(
    out: Annotated[Path, typer.Option(help="Folder for weights, checkpoint and logs.")],
    frames: Annotated[str, typer.Option(help="Folder of frames; empty takes those of models/instruction_reader/frames.")] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table train_reader is read.")] = None,
    set_: Settings = None,
    minutes: Minutes = 0.0,
) -> None:
    """Train the instruction reader on sentences made from frames. Run again to continue after a stop.

    Status 0: done, or stopped with a checkpoint. 2: could not start or continue.
    """
    from models.instruction_reader.training import ReaderTrainingSettings
    from pipelines.settings import resolve_settings
    from pipelines.train.reader import ReaderTrainingJob

    settings = resolve_settings(ReaderTrainingSettings, "train_reader", config, set_ or [])
    typer.echo(ReaderTrainingJob(frames, out, settings, minutes).run())


@app.command("settings")
@with_clear_errors
def show_settings(
    verb: Annotated[str, typer.Argument(help="The job, such as generate.")],
    preset: Annotated[str, typer.Option(help="For a training job: show the values of this preset.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object for each setting.")] = False,
) -> None:
    """List every setting of a job: its key, default, unit and meaning."""
    from pipelines.settings import list_settings, settings_text

    found = list_settings(verb, preset)
    typer.echo("\n".join(json.dumps(asdict(setting)) for setting in found) if as_json else settings_text(found))


def _further_libraries(assets: list[str]) -> list[str]:
    """The libraries after that of the scenes; none for ``none``."""
    if "none" in assets and len(assets) > 1:
        raise ConfigError("--assets none means no further library, but another one is named; leave out one of them", "usage")
    return [place for place in assets if place != "none"]


def _count(workers: int, address: str | None) -> int:
    """The number of workers, with -1 resolved."""
    if address and workers == 0:
        raise ConfigError(f"--workers 0 is this process, but --address is {address}; leave out one of them", "config_invalid")
    return workers if workers >= 0 else 0 if address else os.cpu_count() or 1


if __name__ == "__main__":
    app()
