"""The training of the corrector: L_PC on coarse layouts made from clean ones."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from models.physics_corrector.flow.checkpoint import load_corrector
from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import FlowMatching
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.training.dataset import TrainingSet
from models.physics_corrector.training.layout_trainer import CoarseSamples, LayoutTrainer, seeded_network
from models.physics_corrector.training.losses import flow_loss, physics_losses
from models.physics_corrector.training.settings import CorrectorTrainingSettings
from models.training.distributed import CPU, ProcessContext
from stable_data.errors import ConfigError


class CorrectorTrainer(LayoutTrainer):
    """The state of a corrector's training.

    The figures of a step are the weighted terms of the loss, and the unweighted physical terms per scene.

    Args:
        data: The scenes; copied to the device.
        settings: The training's settings, resolved.
        place: The process and its device.

    Attributes:
        flow: The flow of the network.
    """

    LOGGED = ("flow", "physics", "object_object", "object_table", "support", "unrolled", "total")

    settings: CorrectorTrainingSettings

    def __init__(self, data: TrainingSet, settings: CorrectorTrainingSettings, place: ProcessContext = CPU) -> None:
        network = seeded_network(settings.seed, lambda: settings.corrector.build()[0])
        self.flow = FlowMatching(settings.corrector.flow)
        if settings.initial:
            network.load_state_dict(_initial_state(settings, data))
        super().__init__(data, settings, network, place)

    def _loss(self, samples: CoarseSamples, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """See the base class."""
        settings = self.settings
        batch, condition, targets, lots = samples.batch, samples.condition, samples.targets, samples.lots
        strength = settings.physics_at(self.step)
        zero = torch.zeros((), device=self.place.device)
        flow, estimate = zero, None
        if settings.losses.flow_weight or settings.physics.share:
            path = self.flow.path(condition, targets, generator)
            predicted = self.flow.predict(self.velocity(), path, condition, generator)
            flow = settings.losses.flow_weight * share * flow_loss(predicted.velocity, path.velocity, condition.is_movable)
            estimate = self._at_heights(predicted.poses, targets), path.t
        physics = zero
        terms: tuple[Tensor, ...] = (zero, zero, zero)
        if strength and settings.physics.share and estimate is not None:
            poses, t = estimate
            chosen = (lots[0] < settings.physics.share) & (t > settings.physics.from_time)
            weight = strength * t[chosen] ** settings.physics.power
            physics, terms = self._physics(poses[chosen], batch.take(chosen), weight, settings.physics.share)
        unrolled = zero
        if strength and settings.is_unrolled_at(self.step):
            sampled = lots[1] < settings.physics.unroll_scenes
            unrolled = self._unrolled(batch.take(sampled), condition.take(sampled), targets[sampled], generator)
        total = flow + physics + unrolled
        return total, torch.stack([flow, physics, *terms, unrolled, total]).detach()

    def _unrolled(self, batch: LayoutBatch, condition: Condition, targets: Tensor, generator: torch.Generator) -> Tensor:
        """Computes the loss of poses that are sampled as at inference, with gradients of the last solver steps."""
        settings = self.settings.physics
        start = generator if self.settings.corrector.flow.source == "gaussian" else None
        poses = self.flow.sample(self.velocity(), condition, generator=start, gradient_steps=settings.unroll_gradient)
        weight = poses.new_full((len(poses),), settings.unroll_weight)
        return self._physics(self._at_heights(poses, targets), batch, weight, settings.unroll_scenes)[0]

    def _at_heights(self, poses: Tensor, targets: Tensor) -> Tensor:
        """Puts poses at the clean heights, if the flow leaves heights to geometry."""
        if self.settings.corrector.flow.heights == "learned":
            return poses
        return torch.cat([poses[..., :2], targets[..., 2:3], poses[..., 3:]], -1)

    def _physics(self, poses: Tensor, batch: LayoutBatch, weight: Tensor, share: float) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Estimates the mean over the step's scenes of the weighted physical loss, and of its terms, from a share of the scenes.

        Args:
            poses: Estimates or samples of clean poses, (S, N, 4).
            batch: Their scenes.
            weight: Weight of each scene, (S,).
            share: Expected share of the step's scenes among these.
        """
        scale = 1 / (share * self.settings.batch_size)
        losses = physics_losses(poses, batch, self.data.geometry, self.settings.losses)
        of_scene, limit = losses.weighted(self.settings.losses), self.settings.physics.limit
        of_scene = limit * torch.log1p(of_scene / limit) if limit else of_scene
        terms = (losses.object_object, losses.object_table, losses.support)
        return scale * (weight * of_scene).sum(), tuple(scale * term.sum() for term in terms)


def _initial_state(settings: CorrectorTrainingSettings, data: TrainingSet) -> dict[str, Any]:
    """Reads the initial weights of a training; refuses another network or other features."""
    path = Path(settings.initial).expanduser()
    found = load_corrector(path)
    expected = replace(found.settings, network=settings.corrector.network)  # the settings of the flow may differ
    if changed := found.settings.differences(expected):
        raise ConfigError(
            f"initial: {path} has another network ({'; '.join(changed)}), expected the one that is trained",
            "checkpoint_mismatch",
        )
    for note, encoder in (("encoder_fingerprint", data.encoder), ("text_encoder_fingerprint", data.text_encoder)):
        if (initial := found.notes.get(note, "")) != encoder:
            raise ConfigError(
                f"initial: {path} reads the features of encoder {initial or 'none'}, the run has those of {encoder or 'none'}; "
                "preprocess the run with the same encoder",
                "encoder_mismatch",
            )
    return dict(found.network.state_dict())
