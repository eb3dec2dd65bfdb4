"""The condition of the flow: the paper's C = (x^c, G), and the table, as plain tensors."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_tensors import NO_PARENT, ON_TABLE, SceneTensors

_DIGITS = 1e4  # ranks compare values at 0.1 mm and 0.1 mrad, so that rounding errors seldom change their order


@dataclass(frozen=True, slots=True, eq=False)
class Condition(SceneTensors):
    """Scenes as the network reads them: ``poses`` are the coarse poses x^c. :meth:`of` makes one from a batch."""

    @classmethod
    def of(cls, batch: SceneTensors) -> "Condition":
        """Converts a batch of scenes; values of padding, even nan, become zeros."""
        is_object = batch.mask[..., None]
        poses = torch.where(is_object, batch.poses, 0).float()
        sizes = torch.where(is_object, batch.sizes, 0).float()
        features, texts = (None if f is None else torch.where(is_object, f, 0).float() for f in (batch.features, batch.texts))
        table_text, error = (None if f is None else f.float() for f in (batch.table_text, batch.error))
        order = batch.order
        if order is not None:
            order = torch.where((batch.mask[:, :, None] & batch.mask[:, None])[..., None], order, 0).float()
        parent = torch.where(batch.mask, batch.parent, NO_PARENT)
        zone = torch.where(batch.has_zone[:, None], batch.zone, 0).float()
        is_fixed = batch.is_fixed & batch.mask
        known = {"features": features, "texts": texts, "table_text": table_text, "error": error, "order": order}
        return cls(poses, batch.mask, sizes, is_fixed, parent, batch.table.float(), zone, batch.has_zone, **known)

    def standing(self) -> "Condition":
        """Returns the scenes with objects that may move at heights that follow from their supports.

        Objects on the table stand on it; an object on or in another one keeps its height above that one. Unknown supports change
        nothing.
        """
        height = self.poses[..., 2]
        on_table = self.parent == ON_TABLE
        moves = self.is_movable
        height = torch.where(on_table & moves, self.sizes[..., 2] / 2, height)
        index, has_parent = self.parent.clamp_min(0), (self.parent >= 0) & moves
        above = self.poses[..., 2] - self.poses[..., 2].gather(1, index)
        for _ in range(self.mask.shape[1]):  # each pass lifts one more level of a stack
            lifted = torch.where(has_parent, height.gather(1, index) + above, height)
            if torch.equal(lifted, height):
                break
            height = lifted
        return replace(self, poses=torch.cat([self.poses[..., :2], height[..., None], self.poses[..., 3:]], -1))

    def content_ranks(self) -> Tensor:
        """Ranks of the objects of each scene in an order by content, (B, N) int64; padding is last.

        The order is by coarse x, then y, z, yaw, then size. A permutation of the objects permutes their ranks, except for objects
        that are equal in all of these: they coincide, and only their order in the scene tells them apart.
        """
        yaw = torch.atan2(self.poses[..., 3:].sin(), self.poses[..., 3:].cos())
        keys = torch.round(torch.cat([self.poses[..., :3], yaw, self.sizes], -1) * _DIGITS)
        order = torch.arange(self.mask.shape[1], device=self.mask.device).expand(self.mask.shape)
        for key in (*reversed(keys.unbind(-1)), ~self.mask):  # stable sorts, the last key of the order first
            order = order.gather(1, torch.argsort(key.gather(1, order), dim=1, stable=True))
        return torch.argsort(order, dim=1)

    def random_ranks(self, generator: torch.Generator | None = None) -> Tensor:
        """Draws ranks that differ within each scene, (B, N) int64.

        They start at a random number: the network reads ranks modulo its number of codes, and all codes are trained equally often.
        """
        device = self.mask.device
        order = torch.rand(self.mask.shape, device=device, generator=generator).argsort(1)
        return order + torch.randint(0, 2**16, (len(order), 1), device=device, generator=generator)
