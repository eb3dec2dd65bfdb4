"""The training of a network that moves objects, on coarse layouts made from clean ones: what all such trainings share.

A step depends only on the weights and its number: scenes, prefixes, perturbations and all further draws are from random streams
seeded by (seed, step, chunk). A resumed run therefore equals an uninterrupted one, and the chunks are the same for any number of
processes. Processes share the chunks of a step and sum their gradients in one call; the hooks of torch's DDP do not suit several
passes per step, from self-conditioning and chunks.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import Velocity
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.dataset import TrainingSet
from models.physics_corrector.training.hints import give_hints
from models.physics_corrector.training.layout_settings import LayoutTrainingSettings
from models.physics_corrector.training.perturbation import perturb, reassign_targets
from models.physics_corrector.training.scattering import scatter
from models.physics_corrector.training.stage_prefixes import drop_empty_slots, take_prefix
from models.training.checkpoint import load_checkpoint, save_checkpoint
from models.training.distributed import CPU, ProcessContext
from stable_data.errors import ConfigError

T = TypeVar("T", bound="LayoutTrainer")

_UNKNOWN = 0.5  # share of scattered scenes of whose objects nothing is known but their boxes


@dataclass(frozen=True, slots=True, eq=False)
class CoarseSamples:
    """Clean scenes of a step, and what the network is shown of them.

    Attributes:
        batch: The scenes with their clean poses; scattered ones at their random arrangement.
        condition: The scenes at their coarse poses, as the network reads them.
        targets: The clean poses, with interchangeable objects assigned to the nearest ones, (B, N, 4) float32.
        lots: Further draws of each scene from U[0, 1], (2, B) float32.
    """

    batch: LayoutBatch
    condition: Condition
    targets: Tensor
    lots: Tensor


class LayoutTrainer(ABC):
    """The state of a training; a subclass has the loss.

    Args:
        data: The scenes; copied to the device.
        settings: The training's settings, resolved.
        network: The network with its first weights.
        place: The process and its device.

    Attributes:
        LOGGED: The figures of a step.
        settings: The argument.
        place: The argument.
        data: The scenes, on the device.
        step: Number of completed steps.
        network: The network with its present weights.
        average: The exponential moving average of the weights, by name.
    """

    LOGGED: ClassVar[tuple[str, ...]]

    settings: LayoutTrainingSettings

    def __init__(
        self, data: TrainingSet, settings: LayoutTrainingSettings, network: nn.Module, place: ProcessContext = CPU
    ) -> None:
        self.settings, self.place = settings, place
        self.data = data.to(place.device)
        self._train, self._proposals = data.of_split(0).numpy(), data.proposals_of_split(0).numpy()
        self.network = network.to(place.device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), settings.learning_rate)
        self.average = {name: value.detach().clone() for name, value in self.network.state_dict().items()}
        self.step = 0

    @abstractmethod
    def _loss(self, samples: CoarseSamples, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Computes a chunk's part of the step's loss, and its figures, (len(LOGGED),).

        Args:
            samples: The chunk.
            share: Its share of the step's movable objects.
            generator: Its random generator.
        """

    def advance(self, wants_stop: bool = False) -> tuple[dict[str, float], bool]:
        """Performs one step.

        Args:
            wants_stop: Whether this process wants to stop after the step.

        Returns:
            The figures of the step, over all processes; and whether any process wants to stop.
        """
        for group in self._optimizer.param_groups:
            group["lr"] = self.settings.learning_rate_at(self.step)
        self._optimizer.zero_grad(set_to_none=False)
        figures = torch.zeros(len(self.LOGGED) + 1, device=self.place.device)
        figures[-1] = wants_stop  # summed over the processes with the figures
        for batch, share, generator in self._chunks():
            loss, terms = self._loss(self._samples(batch, generator), share, generator)
            loss.backward()  # type: ignore[no-untyped-call]
            figures[:-1] += terms
        self._sum_over_processes(figures)
        if self.settings.clip:
            nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip)
        self._optimizer.step()
        self._update_average()
        self.step += 1
        *terms_of_step, stops = figures.tolist()
        return dict(zip(self.LOGGED, terms_of_step, strict=True)), stops > 0

    def _chunks(self) -> Iterator[tuple[LayoutBatch, float, torch.Generator]]:
        """Yields this process's chunks: scenes, their share of the step's movable objects, and their random generator."""
        scenes = torch.from_numpy(self._scenes_of_step()).to(self.place.device)
        generator = self._generator(0)
        batch = take_prefix(self.data.take(scenes), self.data.stage[scenes], self.settings.prefixes, generator)
        order = torch.argsort(batch.mask.sum(1), stable=True)  # scenes of similar size share a chunk: little padding
        total = batch.is_movable.sum().clamp_min(1)
        for number, chunk in enumerate(torch.split(order, self.settings.chunk)):
            if number % self.place.world_size == self.place.rank:
                part = drop_empty_slots(batch.take(chunk))
                yield part, float(part.is_movable.sum() / total), self._generator(1 + number)

    def _scenes_of_step(self) -> Any:
        """The scenes and proposals of this step, (batch_size,) int64."""
        size = self.settings.batch_size
        num_proposals = round(self.settings.proposed * size) if len(self._proposals) else 0
        return np.concatenate([self._next(self._train, size - num_proposals), self._next(self._proposals, num_proposals)])

    def _next(self, indices: Any, size: int) -> Any:
        """This step's slice of the sequence of shuffled passes over some scenes, (size,) int64."""
        if not size:
            return indices[:0]
        start, stop = self.step * size, (self.step + 1) * size
        passes = range(start // len(indices), (stop - 1) // len(indices) + 1)
        order = np.concatenate([np.random.default_rng([self.settings.seed, p]).permutation(indices) for p in passes])
        return order[start - passes[0] * len(indices) :][:size]

    def _generator(self, number: int) -> torch.Generator:
        words = np.random.SeedSequence([self.settings.seed, self.step, number]).generate_state(1, np.uint64)
        return torch.Generator(self.place.device).manual_seed(int(words[0] >> np.uint64(1)))  # manual_seed accepts 63 bits

    def _samples(self, batch: LayoutBatch, generator: torch.Generator) -> CoarseSamples:
        """Draws coarse layouts of clean scenes, and what is told of them."""
        settings = self.settings
        lots = torch.rand((4, len(batch)), generator=generator, device=self.place.device)
        is_scattered = (lots[2] < settings.scattered) & ~batch.is_proposed
        if settings.scattered:
            batch = replace(batch, poses=torch.where(is_scattered[:, None, None], scatter(batch, generator), batch.poses))
        coarse = perturb(batch, settings.perturbation, generator)
        targets = reassign_targets(coarse.poses, batch)
        is_unknown = is_scattered & (lots[3] < _UNKNOWN)
        told = give_hints(batch, targets, coarse.error, settings.hints, generator, is_unknown)
        return CoarseSamples(batch, Condition.of(replace(told, poses=coarse.poses)), targets, lots[:2])

    def velocity(self, network: nn.Module | None = None) -> Velocity:
        """Wraps a network, by default the trained one: if it computes in bfloat16, it returns float32."""
        wrapped, device = self.network if network is None else network, self.place.device.type
        if self.settings.precision == "float32" or (self.settings.precision == "auto" and device != "cuda"):
            return wrapped

        def evaluate(y: Tensor, t: Tensor, condition: Condition, ranks: Tensor, y1_hat: Tensor | None) -> Tensor:
            with torch.autocast(device, torch.bfloat16):
                velocity: Tensor = wrapped(y, t, condition, ranks, y1_hat)
            return velocity.float()

        return evaluate

    def averaged(self) -> nn.Module:
        """Returns a network with the averaged weights, in evaluation mode."""
        network = copy.deepcopy(self.network)
        network.load_state_dict(self.average)
        return network.eval()

    def _sum_over_processes(self, figures: Tensor) -> None:
        """Sums gradients and figures over the processes, in place."""
        if self.place.world_size == 1:
            return
        parameters = list(self.network.parameters())
        # A process without a chunk has no gradients yet. All processes must sum the same parameters.
        has_gradient = torch.tensor([p.grad is not None for p in parameters], dtype=torch.float32, device=self.place.device)
        torch.distributed.all_reduce(has_gradient)
        gradients = []
        for parameter, is_summed in zip(parameters, has_gradient.tolist(), strict=True):
            if is_summed:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                gradients.append(parameter.grad)
        flat = torch.cat([*(g.flatten() for g in gradients), figures])
        torch.distributed.all_reduce(flat)
        *parts, summed = torch.split(flat, [*(g.numel() for g in gradients), len(figures)])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))
        figures.copy_(summed)

    @torch.no_grad()
    def _update_average(self) -> None:
        decay = min(self.settings.ema, (1 + self.step) / (10 + self.step))  # the initial weights lose their influence quickly
        for name, value in self.network.state_dict().items():
            if value.is_floating_point():
                self.average[name].lerp_(value, 1 - decay)
            else:
                self.average[name].copy_(value)

    def save(self, path: Path) -> None:
        """Writes a checkpoint of the training atomically."""
        state = {
            "step": self.step,
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "average": self.average,
        }
        save_checkpoint(path, state, self._about())

    def resume(self, path: Path) -> bool:
        """Restores the state of :meth:`save`; returns False if there is no file.

        Raises:
            ConfigError: The file cannot be read (``checkpoint_invalid``), or has other settings or data (``config_changed``).
        """
        state = load_checkpoint(path, self._about(), "step", "network", "optimizer", "average")
        if state is None:
            return False
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.average = {name: value.to(self.place.device) for name, value in state["average"].items()}
        self.step = state["step"]
        return True

    def _about(self) -> dict[str, Any]:
        data = self.data
        return self.settings.flat() | {"data": data.fingerprint, "encoder": data.encoder, "text_encoder": data.text_encoder}


def seeded_network(seed: int, build: Callable[[], nn.Module]) -> nn.Module:
    """Builds an untrained network whose weights are drawn from a seed; the caller's random state stays."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return build()


def train(
    training: T,
    *,
    wants_stop: Callable[[], bool],
    after: Callable[[T, dict[str, float]], None],
) -> bool:
    """Trains until the number of steps is reached or a process wants to stop.

    Args:
        training: The training.
        wants_stop: Called before each step; True stops all processes after it.
        after: Called after each step with its figures.

    Returns:
        Whether the training is complete.

    Raises:
        ConfigError: The loss is not finite (``training_diverged``).
    """
    stops = False
    while not stops and training.step < training.settings.steps:
        figures, stops = training.advance(wants_stop())
        if not all(map(np.isfinite, figures.values())):
            raise ConfigError(
                f"step {training.step}: the loss is not finite ({figures}); lower learning_rate, or the weights of the losses",
                "training_diverged",
            )
        after(training, figures)
    return training.step >= training.settings.steps
