"""The network's inputs for each object: its context, which is constant during the flow, and its state, the present pose.

Lengths are offsets from the table's edges and top, the restricted zone and the support. They have two encodings: sines and
cosines at wavelengths from 4 m to 3 cm, and ``squash_distances``, which resolves the centimetres around contact. Poses remain
float32 here under autocast: bfloat16 would round a metre to 4 mm.
"""

import math

import torch
from torch import Tensor

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.geometry.scene_tensors import ON_TABLE

NUM_WAVES = 8
_LONGEST_WAVE = 4.0  # metres: longer than a table, so that every position on it has a different encoding
_SMALLEST = 1e-3  # metres: lower bound of sizes, so that their logarithms are finite; also the lower bound of other ratios
_TYPICAL_ERROR = (0.02, 0.2)  # metres and radians: errors with the logarithm 0


def fourier_features(lengths: Tensor) -> Tensor:
    """Lengths in metres with their sines and cosines at ``NUM_WAVES`` wavelengths, (..., C) → (..., C (1 + 2 W))."""
    turns = 2 * math.pi / _LONGEST_WAVE * 2.0 ** torch.arange(NUM_WAVES, device=lengths.device)
    phase = (lengths[..., None] * turns).flatten(-2)
    return torch.cat([lengths, phase.sin(), phase.cos()], -1)


def squash_distances(lengths: Tensor) -> Tensor:
    """Hyperbolic tangents of lengths in metres, at scales of 1 cm and 10 cm, (..., C) → (..., 2 C)."""
    return torch.cat([torch.tanh(lengths / 0.01), torch.tanh(lengths / 0.1)], -1)


def rotate_to_local(offset: Tensor, yaw: Tensor) -> Tensor:
    """Rotates horizontal offsets (..., 2+) into the frame of an object at ``yaw`` (...), (..., 2)."""
    c, s = yaw.cos(), yaw.sin()
    return torch.stack([c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]], -1)


def place_features(poses: Tensor, condition: Condition) -> Tensor:
    """Encodes the poses of objects relative to table, zone and support, (B, N, PLACE_CHANNELS) float32.

    Args:
        poses: x, y, z in metres and yaw in radians, world frame, (B, N, 4) float32.
        condition: The scenes; its coarse poses are not read.
    """
    x, y, z, yaw = poses.unbind(-1)
    width, depth = condition.table[:, :1], condition.table[:, 1:]
    bottom = z - condition.sizes[..., 2] / 2
    edges = torch.stack([x, y, width - x, depth - y, bottom], -1)
    zone = (condition.zone[:, None, :] - poses[..., [0, 0, 1, 1]]) * condition.has_zone[:, None, None]
    return torch.cat(
        [
            fourier_features(edges),
            squash_distances(bottom[..., None]),
            squash_distances(zone),
            _over_parent(poses, condition),
            yaw.sin()[..., None],
            yaw.cos()[..., None],
        ],
        -1,
    )


PLACE_CHANNELS = 5 * (1 + 2 * NUM_WAVES) + 2 + 8 + 10 + 2


def _over_parent(poses: Tensor, condition: Condition) -> Tensor:
    """Encodes the pose of objects in the frame of their support, (B, N, 10); zeros for the table or no support."""
    has_parent = condition.parent >= 0
    index = condition.parent.clamp_min(0)[..., None]
    parent = poses.gather(1, index.expand_as(poses))
    height = condition.sizes[..., 2]
    parent_height = height.gather(1, index[..., 0])
    offset = rotate_to_local(poses - parent, parent[..., 3])
    gap = poses[..., 2] - parent[..., 2] - (height + parent_height) / 2
    turn = poses[..., 3] - parent[..., 3]
    values = torch.cat(
        [squash_distances(offset), squash_distances(gap[..., None]), offset, turn.sin()[..., None], turn.cos()[..., None]], -1
    )
    return values * has_parent[..., None]


def context_features(condition: Condition) -> Tensor:
    """Encodes sizes, support and coarse pose of each object, without point features, (B, N, CONTEXT_CHANNELS) float32."""
    parent = condition.parent
    flags = torch.stack([condition.is_fixed, parent >= 0, parent == ON_TABLE, parent < ON_TABLE], -1).float()
    carrier = condition.sizes.gather(1, parent.clamp_min(0)[..., None].expand_as(condition.sizes))
    scene = torch.cat([condition.table, condition.has_zone[:, None].float()], -1)[:, None, :].expand(*parent.shape, 3)
    sizes = [condition.sizes.clamp_min(_SMALLEST).log(), carrier.clamp_min(_SMALLEST).log() * flags[..., 1:2]]
    return torch.cat([*sizes, condition.sizes, flags, scene, place_features(condition.poses, condition)], -1)


CONTEXT_CHANNELS = 9 + 4 + 3 + PLACE_CHANNELS


def error_features(condition: Condition) -> Tensor:
    """Encodes the expected errors of the coarse poses, (B, N, ERROR_CHANNELS) float32: logarithms, and whether they are known."""
    shape = condition.mask.shape
    if condition.error is None:
        return condition.poses.new_zeros(*shape, ERROR_CHANNELS)
    unit = condition.error.new_tensor(_TYPICAL_ERROR)
    known = condition.error.isfinite()
    lengths = torch.where(known, (condition.error / unit).clamp(_SMALLEST, 1 / _SMALLEST).log(), 0)
    return torch.cat([lengths, known.float()], -1)[:, None].expand(*shape, ERROR_CHANNELS)


ERROR_CHANNELS = 4
ORDER_CHANNELS = 2


def pair_features(poses: Tensor, condition: Condition) -> Tensor:
    """Encodes each object j in the yaw frame of each object i, (B, N, N, PAIR_CHANNELS) float32.

    The channels are offset, relative yaw, the size of j, the gaps of the boxes along i's axes (negative: they overlap along that
    axis), and the support relation of the two.

    Args:
        poses: x, y, z in metres and yaw in radians, world frame, (B, N, 4) float32.
        condition: The scenes; its coarse poses are not read.
    """
    offset = poses[:, None] - poses[:, :, None]  # [b, i, j] = j − i
    flat = rotate_to_local(offset, poses[:, :, None, 3].expand(offset.shape[:-1]))
    offset = torch.cat([flat, offset[..., 2:3]], -1)
    turn = poses[:, None, :, 3] - poses[:, :, None, 3]
    c, s = turn.cos(), turn.sin()
    own, other = condition.sizes[:, :, None], condition.sizes[:, None].expand(offset.shape)
    width, depth, height = other.unbind(-1)
    extent = torch.stack([c.abs() * width + s.abs() * depth, s.abs() * width + c.abs() * depth, height], -1)
    gap = offset.abs() - (own + extent) / 2
    index = torch.arange(condition.mask.shape[1], device=poses.device)
    on_other = condition.parent[:, :, None] == index  # j supports i
    siblings = (condition.parent[:, :, None] == condition.parent[:, None]) & (condition.parent[:, None] >= ON_TABLE)
    flags = torch.stack([on_other, on_other.transpose(1, 2), siblings], -1).float()
    apart = gap.amax(-1, keepdim=True)  # positive: one axis separates the boxes
    return torch.cat(
        [
            torch.tanh(offset / 0.1),
            offset,
            c[..., None],
            s[..., None],
            squash_distances(gap),
            squash_distances(apart),
            flags,
            other,
        ],
        -1,
    )


PAIR_CHANNELS = 3 + 3 + 2 + 6 + 2 + 3 + 3
