"""Trains the Semantic Reasoner: in this process, or in the processes of Ray Train with its weights sharded, with the same loop.

OUT/weights/                     a plain Hugging Face folder, with reasoner.json (the settings of its training) and
                                 categories.json (used by the checks of its replies)
OUT/checkpoint/NUMBER/           the checkpoint from which a stopped run continues, a part from each process
OUT/logs/events.out.tfevents.*   losses, for TensorBoard
OUT/manifest.json                settings, data and models
OUT/cache/                       tokens and tokenizer; may be deleted
"""

import json
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
from pipelines.train.run import TrainingJob, TrainingMonitor, json_bytes, result_line
from stable_data.code_version import code_version
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder

CHECKPOINT = "checkpoint"
"""The folder of the checkpoint in a training's folder."""

Judge: TypeAlias = Callable[[Any, PreTrainedTokenizerBase], Mapping[str, float]]
"""Computes named figures from the text that a model generates; the model is a complete one of transformers or peft."""


@dataclass(frozen=True, slots=True)
class ReasonerMonitoring:
    """Logging and validation of a training; these settings do not shape the weights.

    Attributes:
        log_every: Steps between log entries; a logged loss is the mean over them.
        validate_every: Steps between evaluations on the split ``validation``.
        validate_examples: Examples of each kind in an evaluation.
        save_minutes: Minutes between checkpoints.
        judge: Computes more figures from generated text: during the training only if one process holds the whole model, at
            the end always. It must be a module-level function, because it is sent to the workers.
    """

    log_every: int = 20
    validate_every: int = 500
    validate_examples: int = 600
    save_minutes: float = 5.0
    judge: Judge | None = None


@dataclass(frozen=True)
class ReasonerTrainingJob(TrainingJob):
    """The training of the Semantic Reasoner.

    Attributes:
        settings: The settings that shape the weights.
        watch: Logging and validation.
        minutes: Time after which it stops and saves its checkpoint; 0 is no limit.
    """

    NAME = "train_reasoner"
    WEIGHTS = "weights"
    COMPARED = tuple(asdict(CheckpointIdentity()))

    settings: ReasonerTrainingSettings
    watch: ReasonerMonitoring = ReasonerMonitoring()
    minutes: float = 0.0

    def source(self) -> ExampleSource:
        """The source of the training examples."""
        return ExampleSource(self.data_uri, self.folder / "cache", self.settings)

    def prepare(self) -> tuple["ReasonerTrainingJob", dict[str, Any], None]:
        """Reads the examples; see the base class. The tokens are mapped from a file, so that each process opens its own."""
        tokenizer, data, held_out = self._read()
        job = replace(self, settings=self.settings.resolved(len(self.batches(data))), out=self.folder)
        details = {
            **asdict(job.identity(tokenizer)),
            "examples": {"train": _counts(data), "validation": _counts(held_out)},
            "settings": asdict(job.settings),
        }
        return job, details, None

    def check_start(self, workers: int) -> None:
        """Refuses an unreadable base, missing data, and a number of processes that cannot share a step.

        Raises:
            ConfigError: One of these; a step is shared if ``accumulate`` is a multiple of the number of processes.
        """
        if self.settings.base:
            read_config(Path(self.settings.base).expanduser(), self.settings.max_tokens)
        if workers and self.settings.accumulate % workers:
            raise ConfigError(
                f"accumulate is {self.settings.accumulate}, expected a multiple of --workers {workers}: they share its batches",
                "config_invalid",
            )
        self.source().fingerprint()

    def batches(self, data: TokenDataset) -> list[Rows]:
        """The batches of the first pass.

        Raises:
            ConfigError: There is no batch.
        """
        batches = batches_of_pass(data, self.settings, 0)
        if not batches:
            raise ConfigError("the setting shares leaves no example, expected at least one", "config_invalid")
        return batches

    def work(self, place: ProcessContext, data: None = None) -> None:
        """Trains, or continues; the part of one process."""
        tokenizer, examples, held_out = self._read()
        training = ReasonerTrainer(examples, self.settings, tokenizer, place, self.identity(tokenizer))
        training.resume(self.out / CHECKPOINT)
        watch, settings = self.watch, self.settings
        limits = (self.minutes, watch.log_every, watch.save_minutes)
        with TrainingMonitor(training, settings.steps, self.out, *limits, state=CHECKPOINT) as monitor:

            def after(_: ReasonerTrainer, step: StepMetrics) -> None:
                rate = settings.learning_rate_at(training.step - 1)
                monitor.count({"train": step.loss}, learning_rate=rate, gradient_norm=step.norm, tokens=training.tokens)
                if training.step % watch.validate_every == 0 and training.step < settings.steps:
                    figures = self._validate(training, held_out)
                    if watch.judge is not None and place.world_size == 1:
                        figures |= watch.judge(training.loss.network, tokenizer)
                    monitor.log(figures)
                if step.saves and not step.stops:  # the last checkpoint is saved after the loop
                    monitor.save()

            train(training, wants_stop=monitor.wants_stop, wants_save=monitor.wants_save, after=after)
            monitor.save()
            figures = self._validate(training, held_out)
            values = training.values()  # a collective operation of all processes
            if monitor.is_first:
                model = TrainableNetwork(self.settings, tokenizer).with_values(values).to_save(self.settings)
                if watch.judge is not None:
                    figures |= watch.judge(model, tokenizer)
                monitor.log(figures)
                write_model(self.out / self.WEIGHTS, model, tokenizer, self._notes(training, figures))

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
        """The data, tokenizer and base model that a checkpoint belongs to."""
        base = self.settings.base
        of_base = model_fingerprint(Path(base).expanduser()) if base else ""
        return CheckpointIdentity(self.source().fingerprint(), fingerprint_of(tokenizer), of_base)

    def _read(self) -> tuple[PreTrainedTokenizerBase, TokenDataset, TokenDataset]:
        source = self.source()
        tokenizer = source.tokenizer()
        return tokenizer, source.load("train", tokenizer), source.load("validation", tokenizer)

    def finish(self, folder: RunFolder, manifest: dict[str, Any]) -> str:
        """Closes the manifest; one line on what was done. Finished weights get the statistics that the checks of replies use."""
        weights = Path(folder.root) / self.WEIGHTS
        notes = json.loads((weights / NOTES).read_text("utf-8"))
        if notes["is_done"]:
            CategoryStatistics.of_run(self.data_uri).save(weights)
        closed = manifest | {"status": "complete" if notes["is_done"] else "stopped", "steps_done": notes["steps"]}
        folder.write_bytes("manifest.json", json_bytes(closed))
        counts = manifest["examples"]["train"]
        nats = ", ".join(f"{k.partition('/')[2]} {v:.3f}" for k, v in notes["figures"].items() if k.startswith("validation/"))
        steps, used = f"{notes['steps']} of {self.settings.steps}", f"{counts['used']} examples"
        rest = "" if notes["is_done"] else "run again to continue"
        return result_line(folder, steps, used, counts, nats and f"nats a token {nats}", self.WEIGHTS, rest)


def _counts(data: TokenDataset) -> dict[str, int]:
    counts = {"used": len(data), "left_out_too_long": int(data.too_long.sum()), "left_out_unasked": int(data.unasked.sum())}
    return counts | {"tokens": int(data.start[-1]), "reply_tokens": int(data.reply_length.sum())}
