"""Trains the Semantic Reasoner: in this process, or in the processes of Ray Train with its weights sharded, with the same loop.

OUT/weights/                     a plain Hugging Face folder; reasoner.json, which says how it was made; and categories.json,
what
                                 the checks of its replies know of the run's categories
OUT/checkpoint/state.pt          where a run that was stopped goes on
OUT/logs/events.out.tfevents.*   losses, for TensorBoard
OUT/manifest.json                settings, data and models
OUT/cache/                       tokens and tokenizer; may be deleted
"""

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.text.prompt import PROMPT_VERSION
from models.semantic_reasoner.training.batch_sampler import Rows, batches_of_pass
from models.semantic_reasoner.training.dataset import ExampleSource, fingerprint_of
from models.semantic_reasoner.training.hf_folder import NOTES, model_fingerprint, read_config, write_model
from models.semantic_reasoner.training.network import TrainableNetwork
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.token_dataset import TokenDataset
from models.semantic_reasoner.training.trainer import CheckpointIdentity, ReasonerTrainer, StepMetrics, train
from models.training.distributed import ProcessContext
from pipelines.train.run import STATE, TrainingMonitor, json_bytes, refuse_changes, training_device
from stable_data.code_version import code_version
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder

WEIGHTS = "weights"

Judge: TypeAlias = Callable[[Any, PreTrainedTokenizerBase], Mapping[str, float]]
"""Figures of a model by what it generates, by name; the model is whole and of transformers or peft."""


@dataclass(frozen=True, slots=True)
class ReasonerMonitoring:
    """How a run is watched; none of it shapes the weights.

    Attributes:
        log_every: Steps between the losses that are logged, each a mean over them.
        validate_every: Steps between evaluations on the split ``validation``.
        validate_examples: Examples of each kind of those.
        save_minutes: Between checkpoints.
        judge: More figures for each evaluation, of what the model generates; while it is trained only where one process has it
            whole, in the end always. A function of a module, since it is sent to the workers.
    """

    log_every: int = 20
    validate_every: int = 500
    validate_examples: int = 600
    save_minutes: float = 5.0
    judge: Judge | None = None


@dataclass(frozen=True, slots=True)
class ReasonerTrainingJob:
    """The job; sent to the workers.

    Attributes:
        data: Folder of a preprocess run.
        out: Folder of the training.
        settings: What shapes the weights.
        watch: How it is watched.
        minutes: After which it stops and keeps its checkpoint; 0 is no limit.
    """

    data: str
    out: Path
    settings: ReasonerTrainingSettings
    watch: ReasonerMonitoring = ReasonerMonitoring()
    minutes: float = 0.0

    def source(self) -> ExampleSource:
        """Where the examples come from."""
        data = self.data if "://" in self.data else str(Path(self.data).expanduser().resolve())
        return ExampleSource(data, self._folder() / "cache", self.settings)

    def run(self, workers: int = 0, address: str | None = None) -> str:
        """Trains, or goes on.

        Args:
            workers: Processes of Ray Train; 0 trains in this one.
            address: An existing Ray cluster; None starts a local one.

        Returns:
            One line on what was done.

        Raises:
            ConfigError: The run cannot start or go on; the checkpoint stays.
        """
        base = self.settings.base
        if base:
            read_config(Path(base).expanduser(), self.settings.max_tokens)  # before anything takes long
        self.check_workers(workers)
        self.source().fingerprint()
        folder = RunFolder(str(self._folder()))
        with folder.locked():
            tokenizer, data, held_out = self._read()
            job = replace(self, settings=self.settings.resolved(len(self.batches(data))), out=self._folder())
            manifest = _manifest(job, tokenizer, data, held_out)
            refuse_changes(folder, manifest, ("job", "code_version", *asdict(CheckpointIdentity())))
            folder.write_bytes("manifest.json", json_bytes(manifest))
            if workers:
                from pipelines.train.ray_train import run_on_ray  # Ray Train takes seconds to import

                run_on_ray(job, workers, address)
            else:
                job.work(ProcessContext(training_device()))
            return _finish(folder, manifest, self.source().uri)

    def check_workers(self, workers: int) -> None:
        """Refuses a number of processes that cannot share a step's batches.

        Raises:
            ConfigError: ``accumulate`` is not a multiple of it.
        """
        if workers and self.settings.accumulate % workers:
            raise ConfigError(
                f"accumulate is {self.settings.accumulate}, expected a multiple of --workers {workers}: they share its batches",
                "config_invalid",
            )

    def batches(self, data: TokenDataset) -> list[Rows]:
        """Batches of the first pass.

        Raises:
            ConfigError: There are none.
        """
        batches = batches_of_pass(data, self.settings, 0)
        if not batches:
            raise ConfigError("shares leave no example of those that there are, expected some", "config_invalid")
        return batches

    def work(self, place: ProcessContext) -> None:
        """The part of one process."""
        tokenizer, data, held_out = self._read()  # kept already: it is mapped
        training = ReasonerTrainer(data, self.settings, tokenizer, place, self.identity(tokenizer))
        training.resume(self.out / STATE)
        watch, settings = self.watch, self.settings
        with TrainingMonitor(training, settings.steps, self.out, self.minutes, watch.log_every, watch.save_minutes) as monitor:

            def after(_: ReasonerTrainer, step: StepMetrics) -> None:
                rate = settings.learning_rate_at(training.step - 1)
                monitor.count({"train": step.loss}, learning_rate=rate, gradient_norm=step.norm, tokens=training.tokens)
                if training.step % watch.validate_every == 0 and training.step < settings.steps:
                    figures = self._validate(training, held_out)
                    if watch.judge is not None and place.world_size == 1:
                        figures |= watch.judge(training.loss.network, tokenizer)
                    monitor.log(figures)
                if step.saves and not step.stops:  # in the end it is kept anyway
                    monitor.save()

            train(training, wants_stop=monitor.wants_stop, wants_save=monitor.wants_save, after=after)
            monitor.save()
            figures = self._validate(training, held_out)
            values = training.values()  # all processes share in it
            if monitor.is_first:
                model = TrainableNetwork(self.settings, tokenizer).with_values(values).to_keep(self.settings)
                if watch.judge is not None:
                    figures |= watch.judge(model, tokenizer)
                monitor.log(figures)
                write_model(self.out / WEIGHTS, model, tokenizer, self._notes(training, figures))

    def _validate(self, training: ReasonerTrainer, held_out: TokenDataset) -> dict[str, float]:
        found = training.validate(held_out, self.watch.validate_examples)
        return {f"validation/{kind}": value for kind, value in found.items()}

    def _notes(self, training: ReasonerTrainer, figures: Mapping[str, float]) -> dict[str, Any]:
        return {
            "prompt_version": PROMPT_VERSION,
            "code_version": code_version(),
            "settings": asdict(self.settings),
            **asdict(self.identity(training.tokenizer)),
            "steps": training.step,
            "is_done": training.step >= self.settings.steps,
            "tokens": training.tokens,
            "figures": figures,
        }

    def identity(self, tokenizer: PreTrainedTokenizerBase) -> CheckpointIdentity:
        """What a checkpoint goes with."""
        base = self.settings.base
        of_base = model_fingerprint(Path(base).expanduser()) if base else ""
        return CheckpointIdentity(self.source().fingerprint(), fingerprint_of(tokenizer), of_base)

    def _read(self) -> tuple[PreTrainedTokenizerBase, TokenDataset, TokenDataset]:
        source = self.source()
        tokenizer = source.tokenizer()
        return tokenizer, source.load("train", tokenizer), source.load("validation", tokenizer)

    def _folder(self) -> Path:
        if "://" in str(self.out):
            raise ConfigError(f"--out is {self.out}, expected a local folder", "output_invalid")
        return self.out.expanduser().resolve()


def _manifest(
    job: ReasonerTrainingJob, tokenizer: PreTrainedTokenizerBase, data: TokenDataset, held_out: TokenDataset
) -> dict[str, Any]:
    return {
        "job": "train_reasoner",
        "status": "running",
        "code_version": code_version(),
        "code_versions": [code_version()],
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        **asdict(job.identity(tokenizer)),
        "examples": {"train": _counts(data), "validation": _counts(held_out)},
        "settings": asdict(job.settings),
    }


def _counts(data: TokenDataset) -> dict[str, int]:
    counts = {"used": len(data), "left_out_too_long": int(data.too_long.sum()), "left_out_unasked": int(data.unasked.sum())}
    return counts | {"tokens": int(data.start[-1]), "reply_tokens": int(data.reply_length.sum())}


def _finish(folder: RunFolder, manifest: dict[str, Any], run: str) -> str:
    """Closes the manifest; one line on what was done. Finished weights get what the checks know of the run's categories."""
    weights = Path(folder.root) / WEIGHTS
    notes = json.loads((weights / NOTES).read_text("utf-8"))
    if notes["is_done"]:
        CategoryStatistics.of_run(run).save(weights)
    status = "complete" if notes["is_done"] else "stopped"
    folder.write_bytes("manifest.json", json_bytes(manifest | {"status": status, "steps_done": notes["steps"]}))
    of_train = manifest["examples"]["train"]
    left_out = {k.removeprefix("left_out_"): v for k, v in of_train.items() if k.startswith("left_out_") and v}
    without = f", {sum(left_out.values())} left out ({', '.join(f'{k} {v}' for k, v in left_out.items())})" if left_out else ""
    nats = ", ".join(f"{k.partition('/')[2]} {v:.3f}" for k, v in notes["figures"].items() if k.startswith("validation/"))
    rest = "" if notes["is_done"] else "; run again to go on"
    return (
        f"{folder.uri}: {notes['steps']} of {manifest['settings']['steps']} steps on {of_train['used']} examples{without}"
        f"{f'; nats a token {nats}' if nats else ''}; {WEIGHTS}{rest}"
    )
