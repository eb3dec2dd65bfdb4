"""LEGO-Net (Wei et al. 2023, arXiv 2301.09629) on poses in 3D: iterative denoising of a layout by predicted displacements.

Training: a clean layout x is perturbed at a scale that differs from scene to scene, and the network predicts from the perturbed layout x̃
alone the displacement of every object to its clean place, f(x̃) ≈ x − x̃. The network is told neither the scale nor a time.

Inference is close to Langevin dynamics: x_{k+1} = x_k + α_k f(x_k) + β_k z, z ~ N(0, I), with α_k = α_0 / (1 + a k) and β_k that falls
by a factor every few steps. A scene is finished when its predicted displacements were small at some successive steps.

What differs from the paper: the network is that of the corrector (with features of shapes, categories as text features, table and
supports) instead of a transformer with a floor plan; the errors of the training are those of the corrector's training; the network
predicts the displacement and not the clean pose, which are the same loss; the limits for finished scenes are means over the objects.
The paper assigns the objects of a class to clean places by the earth mover's distance; here only objects of one shape and one parent
that carry nothing exchange their places.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import Velocity
from models.physics_corrector.flow.heights import at_first_heights, without_heights
from models.rearrangement.scene_noise import SceneNoise
from models.rearrangement.settings import RearrangerSettings


@dataclass(frozen=True, slots=True)
class LegoNet:
    """Loss and iteration; it depends on no network, only on a function of its form.

    Attributes:
        settings: The settings.
        num_samples: Samples of a scene.
    """

    num_samples: ClassVar[int] = 1

    settings: RearrangerSettings

    def loss(self, network: Velocity, condition: Condition, targets: Tensor, generator: torch.Generator) -> Tensor:
        """Computes the error of the predicted displacements: squared and absolute, sum over coordinates, mean over movable objects.

        Args:
            network: The network.
            condition: The scenes at their coarse poses x̃.
            targets: Clean poses x, (B, N, 4).
            generator: Draws the instance codes.

        Returns:
            A scalar, in squares of coordinate units.
        """
        coarse = at_first_heights(condition, self.settings.heights)
        movable = condition.is_movable
        wanted = self.settings.coordinates.encode(targets, coarse.poses)
        found = self._displacement(network, coarse, coarse.random_ranks(generator))
        error = torch.where(movable[..., None], found - without_heights(wanted, self.settings.heights), 0)
        return (error.square() + self.settings.lego_net.l1_weight * error.abs()).sum() / movable.sum().clamp_min(1)

    def sample(self, network: Velocity, condition: Condition, noise: SceneNoise) -> Tensor:
        """Moves the objects of perturbed layouts until they are still; returns poses (B, N, 4), coarse ones for fixed objects.

        Args:
            network: The network.
            condition: The scenes at their coarse poses.
            noise: The draws z.
        """
        settings, coordinates = self.settings.lego_net, self.settings.coordinates
        begin = at_first_heights(condition, self.settings.heights)
        ranks, movable, poses = begin.content_ranks(), begin.is_movable, begin.poses
        count = movable.sum(1).clamp_min(1)
        unit = poses.new_tensor([coordinates.length_unit] * 3 + [coordinates.yaw_unit])
        scale = poses.new_tensor([settings.noise] * 3 + [settings.noise_yaw]) / unit
        num_still, is_finished = torch.zeros_like(count), torch.zeros_like(count, dtype=torch.bool)
        for k in range(settings.max_steps):
            displacement = self._displacement(network, replace(begin, poses=poses), ranks)
            lengths = (displacement * unit)[..., :3].norm(dim=-1).sum(1) / count
            turns = (displacement * unit)[..., 3].abs().sum(1) / count
            is_still = (lengths < settings.still) & (turns < settings.still_yaw)
            is_finished |= num_still + is_still >= settings.still_steps
            num_still = torch.where(is_still, num_still + 1, 0)
            moves = movable & ~is_finished[:, None]
            if not moves.any():
                break
            rate = settings.step / (1 + settings.step_decay * k)
            spread = settings.noise_decay ** (k // settings.noise_steps)
            change = rate * displacement + spread * without_heights(scale * noise.draw(), self.settings.heights)
            poses = torch.where(moves[..., None], coordinates.decode(change, poses), poses)
        return torch.where(movable[..., None], poses, condition.poses)

    def _displacement(self, network: Velocity, condition: Condition, ranks: Tensor) -> Tensor:
        """The predicted displacement of every object from where it is, (B, N, 4) coordinate units; 0 for fixed ones."""
        here = torch.zeros_like(condition.poses)
        return without_heights(network(here, here.new_zeros(len(here)), condition, ranks, None), self.settings.heights)
