"""The training loop of the reasoner: cross-entropy on the replies alone (the paper's supervised fine-tuning).

A step depends on the weights and its number only: random streams of (seed, pass) draw its examples, so that a resumed run equals
an uninterrupted one. Each process computes the same list of batches and takes its share of those of a step, so that the result
does not depend on the number of processes.
"""

import itertools
import math
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.training.batch_sampler import Rows, batch_of, batches_in_order, batches_of_pass
from models.semantic_reasoner.training.network import trainable_parameters
from models.semantic_reasoner.training.optimizers import OptimizerSet
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.sharding import gather_tensor, make_loss
from models.semantic_reasoner.training.token_dataset import KINDS, TokenDataset
from models.training.distributed import CPU, ProcessContext
from models.training.heap import trim_heap
from models.training.sharded_checkpoint import load_tensors, read_values, save_sharded
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class CheckpointIdentity:
    """The inputs of a training that a checkpoint belongs to, besides the settings.

    Attributes:
        data: Fingerprint of the examples.
        tokenizer: Fingerprint of the tokenizer.
        base: Fingerprint of the model that is fine-tuned; empty if there is none.
    """

    data: str = ""
    tokenizer: str = ""
    base: str = ""


@dataclass(frozen=True, slots=True)
class StepMetrics:
    """Metrics of a step, over all processes.

    Attributes:
        loss: Nats a token, before the step.
        norm: Norm of the gradient, before it is clipped.
        stops: Whether a process requests a stop.
        saves: Whether a process requests a checkpoint.
    """

    loss: float
    norm: float
    stops: bool
    saves: bool


class ReasonerTrainer:
    """The state of a training.

    Args:
        data: The examples.
        settings: The settings, with ``steps`` set.
        tokenizer: The tokenizer of the examples.
        place: The device, and this process among all.
        identity: The inputs that a checkpoint must belong to.

    Attributes:
        step: Number of steps done.
        tokens: Number of reply tokens trained on.
        loss: The network with its loss.

    Raises:
        ConfigError: ``base`` cannot be used, the processes cannot share the batches of a step, or the network cannot be
            compiled here.
    """

    def __init__(
        self,
        data: TokenDataset,
        settings: ReasonerTrainingSettings,
        tokenizer: PreTrainedTokenizerBase,
        place: ProcessContext = CPU,
        identity: CheckpointIdentity = CheckpointIdentity(),
    ) -> None:
        if settings.accumulate % place.world_size:
            raise ConfigError(
                f"accumulate is {settings.accumulate}, expected a multiple of the {place.world_size} processes that share a step",
                "config_invalid",
            )
        if settings.compiles and place.world_size > 1:
            raise ConfigError(f"compiles is set, but {place.world_size} processes share a step, expected one", "config_invalid")
        compilers = [os.environ.get("CXX", ""), "g++", "clang++"]
        if settings.compiles and place.device.type == "cpu" and not any(map(shutil.which, filter(None, compilers))):
            raise ConfigError(
                "compiles is set, but there is no C++ compiler, expected g++ or clang++; install one, or unset compiles",
                "config_invalid",
            )
        self.data, self.settings, self.place, self.tokenizer = data, settings, place, tokenizer
        self._identity = identity
        self.loss = make_loss(settings, tokenizer, place)
        self._parameters = trainable_parameters(self.loss.network)
        self._optimizers = OptimizerSet(self._parameters, settings)
        self.step = self.tokens = 0
        self._batches = self._batches_from(0)

    def _batches_from(self, step: int) -> Iterator[Rows]:
        """The batches of all passes in order, from a step on."""
        passes = (batches_of_pass(self.data, self.settings, number) for number in itertools.count())
        return itertools.islice(itertools.chain.from_iterable(passes), step * self.settings.accumulate, None)

    def advance(self, wants_stop: bool = False, wants_save: bool = False) -> StepMetrics:
        """Does one step; this process may request a stop or a checkpoint after it."""
        batches = list(itertools.islice(self._batches, self.settings.accumulate))
        count = sum(self._num_reply_tokens(rows) for rows in batches)
        # The loss and the two requests are summed over the processes in one call.
        figures = torch.tensor([0.0, wants_stop, wants_save], dtype=torch.float64, device=self.place.device)
        world_size = self.place.world_size
        for rows in batches[self.place.rank :: world_size]:
            loss = self.loss.of_batch(batch_of(self.data, rows, self._pad), self.place) / count
            (loss * world_size).backward()  # type: ignore[no-untyped-call]  # FSDP averages gradients over the processes
            figures[0] += loss.detach()
        norm = gather_tensor(torch.nn.utils.clip_grad_norm_(self._parameters.values(), self.settings.clip))
        self._optimizers.step(self.settings.learning_rate_at(self.step))
        self._sum_over_processes(figures)
        self.step += 1
        self.tokens += count
        trim_heap(self.step)
        total, stops, saves = figures.tolist()
        return StepMetrics(total, float(norm), stops > 0, saves > 0)

    @property
    def _pad(self) -> int:
        return int(self.tokenizer.pad_token_id)

    def _num_reply_tokens(self, rows: Rows) -> int:
        examples = list(itertools.chain.from_iterable(rows))
        return int((self.data.start[1:][examples] - self.data.reply[examples]).sum())

    def _sum_over_processes(self, figures: Tensor) -> None:
        if self.place.world_size > 1:
            torch.distributed.all_reduce(figures)

    @torch.no_grad()
    def validate(self, data: TokenDataset, most: int) -> dict[str, float]:
        """Computes the loss of held-out replies, nats a token, by kind, of the first ``most`` examples of each kind."""
        found: dict[str, float] = {}
        for kind in np.unique(data.kind).tolist():
            members = np.flatnonzero(data.kind == kind)[:most]
            batches = batches_in_order(data, members, self.settings)
            total = torch.zeros(1, dtype=torch.float64, device=self.place.device)
            # All processes gather sharded weights together: a process without a batch left computes the last one again.
            for turn in range(math.ceil(len(batches) / self.place.world_size)):
                own = turn * self.place.world_size + self.place.rank
                loss = self.loss.of_batch(batch_of(data, batches[min(own, len(batches) - 1)], self._pad), self.place)
                total += loss if own < len(batches) else 0.0
            self._sum_over_processes(total)
            found[str(KINDS[kind])] = float(total) / int(data.reply_length[members].sum())
        return found

    def values(self) -> dict[str, Tensor]:
        """Returns the trained parameters by name, whole and on the CPU; all processes call it, and only the first gets them."""
        found: dict[str, Tensor] = {}
        for name, parameter in self._parameters.items():
            whole = gather_tensor(parameter.detach())
            if self.place.rank == 0:
                found[name] = whole.cpu()
        return found

    def save(self, folder: Path) -> None:
        """Writes a checkpoint into a folder atomically, each process its own part; all processes call it.

        Raises:
            ConfigError: It could not be written; the checkpoint before it stays.
        """
        averages = self._optimizers.averages()
        values = {
            "step": self.step,
            "tokens": self.tokens,
            "averages": list(averages),
            "learning_rates": self._rates(self.step),
        }
        save_sharded(folder, self._weights() | averages, values, self._expected_identity(), self.place)

    def resume(self, folder: Path) -> bool:
        """Continues from a checkpoint of :meth:`save`, with any number of processes; returns False if there is none.

        ``steps`` and ``cool_down`` may differ from those of the checkpoint if the finished steps have the same learning rates.

        Raises:
            ConfigError: The checkpoint cannot be read, or has other settings, data or models.
        """
        found = read_values(folder, self._expected_identity(), self.place, "step", "tokens", "averages", "learning_rates")
        if found is None:
            return False
        checkpoint, values = found
        # The settings steps and cool_down are not compared, so that a run may be extended before its cool-down.
        if values["learning_rates"] != self._rates(values["step"]):
            raise ConfigError(
                f"{folder}: with steps {self.settings.steps} and cool_down {self.settings.cool_down:g} the {values['step']} finished "
                "steps would have had other learning rates; set both as at the start, or change them before the cool-down",
                "config_changed",
            )
        self._optimizers.make_averages(values["averages"], values["step"])
        load_tensors(checkpoint, self._weights() | self._optimizers.averages(), self.place)
        self.step, self.tokens = values["step"], values["tokens"]
        self._batches = self._batches_from(self.step)
        return True

    def _weights(self) -> dict[str, Tensor]:
        """The trained parameters as they are in a checkpoint, of sharded ones this process's part."""
        return {f"weights.{name}": p.detach() for name, p in self._parameters.items()}

    def _rates(self, step: int) -> list[float]:
        """The learning rates of the steps before ``step``."""
        return [self.settings.learning_rate_at(k) for k in range(step)]

    def _expected_identity(self) -> dict[str, Any]:
        settings = {key: value for key, value in asdict(self.settings).items() if key not in ("steps", "cool_down")}
        return {"settings": settings, "identity": asdict(self._identity)}


def train(
    training: ReasonerTrainer,
    *,
    wants_stop: Callable[[], bool],
    wants_save: Callable[[], bool],
    after: Callable[[ReasonerTrainer, StepMetrics], None],
) -> bool:
    """Trains for the steps of the settings, or until a process requests a stop.

    Args:
        training: The training.
        wants_stop: Called before each step; True requests a stop after it.
        wants_save: Called before each step; True requests a checkpoint after it.
        after: Called after each step.

    Returns:
        Whether all steps are done.

    Raises:
        ConfigError: The loss or its gradient is not finite (``training_diverged``).
    """
    stops = False
    while not stops and training.step < training.settings.steps:
        step = training.advance(wants_stop(), wants_save())
        if not (math.isfinite(step.loss) and math.isfinite(step.norm)):
            raise ConfigError(
                f"step {training.step}: the loss or its gradient is not finite ({step.loss}, {step.norm}); lower learning_rate",
                "training_diverged",
            )
        stops = step.stops
        after(training, step)
    return training.step >= training.settings.steps
