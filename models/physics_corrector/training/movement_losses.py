"""Losses for corrected poses near the coarse layout: little movement, and the same directional relations.

They are not in the paper, whose flow aims at the clean scene from which the layout was made. A user needs the nearest clean
layout instead, for which there are no training examples. These terms measure nearness; the physical terms measure cleanness.
They apply to sampled poses only, never to the flow's path to another scene. Heights are excluded: a penalty on them would leave
objects slightly above or below their resting height.
"""

import torch
from torch import Tensor

from models.physics_corrector.flow.pose_coordinates import wrap_angle
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from stable_data.rotations import YAW_ARM
from stable_data.scene_graph.relations import NEAREST, REACH

_SMOOTHING = 2e-3  # ε, metres: the loss is quadratic below this length
_MARGIN = 5e-3  # a relation must hold by at most this much, metres


def movement_loss(poses: Tensor, coarse: Tensor, batch: LayoutBatch) -> Tensor:
    """Computes the movement along the table and in yaw: Σ_i (√(|Δxy|² + (0.1 m/rad Δr)² + ε²) − ε), ε = 2 mm.

    The loss is linear in the length, not quadratic: one object moved by a distance costs no more than two moved by half of it.

    Args:
        poses: (B, N, 4), metres and radians.
        coarse: The coarse poses, in the same form.
        batch: The scenes; their own poses are not read.

    Returns:
        (B,), metres.
    """
    offset = torch.where(batch.is_movable[..., None], poses - coarse, 0)
    squared = offset[..., :2].square().sum(-1) + (YAW_ARM * wrap_angle(offset[..., 3])).square()
    return ((squared + _SMOOTHING**2).sqrt() - _SMOOTHING).sum(1)


def order_loss(poses: Tensor, coarse: Tensor, batch: LayoutBatch) -> Tensor:
    """Computes by how much directional relations of the coarse layout are violated.

    Two objects that the scene graph links are related along x or y, the axis of their larger distance. The margin of the
    relation is the difference of the two distances. The required margin is that of the coarse layout, at most 5 mm.

    Args:
        poses: (B, N, 4), metres and radians.
        coarse: The coarse poses, in the same form.
        batch: The scenes; their own poses are not read.

    Returns:
        (B,), square metres: the sum over pairs of the squared missing margin.
    """
    scene, first, second = _linked(coarse, batch)
    before = coarse[scene, first, :2] - coarse[scene, second, :2]
    after = poses[scene, first, :2] - poses[scene, second, :2]
    is_along_x = before[:, 0].abs() > before[:, 1].abs()
    along = torch.where(is_along_x, before[:, 0], before[:, 1])
    margin_before = along.abs() - torch.where(is_along_x, before[:, 1], before[:, 0]).abs()
    along_after = torch.where(is_along_x, after[:, 0], after[:, 1]) * along.sign()
    margin_after = along_after - torch.where(is_along_x, after[:, 1], after[:, 0]).abs()
    missing = (margin_before.clamp_max(_MARGIN) - margin_after).clamp_min(0)
    return poses.new_zeros(len(poses)).index_add(0, scene, missing.square())


def _linked(coarse: Tensor, batch: LayoutBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Finds pairs that the scene graph links by direction, each once: scene, first and second object, (E,) int64.

    The rule is that of the scene graph: each object is linked to its nearest objects within reach, except support pairs.
    """
    slots = torch.arange(batch.mask.shape[1], device=coarse.device)
    both = batch.mask[:, :, None] & batch.mask[:, None] & (slots[:, None] != slots)
    distance = torch.linalg.vector_norm(coarse[:, :, None, :2] - coarse[:, None, :, :2], dim=-1)
    distance = torch.where(both & (distance <= REACH * batch.table.amax(1)[:, None, None]), distance, torch.inf)
    rank = distance.argsort(dim=2, stable=True).argsort(dim=2)
    near = (rank < NEAREST) & distance.isfinite()
    carries = batch.parent[:, :, None] == slots
    linked = (near | near.transpose(1, 2)) & ~carries & ~carries.transpose(1, 2)
    scene, first, second = linked.triu(1).nonzero(as_tuple=True)
    return scene, first, second
