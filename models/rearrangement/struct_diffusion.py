"""A pose diffusion after StructDiffusion (Liu et al. 2022, arXiv 2211.04604): draws the poses of all objects of a scene together.

Training is that of DDPM: the clean poses of the objects, as displacements from the perturbed layout, get noise of a random level, and the
network predicts this noise from the noisy poses, the level, the objects' features and the perturbed layout. Inference starts from noise
and draws several samples, of which a score chooses one (:mod:`~models.rearrangement.selection`).

What differs from the paper: the condition is the perturbed layout, since there is no instruction; poses are displacements from it, with yaw
as their only rotation; the network is that of the corrector, with its features of shapes instead of point clouds; noise levels follow the
cosine schedule, because the published rates leave 13 % of the signal at the last of 200 levels (``schedule=published`` has them); clean
places that are estimated during sampling are limited to the table, which the published sampler does not do; and geometry replaces the
learned discriminator: the paper's classifier of collisions between two point clouds estimates what is computed here.
"""

import math
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import Velocity
from models.physics_corrector.flow.heights import at_first_heights, without_heights
from models.rearrangement.noise_schedule import NoiseSchedule
from models.rearrangement.scene_noise import SceneNoise
from models.rearrangement.settings import RearrangerSettings


class StructDiffusion:
    """Loss and sampler; it depends on no network, only on a function of its form.

    Args:
        settings: The settings.

    Attributes:
        settings: The argument.
        schedule: The noise levels.
        num_samples: Samples of a scene.
    """

    def __init__(self, settings: RearrangerSettings) -> None:
        own = settings.struct_diffusion
        self.settings, self.num_samples = settings, own.samples
        self.schedule = NoiseSchedule.of(own.times, own.schedule)

    def loss(self, network: Velocity, condition: Condition, targets: Tensor, generator: torch.Generator) -> Tensor:
        """Computes the Huber loss of the predicted noise, sum over coordinates, mean over movable objects.

        Args:
            network: The network.
            condition: The scenes at their coarse poses.
            targets: Clean poses, (B, N, 4).
            generator: Draws levels, noise and instance codes.

        Returns:
            A scalar.
        """
        coarse = at_first_heights(condition, self.settings.heights)
        movable = condition.is_movable[..., None]
        y0 = torch.where(movable, self._free(self.settings.coordinates.encode(targets, coarse.poses)), 0)
        device = y0.device
        levels = torch.randint(1, self.schedule.times + 1, (len(y0),), generator=generator, device=device)
        noise = torch.where(movable, self._free(torch.randn(y0.shape, generator=generator, device=device)), 0)
        y, t = self.schedule.noised(y0, noise, levels), levels.float() / self.schedule.times
        found = self._free(network(y, t, coarse, coarse.random_ranks(generator), None))
        error = torch.where(movable, found - noise, 0)
        return F.huber_loss(error, torch.zeros_like(error), reduction="sum") / condition.is_movable.sum().clamp_min(1)

    def sample(self, network: Velocity, condition: Condition, noise: SceneNoise) -> Tensor:
        """Draws poses for the objects of scenes; returns (B, N, 4), coarse ones for fixed objects.

        Args:
            network: The network.
            condition: The scenes at their coarse poses.
            noise: The draws of the start and of ancestral steps.
        """
        own, coarse = self.settings.struct_diffusion, at_first_heights(condition, self.settings.heights)
        ranks, movable = coarse.content_ranks(), coarse.is_movable[..., None]
        y = torch.where(movable, self._free(noise.draw()), 0)
        levels, (low, high) = self.schedule.levels(own.steps), self._bounds(coarse)
        for level, lower in pairwise(levels):
            t = y.new_full((len(y),), level / self.schedule.times)
            found = self._free(network(y, t, coarse, ranks, None))
            y0 = self.schedule.clean(y, found, level).clamp(low, high)
            is_drawn = own.sampler == "ancestral" and lower > 0
            y = self.schedule.step(y, y0, level, lower, self._free(noise.draw()) if is_drawn else None)
            y = torch.where(movable, y, 0)
        return torch.where(movable, self.settings.coordinates.decode(y, coarse.poses), condition.poses)

    def _bounds(self, coarse: Condition) -> tuple[Tensor, Tensor]:
        """Least and largest coordinates of clean poses, (B, N, 4) each: on the table, not higher than it is long, within half a turn.

        At the highest levels, a small error of the noise is a large one of the estimate.
        """
        coordinates, height = self.settings.coordinates, coarse.table.amax(-1, keepdim=True)
        corner = torch.cat([coarse.table, height], -1)[:, None]
        half_turn = torch.full_like(coarse.poses[..., 3:], math.pi / coordinates.yaw_unit)
        low, high = ((end - coarse.poses[..., :3]) / coordinates.length_unit for end in (0, corner))
        return self._free(torch.cat([low, -half_turn], -1)), self._free(torch.cat([high, half_turn], -1))

    def _free(self, change: Tensor) -> Tensor:
        return without_heights(change, self.settings.heights)
