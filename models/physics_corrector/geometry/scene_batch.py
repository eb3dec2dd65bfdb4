"""Scenes as padded tensors, for the network, the losses and the training.

Data of scenes is here; data of shapes is stored once in :class:`~models.physics_corrector.geometry.shape_tensors.ShapeTensors`,
and objects refer to it by index. A whole training set is one batch of some tens of megabytes: ``take`` selects minibatches.

``mask`` is False for padding. Padding is zero, -2 in ``parent``, and no result may depend on it.
"""

from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_tensors import NO_PARENT, ON_TABLE, SceneTensors
from models.physics_corrector.geometry.shape_tensors import ShapeCollector
from stable_data.geometry.shape import Shape
from stable_data.scene import TABLE, Scene, SceneObject


@dataclass(frozen=True, slots=True, eq=False)
class LayoutBatch(SceneTensors):
    """B scenes of at most N objects with the shapes of their objects.

    Attributes:
        shape_index: Index of each object's shape in a ``ShapeTensors``, (B, N) int64.
        coarse: Poses that were proposed in place of ``poses``, (B, N, 4) float32, nan in scenes without a proposal; or None.
    """

    shape_index: Tensor = field(kw_only=True)
    coarse: Tensor | None = field(default=None, kw_only=True)

    @property
    def is_proposed(self) -> Tensor:
        """Whether a scene has a proposal, (B,) bool."""
        return torch.zeros_like(self.has_zone) if self.coarse is None else ~self.coarse[:, 0, 0].isnan()

    @classmethod
    def from_scenes(
        cls,
        scenes: Sequence[Scene],
        shapes: ShapeCollector,
        *,
        is_fixed: Callable[[SceneObject], bool] | None = None,
        num_slots: int = 0,
    ) -> "LayoutBatch":
        """Converts scenes and collects their shapes.

        Args:
            scenes: The scenes, positions at the centres of the boxes.
            shapes: Collects the shapes; its ``geometry()`` afterwards contains them.
            is_fixed: Whether an object must not move; by default none is fixed.
            num_slots: The least N; a scene with more objects enlarges it.
        """
        resolved = [shapes.store.resolved(scene)[:2] for scene in scenes]
        fixed = [frozenset(o.instance for o in scene.objects if is_fixed is not None and is_fixed(o)) for scene in scenes]
        layout = pad_scenes([scene for scene, _ in resolved], [own for _, own in resolved], fixed, num_slots)
        shape_index = np.zeros(layout["mask"].shape, np.int64)
        for b, (scene, own) in enumerate(resolved):
            shape_index[b, : len(own)] = [shapes.index(o, shape) for o, shape in zip(scene.objects, own, strict=True)]
        arrays = {name: torch.from_numpy(value) for name, value in layout.items()}
        return cls(shape_index=torch.from_numpy(shape_index), **arrays)


def pad_scenes(
    scenes: Sequence[Scene], shapes: Sequence[Sequence[Shape]], fixed: Sequence[Set[str]], num_slots: int = 0
) -> dict[str, npt.NDArray[Any]]:
    """Converts scenes to padded arrays.

    Args:
        scenes: The scenes, positions at the centres of the boxes.
        shapes: The geometry of the objects of each scene, in their order.
        fixed: The instances of each scene that must not move.
        num_slots: The least N; a scene with more objects enlarges it.

    Returns:
        ``poses``, ``mask``, ``sizes``, ``is_fixed``, ``parent``, ``table``, ``zone`` and ``has_zone`` of a
        :class:`LayoutBatch`.
    """
    lead = (len(scenes), max([num_slots, *(len(scene.objects) for scene in scenes)]))
    poses, sizes = np.zeros((*lead, 4), np.float32), np.zeros((*lead, 3), np.float32)
    mask, is_fixed, parent = np.zeros(lead, np.bool_), np.zeros(lead, np.bool_), np.full(lead, NO_PARENT)
    zone = np.zeros((len(scenes), 4), np.float32)
    for b, (scene, own, fixed_instances) in enumerate(zip(scenes, shapes, fixed, strict=True)):
        index = {o.instance: n for n, o in enumerate(scene.objects)} | {TABLE: ON_TABLE}
        count = len(scene.objects)
        poses[b, :count], mask[b, :count] = scene.poses(), True
        sizes[b, :count] = np.array([shape.size for shape in own]).reshape(-1, 3)
        is_fixed[b, :count] = [o.instance in fixed_instances for o in scene.objects]
        parent[b, :count] = [NO_PARENT if o.support is None else index.get(o.support, NO_PARENT) for o in scene.objects]
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
