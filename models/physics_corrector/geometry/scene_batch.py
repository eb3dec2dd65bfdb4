"""Scenes as padded tensors: what network, losses, training and `certify` share.

What varies from scene to scene is here; what belongs to a shape lies once in
:class:`~models.physics_corrector.geometry.shape_tensors.ShapeTensors` and is pointed to. A whole training set fits in one
batch of some tens of megabytes: ``take`` cuts minibatches from it.

Padding: ``mask`` alone says what it is. It holds zeros, -2 in ``parent``, and nothing may depend on it.
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
    """B scenes of at most N objects, whose shapes lie in a geometry.

    Attributes:
        shape_index: Shape in the geometry, (B, N) int64.
    """

    shape_index: Tensor = field(kw_only=True)

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
        layout = pad_scenes([scene for scene, _ in resolved], [own for _, own in resolved], fixed, num_slots)
        shape_index = np.zeros(layout["mask"].shape, np.int64)
        for b, (scene, own) in enumerate(resolved):
            shape_index[b, : len(own)] = [shapes.index(o, shape) for o, shape in zip(scene.objects, own, strict=True)]
        arrays = {name: torch.from_numpy(value) for name, value in layout.items()}
        return cls(shape_index=torch.from_numpy(shape_index), **arrays)


def pad_scenes(
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
