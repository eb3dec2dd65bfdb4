"""The training verbs of ``python -m pipelines``."""

import json
from pathlib import Path
from typing import Annotated

import typer

from pipelines.job_options import SETTINGS_HINT, JobSettings, worker_count
from stable_data.commands.command_line import Address, echo, with_clear_errors
from stable_data.errors import ConfigError

app = typer.Typer()

Minutes = Annotated[
    float, typer.Option(help="Stop after this many minutes and keep the checkpoint; run again to continue. 0 is no limit.")
]
Trainers = Annotated[
    int, typer.Option(help="Training processes of Ray Train, one GPU each if the cluster has GPUs. 0 trains in this process.")
]
SceneRuns = Annotated[
    list[str],
    typer.Option(
        help="Folder of a preprocess run; every node of a cluster must see it under this path. May be repeated: one training on "
        "several runs."
    ),
]
TrainingOut = Annotated[Path, typer.Option(help="Folder for weights, checkpoint, logs and card; every node must see it too.")]
Proposals = Annotated[
    list[str] | None,
    typer.Option(
        help="Folder of a generate run on assets of --data: its proposals and their corrections are samples too. May be repeated."
    ),
]
EncoderName = Annotated[
    str,
    typer.Option(help="Encoder of the run's features, saved beside the weights; auto: the one of the run, or the default."),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the settings and a summary of the data, and stop.")]


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
        echo(fit(data, weights, out, Path(cache), device))


@app.command("train-corrector", epilog=SETTINGS_HINT.format("train-corrector"))
@with_clear_errors
def train_corrector(
    data: SceneRuns,
    out: TrainingOut,
    proposals: Proposals = None,
    preset: Annotated[
        str,
        typer.Option(
            help="paper, paper_tuned, paper_set, embedded or embedded_set: network and training; the file and --set override it."
        ),
    ] = "embedded_set",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table train_corrector is read.")] = None,
    set_: JobSettings = None,
    minutes: Minutes = 0.0,
    encoder: EncoderName = "auto",
    workers: Trainers = 0,
    address: Address = None,
    dry_run: DryRun = False,
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
        repairers=WorkerPool(worker_count(-1, address), address),
    )
    if dry_run:
        echo(json.dumps(job.describe(), indent=2))
        return
    echo(job.run(worker_count(workers, address) if address or workers else 0, address))


@app.command("train-rearranger", epilog=SETTINGS_HINT.format("train-rearranger"))
@with_clear_errors
def train_rearranger(
    data: SceneRuns,
    out: TrainingOut,
    method: Annotated[str, typer.Option(help="lego_net or struct_diffusion; the file and --set override its other settings.")],
    proposals: Proposals = None,
    config: Annotated[Path | None, typer.Option(help="TOML file; its table train_rearranger is read.")] = None,
    set_: JobSettings = None,
    minutes: Minutes = 0.0,
    encoder: EncoderName = "auto",
    workers: Trainers = 0,
    address: Address = None,
    dry_run: DryRun = False,
) -> None:
    """Train a rearranger of another paper on the samples of the corrector's training, to compare both. Run again to continue.

    Status 0: done, or stopped with a checkpoint. 2: could not start or continue.
    """
    from models.rearrangement.training import RearrangerTrainingSettings, training_preset
    from pipelines.execution.ray_executor import WorkerPool
    from pipelines.settings import resolve_settings
    from pipelines.train.rearranger import RearrangerTrainingJob

    base = training_preset(method)
    settings = resolve_settings(RearrangerTrainingSettings, "train_rearranger", config, set_ or [], base)
    if (chosen := settings.rearranger.method) != method:
        raise ConfigError(f"--method is {method}, but rearranger.method is {chosen}; name it with --method alone", "usage")
    job = RearrangerTrainingJob(
        data[0],
        out,
        settings,
        minutes=minutes,
        encoder=encoder,
        also=tuple(data[1:]),
        proposals=tuple(proposals or ()),
        repairers=WorkerPool(worker_count(-1, address), address),
    )
    if dry_run:
        echo(json.dumps(job.describe(), indent=2))
        return
    echo(job.run(worker_count(workers, address) if address or workers else 0, address))


@app.command("train-reasoner", epilog=SETTINGS_HINT.format("train-reasoner"))
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
    set_: JobSettings = None,
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
    count = worker_count(workers, address) if address or workers else 0
    if dry_run:
        from pipelines.train.estimate import training_plan

        echo(json.dumps(training_plan(job, count), indent=2))
        return
    echo(job.run(count, address))


@app.command("train-reader", epilog=SETTINGS_HINT.format("train-reader"))
@with_clear_errors
def train_reader(
    out: Annotated[Path, typer.Option(help="Folder for weights, checkpoint and logs.")],
    frames: Annotated[str, typer.Option(help="Folder of frames; empty takes those of models/instruction_reader/frames.")] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table train_reader is read.")] = None,
    set_: JobSettings = None,
    minutes: Minutes = 0.0,
) -> None:
    """Train the instruction reader on sentences made from frames. Run again to continue after a stop.

    Status 0: done, or stopped with a checkpoint. 2: could not start or continue.
    """
    from models.instruction_reader.training import ReaderTrainingSettings
    from pipelines.settings import resolve_settings
    from pipelines.train.reader import ReaderTrainingJob

    settings = resolve_settings(ReaderTrainingSettings, "train_reader", config, set_ or [])
    echo(ReaderTrainingJob(frames, out, settings, minutes).run())


@app.command("train-policy", epilog=SETTINGS_HINT.format("train-policy"))
@with_clear_errors
def train_policy(
    episodes: Annotated[
        list[str],
        typer.Option(
            help="A run with the table episodes, such as one of demonstrate. May be repeated: one training on several."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for weights, checkpoint, curve and report.")],
    where: Annotated[str, typer.Option(help="Which episodes, such as \"task_kind == 'pick' and split == 'train'\".")] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file; its table train_policy is read.")] = None,
    set_: JobSettings = None,
    minutes: Minutes = 0.0,
) -> None:
    """Train a policy by cloning the demonstrations of runs. Run again to continue after a stop.

    It sees the states of robot and environment, and pictures if network.cameras names some. Minutes on one core with states.
    evaluate-policy measures its success.
    Status 0: done, or stopped with a checkpoint. 2: could not start or continue.
    """
    from models.policy.training import PolicyTrainingSettings
    from pipelines.settings import resolve_settings
    from pipelines.train.policy import PolicyTrainingJob

    settings = resolve_settings(PolicyTrainingSettings, "train_policy", config, set_ or [])
    job = PolicyTrainingJob(episodes[0], out, also=tuple(episodes[1:]), where=where, settings=settings, minutes=minutes)
    echo(job.run())
