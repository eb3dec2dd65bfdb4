"""What the flow is conditioned on, C = (x^c, G) of the paper and the table around it, as plain tensors."""

from dataclasses import dataclass, fields, replace
from typing import Protocol

import torch
from torch import Tensor

_DIGITS = 1e4  # ranks are by content to a tenth of a millimetre or milliradian: rounding elsewhere seldom reorders objects


class _Batch(Protocol):
    """The part of a batch of scenes that is read here."""

    @property
    def poses(self) -> Tensor: ...
    @property
    def mask(self) -> Tensor: ...
    @property
    def sizes(self) -> Tensor: ...
    @property
    def is_fixed(self) -> Tensor: ...
    @property
    def parent(self) -> Tensor: ...
    @property
    def table(self) -> Tensor: ...
    @property
    def zone(self) -> Tensor: ...
    @property
    def has_zone(self) -> Tensor: ...
    @property
    def features(self) -> Tensor | None: ...


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """B scenes of at most N objects as the network sees them. Make it with :meth:`of`, which clears the padding.

    Attributes:
        poses: Coarse poses x^c: x, y, z in metres and yaw in radians, world frame, (B, N, 4) float32.
        mask: True where there is an object, (B, N) bool.
        sizes: Box in the yaw frame, (B, N, 3) float32, metres.
        is_fixed: True where an object must stay where it is, (B, N) bool.
        parent: The object that carries this one by its place in the scene, -1 the table, -2 nothing, (B, N) int64.
        table: Extent of the table along x and y, (B, 2) float32, metres.
        zone: Restricted zone, x_min, x_max, y_min, y_max, (B, 4) float32, metres.
        has_zone: Whether a scene has one, (B,) bool.
        features: Point features g_i of the objects, (B, N, F) float32, or None where the network uses none.
    """

    poses: Tensor
    mask: Tensor
    sizes: Tensor
    is_fixed: Tensor
    parent: Tensor
    table: Tensor
    zone: Tensor
    has_zone: Tensor
    features: Tensor | None = None

    @classmethod
    def of(cls, batch: _Batch) -> "Condition":
        """The condition that a batch of scenes states; whatever its padding holds, even nan, is replaced by zeros."""
        there = batch.mask[..., None]
        poses = torch.where(there, batch.poses, 0).float()
        sizes = torch.where(there, batch.sizes, 0).float()
        features = None if batch.features is None else torch.where(there, batch.features, 0).float()
        parent = torch.where(batch.mask, batch.parent, -2)
        zone = torch.where(batch.has_zone[:, None], batch.zone, 0).float()
        is_fixed = batch.is_fixed & batch.mask
        return cls(poses, batch.mask, sizes, is_fixed, parent, batch.table.float(), zone, batch.has_zone, features)

    @property
    def is_movable(self) -> Tensor:
        """True where there is an object that may move, (B, N) bool."""
        return self.mask & ~self.is_fixed

    def to(self, device: torch.device | str) -> "Condition":
        """The same on a device."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: value.to(device) for name, value in values.items() if value is not None})

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
