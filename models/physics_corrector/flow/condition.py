"""What the flow is conditioned on, C = (x^c, G) of the paper and the table around it, as plain tensors."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_tensors import SceneTensors

_DIGITS = 1e4  # ranks are by content to a tenth of a millimetre or milliradian: rounding elsewhere seldom reorders objects


@dataclass(frozen=True, slots=True, eq=False)
class Condition(SceneTensors):
    """Scenes as the network sees them: ``poses`` are the coarse poses x^c. Make it with :meth:`of`, which clears the padding."""

    @classmethod
    def of(cls, batch: SceneTensors) -> "Condition":
        """The condition that a batch of scenes states; whatever its padding holds, even nan, is replaced by zeros."""
        there = batch.mask[..., None]
        poses = torch.where(there, batch.poses, 0).float()
        sizes = torch.where(there, batch.sizes, 0).float()
        features = None if batch.features is None else torch.where(there, batch.features, 0).float()
        parent = torch.where(batch.mask, batch.parent, -2)
        zone = torch.where(batch.has_zone[:, None], batch.zone, 0).float()
        is_fixed = batch.is_fixed & batch.mask
        return cls(poses, batch.mask, sizes, is_fixed, parent, batch.table.float(), zone, batch.has_zone, features)

    def content_ranks(self) -> Tensor:
        """Place of each object when a scene's objects are sorted by what they are, (B, N) int64; padding comes last.

        Sorted by coarse x, then y, z, yaw, then size. Permuting a scene's objects permutes their ranks, but for objects that
        agree in all of it: those stand inside each other, and any rule that tells them apart looks at their order.
        """
        yaw = torch.atan2(self.poses[..., 3:].sin(), self.poses[..., 3:].cos())
        keys = torch.round(torch.cat([self.poses[..., :3], yaw, self.sizes], -1) * _DIGITS)
        order = torch.arange(self.mask.shape[1], device=self.mask.device).expand(self.mask.shape)
        for key in (*reversed(keys.unbind(-1)), ~self.mask):  # stable sorts, the weakest key first
            order = order.gather(1, torch.argsort(key.gather(1, order), dim=1, stable=True))
        return torch.argsort(order, dim=1)

    def random_ranks(self, generator: torch.Generator | None = None) -> Tensor:
        """Ranks drawn at random, different for all objects of a scene, (B, N) int64.

        They start at a random number, so that a table of codes taken round and round is trained evenly.
        """
        device = self.mask.device
        order = torch.rand(self.mask.shape, device=device, generator=generator).argsort(1)
        return order + torch.randint(0, 2**16, (len(order), 1), device=device, generator=generator)
