"""Clearance of the boxes of two objects: the estimate without their shapes."""

import torch
from torch import Tensor

_TICKS = 9  # along each edge of a box


def box_clearance(boxes: Tensor, poses: Tensor) -> Tensor:
    """Computes the smallest signed distance between samples of one upright box and the other box, (R,), as in the labels.

    Args:
        boxes: Sizes of the first and the second box, (R, 6).
        poses: Pose of the second box in the frame of the first: offset, cosine and sine of yaw, (R, 5).
    """
    ticks = torch.linspace(-1, 1, _TICKS, device=boxes.device)
    grid = torch.cartesian_prod(ticks, ticks, ticks)
    surface = grid[grid.abs().amax(1) == 1]  # (P, 3)
    first, second = (boxes[:, None, k : k + 3] / 2 for k in (0, 3))
    offset, (c, s) = poses[:, None, :3], (poses[:, 3, None], poses[:, 4, None])
    to_first = _box_distance(_rotate(second * surface, c, s) + offset, first)
    to_second = _box_distance(_rotate(first * surface - offset, c, -s), second)
    return torch.minimum(to_first.amin(1), to_second.amin(1))


def _rotate(points: Tensor, c: Tensor, s: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)


def _box_distance(points: Tensor, half: Tensor) -> Tensor:
    beyond = points.abs() - half
    return beyond.clamp(min=0).square().sum(-1).sqrt() + beyond.amax(-1).clamp(max=0)
