"""Replaces the arrangement of some scenes by a random one: things stand where there is room, and face any way.

Where things belong differs from one world to another, and some things belong nowhere. A network that only ever saw one tidy world
would force its habits on all others. In scattered scenes it learns what holds everywhere: things are on the table, side by side, and
contents are in their containers.
"""

import math

import torch
from torch import Tensor

from models.physics_corrector.flow.pose_coordinates import wrap_angle
from models.physics_corrector.geometry.scene_batch import LayoutBatch

_TRIES = 12  # places that are tried for each body
_GAP = 0.005  # wanted distance between the circles around bodies, metres


def scatter(batch: LayoutBatch, generator: torch.Generator) -> Tensor:
    """Draws a random arrangement of each scene.

    Bodies, which are objects on the table with all that they carry, are placed one after the other: of some random places inside the
    table and outside the zone, the first with room is taken, else the one with the most. Room is judged by circles of the mean
    radius of the boxes. Bodies with a fixed object, and objects without a support, keep their poses.

    Args:
        batch: Scenes with clean poses.
        generator: Random generator on the batch's device.

    Returns:
        Poses, (B, N, 4) float32.
    """
    num_scenes, num_slots = batch.mask.shape
    device = batch.poses.device
    root = batch.roots()
    # A sum of integers: CUDA reduces no bools.
    stuck = torch.zeros_like(root).scatter_add(1, root.clamp_min(0), (batch.is_fixed & (root >= 0)).long()) > 0
    slots = torch.arange(num_slots, device=device)
    moves = batch.mask & (root == slots) & ~stuck
    where = torch.rand((num_scenes, num_slots, _TRIES, 2), generator=generator, device=device)
    turn = 2 * math.pi * torch.rand((num_scenes, num_slots), generator=generator, device=device)
    radius = batch.sizes[..., :2].mean(-1) / 2
    # The box of a turned body must stay on the table.
    c, s = turn.cos().abs(), turn.sin().abs()
    width, depth = batch.sizes[..., 0], batch.sizes[..., 1]
    half = torch.stack([c * width + s * depth, s * width + c * depth], -1) / 2
    low = torch.minimum(half, batch.table[:, None] / 2)
    places = low[:, :, None] + where * (batch.table[:, None] - 2 * low)[:, :, None]  # (B, N, K, 2)
    zone, inside = batch.zone, half[:, :, None]
    in_zone = (places + inside > zone[:, None, None, [0, 2]]).all(-1) & (places - inside < zone[:, None, None, [1, 3]]).all(-1)
    in_zone &= batch.has_zone[:, None, None]
    xy = batch.poses[..., :2].clone()
    is_placed = batch.mask & (root == slots) & stuck
    for k in range(num_slots):
        apart = (
            torch.linalg.vector_norm(places[:, k, :, None] - xy[:, None], dim=-1) - radius[:, None] - radius[:, k, None, None]
        )
        room = torch.where(is_placed[:, None], apart, torch.inf).amin(-1) - _GAP
        room = torch.where(in_zone[:, k], -1.0, room.clamp_max(0.0))  # of several places with room, the first
        chosen = places[:, k].gather(1, room.argmax(1)[:, None, None].expand(-1, 1, 2))[:, 0]
        xy[:, k] = torch.where(moves[:, k, None], chosen, xy[:, k])
        is_placed[:, k] |= moves[:, k]
    return _with_bodies(batch, root, moves, xy, turn)


def _with_bodies(batch: LayoutBatch, root: Tensor, moves: Tensor, xy: Tensor, turn: Tensor) -> Tensor:
    """Returns poses in which roots have new places and yaws, and all that they carry moves with them."""
    index = root.clamp_min(0)
    is_moved = (root >= 0) & moves.gather(1, index)
    of_root = batch.poses.gather(1, index[..., None].expand_as(batch.poses))
    turned = turn.gather(1, index) - of_root[..., 3]
    c, s = turned.cos(), turned.sin()
    x, y = (batch.poses[..., :2] - of_root[..., :2]).unbind(-1)
    centre = xy.gather(1, index[..., None].expand(-1, -1, 2))
    at = torch.stack([centre[..., 0] + c * x - s * y, centre[..., 1] + s * x + c * y], -1)
    poses = torch.cat([at, batch.poses[..., 2:3], wrap_angle(batch.poses[..., 3:] + turned[..., None])], -1)
    return torch.where(is_moved[..., None], poses, batch.poses)
