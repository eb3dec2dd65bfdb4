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
_ASSUMED_ERROR = 0.05  # where it is unknown, metres
_CONTENT_SPREAD = 0.4  # standard deviation of contents around the middle of their carrier, in its mean half size
_BEYOND = 0.25  # expected distance from the edge of an object far beyond it, standard deviations


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
    """Encodes the expected errors of the coarse poses, and what follows from them alone, (B, N, ERROR_CHANNELS) float32.

    The channels are the logarithms of the errors and whether they are known, and the shifts of :func:`expected_shifts` in units of the
    error, by each object alone and by all objects of its body.
    """
    shape = condition.mask.shape
    error = condition.poses.new_full((shape[0], 2), torch.nan) if condition.error is None else condition.error
    known = error.isfinite()
    unit = error.new_tensor(_TYPICAL_ERROR)
    lengths = torch.where(known, (error / unit).clamp(_SMALLEST, 1 / _SMALLEST).log(), 0)
    told = torch.cat([lengths, known.float()], -1)[:, None].expand(*shape, 4)
    sigma = torch.where(known[:, 0], error[:, 0], _ASSUMED_ERROR).clamp_min(_SMALLEST)
    alone, together = expected_shifts(condition, sigma)
    return torch.cat([told, alone / sigma[:, None, None], together / sigma[:, None, None]], -1)


def expected_shifts(condition: Condition, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Computes how far objects are expected to be from their places, if all were displaced at random and only the table is known.

    An object by itself is expected inside the table. If contents were displaced independently of their carrier, which shows where they
    are no longer on it, they tell where the carrier was, and the carrier tells where they were.

    Args:
        condition: The scenes.
        sigma: Standard deviation of the displacements along x and along y, metres, (B,), positive.

    Returns:
        The shift of each object from its coarse place by itself, and with the evidence of its body, two (B, N, 2) in metres; 0 for
        padding and fixed objects, and by its body also for objects without a known support.
    """
    root, mask, xy = condition.roots(), condition.mask, condition.poses[..., :2]
    slots = torch.arange(mask.shape[1], device=root.device)
    index = torch.where(root >= 0, root, slots)
    place = index[..., None].expand(-1, -1, 2)
    is_root = index == slots
    half = condition.sizes[..., :2].mean(-1) / 2
    reach = half.gather(1, index)  # of the body's lowest object
    apart = xy - xy.gather(1, place)
    rides = ~is_root & (apart.norm(dim=-1) <= reach)  # still on its carrier: it moved with it, or not at all
    variance = sigma[:, None].square()
    spread = torch.where(is_root, 0.0, _CONTENT_SPREAD * reach).square()  # of contents around the middle of their carrier
    weight = torch.where(mask & ~rides, 1 / (variance + spread), 0.0)
    total = torch.zeros_like(weight).scatter_add(1, index, weight).clamp_min(_SMALLEST)
    middle = torch.zeros_like(xy).scatter_add(1, place, weight[..., None] * xy) / total[..., None]
    alone = _inside(xy, half, condition.table, sigma[:, None].expand_as(half))
    of_root = _inside(middle, half, condition.table, total.rsqrt())
    of_body = of_root.gather(1, place)
    share = (variance / (variance + spread))[..., None]
    strayed = share * of_body + (1 - share) * xy
    together = torch.where(rides[..., None], of_body + apart, torch.where(is_root[..., None], of_root, strayed))
    moves = condition.is_movable[..., None]
    return torch.where(moves, alone - xy, 0), torch.where(moves & (root >= 0)[..., None], together - xy, 0)


def _inside(xy: Tensor, half: Tensor, table: Tensor, sigma: Tensor) -> Tensor:
    """The mean of a normal distribution around xy (B, N, 2) that is cut off at the edges of the table, less half a size (B, N)."""
    low = torch.minimum(half[..., None], table[:, None] / 2)
    high, deviation = table[:, None] - low, sigma[..., None]
    a, b = ((edge - xy) / deviation for edge in (low, high))
    mass = torch.special.ndtr(b) - torch.special.ndtr(a)
    density = (torch.exp(-a.square() / 2) - torch.exp(-b.square() / 2)) / math.sqrt(2 * math.pi)
    mean = xy + deviation * density / mass.clamp_min(1e-6)
    # Far outside, the nearest edge and a little more.
    beyond = torch.where(xy < low, low + _BEYOND * deviation, high - _BEYOND * deviation)
    mean = torch.where(mass > 1e-4, mean, beyond)
    return torch.maximum(torch.minimum(mean, high), low)


ERROR_CHANNELS = 4 + 4
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
