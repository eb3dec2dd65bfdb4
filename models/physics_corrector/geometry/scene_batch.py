"""Scenes as padded tensors: what network, losses, training and `certify` share.

What varies from scene to scene is here; what belongs to a shape lies once in
:class:`~models.physics_corrector.geometry.shape_tensors.ShapeTensors` and is pointed to. A whole training set fits in one
batch of some tens of megabytes: ``take`` cuts minibatches from it.

Padding: ``mask`` alone says what it is. It holds zeros, -2 in ``parent``, and nothing may depend on it.
"""

from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.physics_corrector.geometry.shape_tensors import ShapeCollector
from stable_data.geometry.shape import Shape
from stable_data.scene import TABLE, Scene, SceneObject

ON_TABLE = -1
"""The parent of what stands on the table."""

NO_PARENT = -2
"""The parent of what nothing carries, or nobody knows what."""


@dataclass(frozen=True, slots=True, eq=False)
class LayoutBatch:
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
        shapes: ShapeCollector,
        *,
        is_fixed: Callable[[SceneObject], bool] | None = None,
        num_slots: int = 0,
    ) -> "LayoutBatch":
        """Scenes with their shapes.

        Args:
            scenes: The scenes, positions at the centres of the boxes.
            shapes: Where their shapes are collected; ask it for the geometry afterwards.
            is_fixed: Which objects must stay; by default none.
            num_slots: N, at least; more where a scene has more objects.
        """
        resolved = [shapes.store.resolved(scene)[:2] for scene in scenes]
        fixed = [frozenset(o.instance for o in scene.objects if is_fixed is not None and is_fixed(o)) for scene in scenes]
        layout = padded([scene for scene, _ in resolved], [own for _, own in resolved], fixed, num_slots)
        shape_index = np.zeros(layout["mask"].shape, np.int64)
        for b, (scene, own) in enumerate(resolved):
            shape_index[b, : len(own)] = [shapes.index(o, shape) for o, shape in zip(scene.objects, own, strict=True)]
        arrays = {name: torch.from_numpy(value) for name, value in layout.items()}
        return cls(shape_index=torch.from_numpy(shape_index), **arrays)

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.mask)

    @property
    def is_movable(self) -> Tensor:
        """True where there is an object that may move, (B, N) bool."""
        return self.mask & ~self.is_fixed

    def to(self, device: torch.device | str) -> "LayoutBatch":
        """The same on a device."""
        return self._each(lambda value: value.to(device))

    def take(self, scenes: Tensor) -> "LayoutBatch":
        """Some of the scenes, by index (S,) int64 or mask (B,) bool."""
        return self._each(lambda value: value[scenes])

    def _each(self, change: Callable[[Tensor], Tensor]) -> "LayoutBatch":
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: change(value) for name, value in values.items() if value is not None})


def padded(
    scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Set[str]], num_slots: int = 0
) -> dict[str, npt.NDArray[Any]]:
    """Scenes as arrays of one length.

    Args:
        scenes: The scenes, positions at the centres of the boxes.
        shapes: The geometry of their objects, in their order.
        fixed: The instances of each that must stay.
        num_slots: N, at least; more where a scene has more objects.

    Returns:
        ``poses``, ``mask``, ``sizes``, ``is_fixed``, ``parent``, ``table``, ``zone`` and ``has_zone`` of a
        :class:`LayoutBatch`.
    """
    lead = (len(scenes), max([num_slots, *(len(scene.objects) for scene in scenes)]))
    poses, sizes = np.zeros((*lead, 4), np.float32), np.zeros((*lead, 3), np.float32)
    mask, is_fixed, parent = np.zeros(lead, np.bool_), np.zeros(lead, np.bool_), np.full(lead, NO_PARENT)
    zone = np.zeros((len(scenes), 4), np.float32)
    for b, (scene, own, stays) in enumerate(zip(scenes, shapes, fixed, strict=True)):
        place = {o.instance: n for n, o in enumerate(scene.objects)} | {TABLE: ON_TABLE}
        count = len(scene.objects)
        poses[b, :count], mask[b, :count] = scene.poses(), True
        sizes[b, :count] = np.array([shape.size for shape in own]).reshape(-1, 3)
        is_fixed[b, :count] = [o.instance in stays for o in scene.objects]
        parent[b, :count] = [NO_PARENT if o.support is None else place.get(o.support, NO_PARENT) for o in scene.objects]
        zone[b] = scene.table.restricted_zone or 0.0
    return {
        "poses": poses,
        "mask": mask,
        "sizes": sizes,
        "is_fixed": is_fixed,
        "parent": parent,
        "table": np.array([scene.table.size_xy for scene in scenes], np.float32).reshape(-1, 2),
        "zone": zone,
        "has_zone": np.array([scene.table.restricted_zone is not None for scene in scenes], np.bool_),
    }
