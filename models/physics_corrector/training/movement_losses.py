"""Losses that keep corrected poses near the coarse layout: little movement, and the order of things side by side.

Not in the paper, whose flow goes to the scene that the layout was made of. What a user wants is the nearest clean layout, of
which there are no examples to learn from; these terms say what is near, beside the physical ones that say what is clean. They
are taken on poses that the sampler gives, never on the flow's path to another scene. Heights are left to the physical terms
alone: a price on them would leave everything a little above or below where it rests.
"""

import torch
from torch import Tensor

from models.physics_corrector.flow.pose_coordinates import wrap_angle
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from stable_data.rotations import YAW_ARM
from stable_data.scene_graph.relations import NEAREST, REACH

_EASE = 2e-3  # below this length a movement costs its square, metres
_MARGIN = 5e-3  # by which an order is to hold, where it did, metres


def movement_loss(poses: Tensor, coarse: Tensor, batch: LayoutBatch) -> Tensor:
    """How far objects were moved along the table and turned: Σ_i (√(|Δxy|² + (0.1 m/rad Δr)² + ε²) − ε), ε = 2 mm.

    It grows with the length and not with its square: one object that goes all the way is no worse than two that go half of it.

    Args:
        poses: (B, N, 4), metres and radians.
        coarse: The coarse poses, the same.
        batch: The scenes; their own poses are not read.

    Returns:
        (B,), metres.
    """
    offset = torch.where(batch.is_movable[..., None], poses - coarse, 0)
    squared = offset[..., :2].square().sum(-1) + (YAW_ARM * wrap_angle(offset[..., 3])).square()
    return ((squared + _EASE**2).sqrt() - _EASE).sum(1)


def order_loss(poses: Tensor, coarse: Tensor, batch: LayoutBatch) -> Tensor:
    """By how much directional relations of the coarse layout are broken.

    Two objects that the scene graph would link are beside each other along x or y, whichever they are farther apart along; the
    relation holds by the difference of the two distances. Asked is what it held by, at most 5 mm.

    Args:
        poses: (B, N, 4), metres and radians.
        coarse: The coarse poses, the same.
        batch: The scenes; their own poses are not read.

    Returns:
        (B,), square metres: Σ of the squares of what is missing, each pair once.
    """
    scene, first, second = _linked(coarse, batch)
    before = coarse[scene, first, :2] - coarse[scene, second, :2]
    after = poses[scene, first, :2] - poses[scene, second, :2]
    is_along_x = before[:, 0].abs() > before[:, 1].abs()
    along = torch.where(is_along_x, before[:, 0], before[:, 1])
    held_by = along.abs() - torch.where(is_along_x, before[:, 1], before[:, 0]).abs()
    now = torch.where(is_along_x, after[:, 0], after[:, 1]) * along.sign()
    holds_by = now - torch.where(is_along_x, after[:, 1], after[:, 0]).abs()
    missing = (held_by.clamp_max(_MARGIN) - holds_by).clamp_min(0)
    return poses.new_zeros(len(poses)).index_add(0, scene, missing.square())


def _linked(coarse: Tensor, batch: LayoutBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs that the scene graph links by direction, each once: scene, first and second object, (E,) int64.

    As there, each object has its nearest ones within reach; what carries the other is above or below it instead.
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
