"""The queries of one step of pre-training, distances around shapes and clearances of pairs, with their labels."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from models.point_encoder.boxes import box_clearance
from models.point_encoder.pretraining_data import PosedShape, ShapePair, TrainingShape

DISTANCE_LIMIT = 0.25
"""Distances are clipped at this, in units of half the largest extent."""

CLEARANCE_LIMIT = 0.4
"""Clearances are clipped at this, in a pair's unit: the mean of the two objects' half largest extents."""


@dataclass(frozen=True, slots=True, eq=False)
class PretrainingTargets:
    """Shapes and pairs of a batch with their labels.

    Attributes:
        posed: The shapes, B of them.
        proportions: Logarithms of the box's sides over half the largest, (B, 3).
        places: Query points, in units of half the largest extent, (B, Q, 3).
        distances: Signed distances there, in units of ``DISTANCE_LIMIT``, within [-1, 1], (B, Q).
        first: Index of each pair's first shape, (R,) int64.
        second: Index of each pair's second shape, (R,) int64.
        boxes: Logarithms of the sides of both boxes in the pair's unit, (R, 6).
        poses: Pose of the second in the frame of the first: offset in the pair's unit, cosine and sine of yaw, (R, 5).
        clearances: Clearances in units of ``CLEARANCE_LIMIT``, within [-1, 1], (R,).
        box_clearances: Clearances of the boxes, in the same form, (R,).
        units: Metres per pair's unit, (R,).
    """

    posed: Sequence[PosedShape]
    proportions: Tensor
    places: Tensor
    distances: Tensor
    first: Tensor
    second: Tensor
    boxes: Tensor
    poses: Tensor
    clearances: Tensor
    box_clearances: Tensor
    units: Tensor

    def to(self, device: torch.device | str) -> "PretrainingTargets":
        """Copies the tensors to a device."""
        moved = {f.name: getattr(self, f.name).to(device) for f in fields(self) if f.name != "posed"}
        return replace(self, **moved)


def draw_targets(
    shapes: Sequence[TrainingShape], num_queries: int, pairs_a_shape: int, rng: np.random.Generator
) -> PretrainingTargets:
    """Draws a pose of each shape, queries around it, and pairs: each shape with the next ``pairs_a_shape`` of the list."""
    posed = [PosedShape.sample(shape, rng) for shape in shapes]
    sizes = np.stack([p.cloud.size for p in posed]).astype(np.float64)
    half = sizes.max(axis=1) / 2
    places, distances = [], []
    for p, h in zip(posed, half, strict=True):
        chosen = rng.choice(len(p.shape.queries), num_queries, replace=False)
        places.append(p.transform(p.shape.queries[chosen]) / h)
        distances.append(p.shape.distances[chosen] / h)
    first = np.tile(np.arange(len(posed)), pairs_a_shape)
    second = (first + np.repeat(np.arange(1, pairs_a_shape + 1), len(posed))) % len(posed)
    pairs = [ShapePair.sample(posed[i], posed[j], rng) for i, j in zip(first, second, strict=True)]
    units = (half[first] + half[second]) / 2
    offsets = np.stack([pair.offset for pair in pairs]) / units[:, None]
    yaws = np.array([pair.yaw for pair in pairs])
    clearances = np.array([pair.clearance for pair in pairs]) / units / CLEARANCE_LIMIT
    boxes = _tensor(_log(np.concatenate([sizes[first], sizes[second]], axis=1) / units[:, None]))
    poses = _tensor(np.concatenate([offsets, np.cos(yaws)[:, None], np.sin(yaws)[:, None]], axis=1))
    return PretrainingTargets(
        posed,
        proportions=_tensor(_log(sizes / half[:, None])),
        places=_tensor(np.stack(places)),
        distances=_tensor(np.clip(np.stack(distances) / DISTANCE_LIMIT, -1, 1)),
        first=torch.from_numpy(first),
        second=torch.from_numpy(second),
        boxes=boxes,
        poses=poses,
        clearances=_tensor(np.clip(clearances, -1, 1)),
        box_clearances=(box_clearance(boxes.exp(), poses) / CLEARANCE_LIMIT).clamp(-1, 1),
        units=_tensor(units),
    )


def _tensor(values: np.ndarray[Any, Any]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _log(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Logarithms with a lower bound, which flat objects need."""
    logs: np.ndarray[Any, Any] = np.log(np.maximum(values, 1e-3))
    return logs
