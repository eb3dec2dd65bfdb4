"""Whether carried objects stay on what carries them: the centre of mass over the hull of the carrying points."""

import math

import torch
from torch import Tensor

from models.physics_corrector.certify import constants
from models.physics_corrector.refinement.contacts import find_touching, pairs_in_bodies
from models.physics_corrector.refinement.problem import RefinementProblem

# Tuned on: the proposals of generated scenes, see docs/refinement.md. Lengths in metres.
_REACH = 8e-4  # points nearer than this carry
_RISING = 0.3  # least vertical part of the normal at a carrying point
_NUM_DIRECTIONS = 16

_angles = torch.arange(_NUM_DIRECTIONS) * (2 * math.pi / _NUM_DIRECTIONS)
_DIRECTIONS = torch.stack([_angles.cos(), _angles.sin()])


def steadiness(poses: Tensor, problem: RefinementProblem, carried: Tensor) -> Tensor:
    """Returns the steadiness of carried objects, (M,): the tangent of the slope at which each would tip, as in ``certify``.

    It is how far the centre of mass is inside the hull of the carrying points, seen from above, divided by its height over them.

    Args:
        poses: (B, N, 4), metres and radians.
        problem: The scenes.
        carried: The objects, (M,) bool; none of them is a root.

    Returns:
        Negative if it tips, -inf without a carrying point; inf for all other objects.
    """
    flat, forest = poses.view(-1, 4), problem.forest
    contacts, points = find_touching(poses, problem, pairs_in_bodies(poses, problem, carried, 2 * _REACH), _REACH)
    sides = []
    for upper, lower, sign in ((contacts.guest, contacts.host, 1.0), (contacts.host, contacts.guest, -1.0)):
        counts = carried[upper] & ~forest.carries(upper, lower) & (sign * contacts.normal[:, 2] > _RISING)
        sides.append((upper[counts], points[counts]))
    upper, places = torch.cat([side[0] for side in sides]), torch.cat([side[1] for side in sides])
    x, y, z = problem.shapes.middle[problem.layout.shape_index].reshape(-1, 3).unbind(1)
    c, s = flat[:, 3].cos(), flat[:, 3].sin()
    centre = flat[:, :3] + torch.stack([c * x - s * y, s * x + c * y, z], dim=1)
    along = (places[:, :2] - centre[upper, :2]) @ _DIRECTIONS.to(places)
    farthest = along.new_full((len(flat), _NUM_DIRECTIONS), -torch.inf)
    farthest = farthest.scatter_reduce(0, upper[:, None].expand_as(along), along, "amax")
    counts = torch.zeros_like(flat[:, 2]).index_add(0, upper, torch.ones_like(places[:, 2]))
    below = torch.zeros_like(flat[:, 2]).index_add(0, upper, places[:, 2]) / counts.clamp_min(1)
    height = (centre[:, 2] - below).clamp_min(constants.MIN_CENTRE_HEIGHT)
    return torch.where(carried, farthest.amin(dim=1) / height, torch.inf)
