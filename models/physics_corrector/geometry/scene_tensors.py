"""The tensors of a batch of scenes, shared by geometry, flow and training of the corrector."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from torch import Tensor

ON_TABLE = -1
"""The parent of an object that stands on the table."""

NO_PARENT = -2
"""The parent of an object without a support, or whose support is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneTensors:
    """B scenes of at most N objects, padded.

    Attributes:
        poses: x, y, z of the box's centre in metres and yaw in radians, world frame, (B, N, 4) float32.
        mask: True for objects, False for padding, (B, N) bool.
        sizes: Sizes of the boxes in the yaw frame, (B, N, 3) float32, metres.
        is_fixed: True for objects that must not move, (B, N) bool.
        parent: Index of the object's support in the scene, ON_TABLE or NO_PARENT, (B, N) int64.
        table: Extent of the table along x and y, (B, 2) float32, metres.
        zone: Restricted zone, x_min, x_max, y_min, y_max, (B, 4) float32, metres; zeros if there is none.
        has_zone: Whether a scene has a restricted zone, (B,) bool.
        features: Point features g_i of the objects, (B, N, F) float32, or None if the network uses none.
        texts: Text features of the categories of the objects, (B, N, T) float32, or None.
        table_text: Text features of the kind of table, (B, T) float32, or None.
        error: Expected errors of the poses: standard deviation along x and along y in metres, and of yaw in radians, (B, 2)
            float32, nan where unknown; or None.
        order: Known directions: 1 or -1 at [b, i, j, k] if j is farther along the axis k (x, y) than i, or less far, by more than
            along the other axis; 0 if unknown; (B, N, N, 2) float32, or None.
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
    texts: Tensor | None = None
    table_text: Tensor | None = None
    error: Tensor | None = None
    order: Tensor | None = None

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.mask)

    @property
    def is_movable(self) -> Tensor:
        """True for objects that may move, (B, N) bool."""
        return self.mask & ~self.is_fixed

    def roots(self) -> Tensor:
        """Index of the object on the table that carries each object, itself included, (B, N) int64; -1 if there is none."""
        slots = torch.arange(self.mask.shape[1], device=self.parent.device).expand_as(self.parent)
        root = slots
        for _ in range(self.mask.shape[1]):
            parent = self.parent.gather(1, root)
            above = torch.where(parent >= 0, parent, root)
            if torch.equal(above, root):
                break
            root = above
        return torch.where(self.mask & (self.parent.gather(1, root) == ON_TABLE), root, -1)

    def to(self, device: torch.device | str) -> Self:
        """Copies the tensors to a device."""
        return self._map(lambda value: value.to(device))

    def take(self, scenes: Tensor) -> Self:
        """Selects scenes by index (S,) int64 or mask (B,) bool."""
        return self._map(lambda value: value[scenes])

    def _map(self, change: Callable[[Tensor], Tensor]) -> Self:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: change(value) for name, value in values.items() if value is not None})
