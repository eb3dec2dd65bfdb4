"""Scenes as padded tensors: what network, losses, training and `certify` share.

What varies from scene to scene is here; what belongs to a shape lies once in :class:`~models.physics_corrector.geometry.Geometry`
and is pointed to. A whole training set fits in one batch of some tens of megabytes: ``take`` cuts minibatches from it.

Padding: ``mask`` alone says what it is. It holds zeros, -2 in ``parent``, and nothing may depend on it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from models.physics_corrector.geometry import ShapeTable
from stable_data.scene import TABLE, Scene, SceneObject

ON_TABLE = -1
"""The parent of what stands on the table."""

NO_PARENT = -2
"""The parent of what nothing carries, or nobody knows what."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneBatch:
    """B scenes of at most N objects.

    Attributes:
        poses: x, y, z of the box's centre in metres and yaw in radians, world frame, (B, N, 4) float32.
        mask: True where there is an object, (B, N) bool.
        sizes: Box in the yaw frame, (B, N, 3) float32, metres.
        shape_index: Shape in the geometry, (B, N) int64.
        is_fixed: True where an object must stay where it is, (B, N) bool.
        parent: The object that carries this one, by its place in the scene, ON_TABLE or NO_PARENT, (B, N) int64.
        table: Extent of the table along x and y, (B, 2) float32, metres.
        zone: Restricted zone, x_min, x_max, y_min, y_max, (B, 4) float32, metres; zeros where there is none.
        has_zone: Whether a scene has one, (B,) bool.
        features: Point features of the objects, (B, N, F) float32, or None where the network uses none.
    """

    poses: Tensor
    mask: Tensor
    sizes: Tensor
    shape_index: Tensor
    is_fixed: Tensor
    parent: Tensor
    table: Tensor
    zone: Tensor
    has_zone: Tensor
    features: Tensor | None = None

    @classmethod
    def from_scenes(
        cls,
        scenes: Sequence[Scene],
        shapes: ShapeTable,
        *,
        is_fixed: Callable[[SceneObject], bool] | None = None,
        num_slots: int = 0,
    ) -> "SceneBatch":
        """Scenes with their shapes.

        Args:
            scenes: The scenes, positions at the centres of the boxes.
            shapes: Where their shapes are collected; ask it for the geometry afterwards.
            is_fixed: Which objects must stay; by default none.
            num_slots: N, at least; more where a scene has more objects.
        """
        num_slots = max(num_slots, *(len(scene.objects) for scene in scenes), 0) if scenes else num_slots
        lead = (len(scenes), num_slots)
        poses, sizes = np.zeros((*lead, 4), np.float32), np.zeros((*lead, 3), np.float32)
        mask, fixed = np.zeros(lead, np.bool_), np.zeros(lead, np.bool_)
        shape_index, parent = np.zeros(lead, np.int64), np.full(lead, NO_PARENT)
        zone = np.zeros((len(scenes), 4), np.float32)
        for b, scene in enumerate(scenes):
            resolved, scene_shapes, _ = shapes.store.resolved(scene)
            place = {o.instance: n for n, o in enumerate(scene.objects)} | {TABLE: ON_TABLE}
            count = len(scene.objects)
            poses[b, :count], mask[b, :count] = resolved.poses(), True
            zone[b] = scene.table.restricted_zone or 0.0
            for n, (o, shape) in enumerate(zip(resolved.objects, scene_shapes, strict=True)):
                shape_index[b, n], sizes[b, n] = shapes.index(o, shape), shape.size
                fixed[b, n] = is_fixed is not None and is_fixed(o)
                parent[b, n] = NO_PARENT if o.support is None else place.get(o.support, NO_PARENT)
        table = np.array([scene.table.size_xy for scene in scenes], np.float32).reshape(-1, 2)
        has_zone = np.array([scene.table.restricted_zone is not None for scene in scenes], np.bool_)
        arrays = (poses, mask, sizes, shape_index, fixed, parent, table, zone, has_zone)
        return cls(*map(torch.from_numpy, arrays))

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.mask)

    @property
    def is_movable(self) -> Tensor:
        """True where there is an object that may move, (B, N) bool."""
        return self.mask & ~self.is_fixed

    def to(self, device: torch.device | str) -> "SceneBatch":
        """The same on a device."""
        return self._each(lambda value: value.to(device))

    def take(self, scenes: Tensor) -> "SceneBatch":
        """Some of the scenes, by index (S,) int64 or mask (B,) bool."""
        return self._each(lambda value: value[scenes])

    def _each(self, change: Callable[[Tensor], Tensor]) -> "SceneBatch":
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: change(value) for name, value in values.items() if value is not None})
