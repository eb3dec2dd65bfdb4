"""The training of the reasoner, step by step: cross-entropy on the replies alone (the paper's supervised fine-tuning).

A step is a function of the weights and of its number: which examples it takes comes from streams named by (seed, pass), so a
run that was stopped and resumed is the run that was not. Processes share a step by its batches, and every one of them knows all
batches, so that their number changes what each does and not what is learned.
"""

import ctypes
import itertools
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from transformers import PreTrainedTokenizerBase

from models.semantic_reasoner.training.batch_sampler import Rows, batch_of, batches_in_order, batches_of_pass
from models.semantic_reasoner.training.loss import ReplyLoss, gather_tensor, place_network, shard_like
from models.semantic_reasoner.training.network import TrainableNetwork, trainable_parameters
from models.semantic_reasoner.training.optimizers import OptimizerSet
from models.semantic_reasoner.training.settings import ReasonerTrainingSettings
from models.semantic_reasoner.training.token_dataset import KINDS, TokenDataset
from models.training.checkpoint import load_checkpoint, save_checkpoint
from models.training.distributed import CPU, ProcessContext
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class CheckpointIdentity:
    """What a checkpoint goes with, beside the settings.

    Attributes:
        data: Fingerprint of the examples.
        tokenizer: Of the tokenizer.
        base: Of the model that is fine-tuned; empty where none is.
    """

    data: str = ""
    tokenizer: str = ""
    base: str = ""


@dataclass(frozen=True, slots=True)
class StepMetrics:
    """What a step says, of all processes.

    Attributes:
        loss: Nats a token, before the step.
        norm: Of the gradient, before it was clipped.
        stops: Whether a process wants to stop.
        saves: Whether a process wants to keep a checkpoint.
    """

    loss: float
    norm: float
    stops: bool
    saves: bool


_TRIM_EVERY = 32  # steps


def _give_back() -> None:
    """Gives what is free back to the system: batches of ever new shapes leave holes that glibc keeps, 6 GB in twenty minutes."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


class ReasonerTrainer:
    """A reasoner being trained.

    Args:
        data: What it learns from.
        settings: What shapes the weights, ``steps`` set.
        tokenizer: What made the tokens.
        place: Where it is trained.
        identity: What a checkpoint must go with.

    Attributes:
        step: Steps done.
        tokens: Tokens of replies learned from.
        loss: The network with its loss.

    Raises:
        ConfigError: ``base`` cannot be used, or the batches of a step cannot be shared by so many processes.
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
            raise ConfigError(f"compiles is set, and {place.world_size} processes share a step, expected one", "config_invalid")
        compilers = [os.environ.get("CXX", ""), "g++", "clang++"]
        if settings.compiles and place.device.type == "cpu" and not any(map(shutil.which, filter(None, compilers))):
            raise ConfigError(
                "compiles is set, and there is no C++ compiler, expected g++ or clang++; install one, or leave compiles out",
                "config_invalid",
            )
        self.data, self.settings, self.place, self.tokenizer = data, settings, place, tokenizer
        self._identity = identity
        self.loss = ReplyLoss(TrainableNetwork(settings, tokenizer).network, settings)
        place_network(self.loss, place)
        self._parameters = trainable_parameters(self.loss.network)
        self._optimizers = OptimizerSet(self._parameters, settings)
        self.step = self.tokens = 0
        self._batches = self._from(0)

    def _from(self, step: int) -> Iterator[Rows]:
        """Batches of all passes, one after another, from a step on."""
        passes = (batches_of_pass(self.data, self.settings, number) for number in itertools.count())
        return itertools.islice(itertools.chain.from_iterable(passes), step * self.settings.accumulate, None)

    def advance(self, wants_stop: bool = False, wants_save: bool = False) -> StepMetrics:
        """One step.

        Args:
            wants_stop: Whether this process wants to stop after it.
            wants_save: Whether it wants to keep a checkpoint after it.
        """
        batches = list(itertools.islice(self._batches, self.settings.accumulate))
        count = sum(self._replies(rows) for rows in batches)
        figures = torch.tensor([0.0, wants_stop, wants_save], dtype=torch.float64, device=self.place.device)
        world = self.place.world_size
        for rows in batches[self.place.rank :: world]:
            loss = self.loss.of_batch(batch_of(self.data, rows, self._pad), self.place) / count
            (loss * world).backward()  # type: ignore[no-untyped-call]  # sharded gradients come as means over the processes
            figures[0] += loss.detach()
        norm = gather_tensor(torch.nn.utils.clip_grad_norm_(self._parameters.values(), self.settings.clip))
        self._optimizers.step(self.settings.learning_rate_at(self.step))
        self._add_up(figures)
        self.step += 1
        self.tokens += count
        if self.step % _TRIM_EVERY == 0:
            _give_back()
        total, stops, saves = figures.tolist()
        return StepMetrics(total, float(norm), stops > 0, saves > 0)

    @property
    def _pad(self) -> int:
        return int(self.tokenizer.pad_token_id)

    def _replies(self, rows: Rows) -> int:
        examples = list(itertools.chain.from_iterable(rows))
        return int((self.data.start[1:][examples] - self.data.reply[examples]).sum())

    def _add_up(self, figures: Tensor) -> None:
        if self.place.world_size > 1:
            torch.distributed.all_reduce(figures)

    @torch.no_grad()
    def validate(self, data: TokenDataset, most: int) -> dict[str, float]:
        """Nats a token of held-out replies, by kind.

        Args:
            data: The examples.
            most: How many of each kind, the first ones.
        """
        found: dict[str, float] = {}
        for kind in np.unique(data.kind).tolist():
            members = np.flatnonzero(data.kind == kind)[:most]
            batches = batches_in_order(data, members, self.settings)
            total = torch.zeros(1, dtype=torch.float64, device=self.place.device)
            # Sharded weights are gathered by all processes together: where one has no batch left, it does the last once more.
            for turn in range(math.ceil(len(batches) / self.place.world_size)):
                own = turn * self.place.world_size + self.place.rank
                loss = self.loss.of_batch(batch_of(data, batches[min(own, len(batches) - 1)], self._pad), self.place)
                total += loss if own < len(batches) else 0.0
            self._add_up(total)
            found[str(KINDS[kind])] = float(total) / int(data.reply_length[members].sum())
        return found

    def values(self) -> dict[str, Tensor]:
        """What is trained, by name, whole and on the CPU; empty on all processes but the first, which all have to ask."""
        return dict(self._on_first(self._parameters.items()))

    def _on_first(self, items: Any) -> Iterator[tuple[str, Tensor]]:
        for name, value in items:
            whole = gather_tensor(value.detach())
            if self.place.rank == 0:
                yield name, whole.cpu()

    def save(self, path: Path) -> None:
        """Keeps the training where another process can go on with it, in one step; all processes call it."""
        values = self.values()
        averages: dict[str, dict[str, Tensor]] = {}
        for key, name, value in self._optimizers.state():
            averages.setdefault(key, {}).update(self._on_first([(name, value)]))
        if self.place.rank == 0:
            state = {"step": self.step, "tokens": self.tokens, "values": values, "averages": averages}
            save_checkpoint(path, state | {"learning_rates": self._rates(self.step)}, self._about())

    def resume(self, path: Path) -> bool:
        """Goes on where :meth:`save` was called, with any number of processes; False where nothing was kept.

        The run may be longer or shorter than it was to be, as long as the steps that are done would have been the same.

        Raises:
            ConfigError: What is there cannot be read, or is of other settings, data or models.
        """
        state = load_checkpoint(path, self._about(), "step", "tokens", "values", "averages", "learning_rates")
        if state is None:
            return False
        if not torch.equal(state["learning_rates"], self._rates(state["step"])):
            raise ConfigError(
                f"{path}: with steps {self.settings.steps} and cool_down {self.settings.cool_down:g} the {state['step']} steps that "
                "are done would have had other learning rates; take what the run began with, or change it before its cool-down",
                "config_changed",
            )
        self._take(state)
        return True

    def _rates(self, step: int) -> Tensor:
        """Learning rates of the steps before one."""
        return torch.tensor([self.settings.learning_rate_at(k) for k in range(step)], dtype=torch.float64)

    @torch.no_grad()
    def _take(self, state: dict[str, Any]) -> None:
        for name, parameter in self._parameters.items():
            parameter.copy_(shard_like(state["values"][name], parameter))
        self._optimizers.take(state["averages"])
        self.step, self.tokens = state["step"], state["tokens"]
        self._batches = self._from(self.step)

    def _about(self) -> dict[str, Any]:
        settings = {key: value for key, value in asdict(self.settings).items() if key not in ("steps", "cool_down")}
        return {"settings": settings, "identity": asdict(self._identity)}


def train(
    training: ReasonerTrainer,
    *,
    wants_stop: Callable[[], bool],
    wants_save: Callable[[], bool],
    after: Callable[[ReasonerTrainer, StepMetrics], None],
) -> bool:
    """Steps until the run is as long as its settings say, or a process wants to stop.

    Args:
        training: What is trained.
        wants_stop: Asked before each step.
        wants_save: Likewise, whether a checkpoint is to be kept after it.
        after: Called after each step.

    Returns:
        Whether it is done.

    Raises:
        ConfigError: The loss is not finite.
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
