"""Rests carried objects on what is below them in their body: heights level by level, and small steps aside within the body."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.physics_corrector.certify.constants import AIR
from models.physics_corrector.refinement.contacts import Contacts, find_contacts, pairs_in_bodies
from models.physics_corrector.refinement.problem import RefinementProblem
from models.physics_corrector.refinement.separation import combined_steps, parting, posed_outlines
from stable_data.metrics.verdicts import TOLERANCE

# Tuned on: the proposals of generated scenes, see docs/refinement.md. Lengths in metres.
_LEVEL = 0.9 * TOLERANCE  # a root whose underside is this near to the table top keeps its height
_RANGE = 0.04  # contacts farther apart than this are not seen: an object without one is lowered by a whole step
_STEP = 0.03  # such a step
_TOLERANCE = 1e-4  # an object whose distance to what is below it is smaller has come to rest
_UNRESTED = 3e-4  # an object with a larger distance after the search is lowered once more, from above its body
_STEPS = 14  # steps of the search, twice as many from above
_STEEPEST = 0.35  # least vertical part of a normal by which a depth is turned into a height
_GENTLE = 0.7  # the same for a distance: a longer step down could pass through a thin wall
_THROUGH = 1.5e-3  # an object deeper than this in something is raised, whatever the normal
_WALL_RISE = 0.15  # a contact whose normal rises less is a wall, which no change of height parts or meets
_MOST_RISE = 0.03  # an object that would end this much higher keeps its height: a content would end on the rim of its container
_ABOVE = 5e-4  # how far above its body an object starts that is lowered once more
_WALL = 0.6  # least horizontal part of the normal of a contact that is parted sideways between an object and its carrier
_DEEP = 2e-4  # contacts deeper than this are parted
_LONGEST = 0.02  # longest step aside
_GAIN = 1.2  # factor of the steps aside


def stand_on_table(poses: Tensor, problem: RefinementProblem) -> Tensor:
    """Returns the poses with the root of each body on the table, and all that it carries moved as much; fixed bodies stay."""
    poses = poses.clone()
    flat, root = poses.view(-1, 4), problem.forest.root
    height = problem.layout.sizes[..., 2].reshape(-1) / 2
    drop = height - flat[:, 2]
    drop = torch.where((problem.mobility > 0) & (drop.abs() > _LEVEL), drop, 0)
    flat[:, 2] += drop[root]
    return poses


def step_aside(poses: Tensor, problem: RefinementProblem, moving: Tensor, clearance: float, iterations: int) -> Tensor:
    """Moves objects within their bodies away from walls and from objects beside them, each with what it carries.

    Args:
        poses: (B, N, 4), metres and radians.
        problem: The scenes.
        moving: The objects that may move, (M,) bool; none of them is a root.
        clearance: Wanted distance, metres.
        iterations: Largest number of iterations.
    """
    poses = poses.clone()
    flat, forest = poses.view(-1, 4), problem.forest
    mover = forest.nearest(moving)  # what moves an object: itself, or the nearest moving one below it
    outlines = posed_outlines(poses, problem).flatten(0, 1)
    for _ in range(iterations):
        pairs = pairs_in_bodies(poses, problem, moving, 2 * clearance)
        contacts = find_contacts(poses, problem, pairs, 0.0)
        is_stacked = forest.carries(contacts.host, contacts.guest) | forest.carries(contacts.guest, contacts.host)
        is_wall = contacts.normal[:, :2].norm(dim=1) > _WALL
        first, second = mover[contacts.guest], mover[contacts.host]
        counts = (contacts.distance < -_DEEP) & (is_wall | ~is_stacked) & (first != second)
        contacts, is_stacked, first, second = contacts.take(counts), is_stacked[counts], first[counts], second[counts]
        if not len(contacts):
            break
        direction, amount = parting(contacts, flat, outlines, clearance, is_stacked)
        push = direction * amount.clamp_max(_LONGEST)[:, None]
        share = torch.where((first >= 0) & (second >= 0), 0.5, torch.where(first >= 0, 1.0, 0.0))[:, None]
        movers, steps = torch.cat([first, second]), torch.cat([share * push, (share - 1) * push])
        step = _GAIN * combined_steps(movers[movers >= 0], steps[movers >= 0], len(flat))  # -1 moves nothing
        flat[:, :2] += torch.where((mover >= 0)[:, None], step[mover.clamp_min(0)], 0)
    return poses


def lower_onto(poses: Tensor, problem: RefinementProblem, moving: Tensor) -> tuple[Tensor, Tensor]:
    """Moves objects up or down until each touches what is below it in its body, level by level, each with what it carries.

    Args:
        poses: (B, N, 4), metres and radians.
        problem: The scenes.
        moving: The objects to rest, (M,) bool; none of them is a root.

    Returns:
        The poses, and how far each object is from touching at the end, (M,) metres; 0 for objects that do not move.
    """
    poses = poses.clone()
    flat, forest = poses.view(-1, 4), problem.forest
    rest = flat.new_zeros(len(flat))
    for level in range(1, int(forest.level.max()) + 1 if len(forest.level) else 1):
        search, own = _HeightSearch(poses, problem, moving), moving & (forest.level == level)
        found = search.run(own, _STEPS)
        again = own & (found > _UNRESTED)
        if bool(again.any()):
            height = problem.layout.sizes[..., 2].reshape(-1) / 2
            top = torch.where(forest.level < level, flat[:, 2] + height, -torch.inf)
            highest = torch.full_like(top, -torch.inf).scatter_reduce(0, forest.root, top, "amax")[forest.root]
            before = poses.clone()
            search.raise_by(again, highest + height + _ABOVE - flat[:, 2])
            redone = search.run(again, 2 * _STEPS)
            is_worse = again & ((redone >= found) | (flat[:, 2] - before.view(-1, 4)[:, 2] > _MOST_RISE))
            search.raise_by(is_worse, before.view(-1, 4)[:, 2] - flat[:, 2])
            found = torch.where(again & ~is_worse, redone, found)
        rest = torch.where(own, found, rest)
    return poses, rest


def unrested(poses: Tensor, problem: RefinementProblem, carried: Tensor) -> Tensor:
    """Which carried objects (M,) float, or are in what is below them or beside them in their body, (M,) bool."""
    search, distance = _HeightSearch(poses, problem, torch.zeros_like(carried)), torch.zeros_like(problem.mobility)
    for number in range(1, int(problem.forest.level.max()) + 1):  # each level on the one below
        which = carried & (problem.forest.level == number)
        distance = torch.where(which, search.distances(which)[0], distance)
    pairs = pairs_in_bodies(poses, problem, carried, 0.0)
    contacts = find_contacts(poses, problem, pairs, 0.0)
    contacts = contacts.take(contacts.distance < -_UNRESTED)
    level = problem.forest.level
    upper = torch.where(level[contacts.guest] >= level[contacts.host], contacts.guest, contacts.host)
    found = distance.abs() > _UNRESTED
    found[upper] = True
    return found & carried


@dataclass(slots=True, eq=False)
class _HeightSearch:
    """The heights of moving objects; ``poses`` are changed in place."""

    poses: Tensor
    problem: RefinementProblem
    moving: Tensor

    def raise_by(self, which: Tensor, rise: Tensor) -> None:
        """Moves objects (M,) up by (M,) metres, each with what it carries."""
        mover = self.problem.forest.nearest(which)
        self.poses.view(-1, 4)[:, 2] += torch.where(mover >= 0, rise[mover.clamp_min(0)], 0)

    def run(self, which: Tensor, steps: int) -> Tensor:
        """Steps objects (M,) towards the height at which they touch; returns how far they are from it, (M,) metres.

        Each keeps the best height that was met.
        """
        flat = self.poses.view(-1, 4)
        best, best_height = torch.full_like(flat[:, 2], torch.inf), flat[:, 2].clone()
        for _ in range(steps):
            distance, rise = self.distances(which)
            better = which & (distance.abs() < best)
            best, best_height = torch.where(better, distance.abs(), best), torch.where(better, flat[:, 2], best_height)
            open_ = which & (distance.abs() > _TOLERANCE)
            if not bool(open_.any()):
                break
            slope = torch.where(distance > 0, rise.clamp(_GENTLE, 1), rise.clamp(_STEEPEST, 1))
            step = torch.where(torch.isfinite(distance), -distance / slope, -_STEP)
            self.raise_by(open_, step.clamp(-_RANGE, _RANGE))
        self.raise_by(which, best_height - flat[:, 2])
        return torch.where(which, best, 0)

    def distances(self, which: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the least distance of objects to what may stop them from below, (M,), and the vertical part of its normal."""
        flat = self.poses.view(-1, 4)
        pairs = pairs_in_bodies(self.poses, self.problem, which, _RANGE)
        contacts = self._stopping(find_contacts(self.poses, self.problem, pairs, _RANGE), which)
        is_guest = which[contacts.guest]
        upwards = torch.where(is_guest, contacts.normal[:, 2], -contacts.normal[:, 2])
        counts = (upwards > _WALL_RISE) | (contacts.distance < -_THROUGH)
        contacts, upwards = contacts.take(counts), upwards[counts]
        mover = torch.where(which[contacts.guest], contacts.guest, contacts.host)
        distance = torch.full_like(flat[:, 2], torch.inf).scatter_reduce(0, mover, contacts.distance - AIR, "amin")
        nearest = contacts.distance - AIR == distance[mover]
        rise = torch.ones_like(distance).index_put((mover[nearest],), upwards[nearest])
        above_table = flat[:, 2] - self.problem.layout.sizes[..., 2].reshape(-1) / 2
        on_table = above_table < distance
        return torch.where(on_table, above_table, distance), torch.where(on_table, 1, rise)

    def _stopping(self, contacts: Contacts, which: Tensor) -> Contacts:
        """The contacts of a moving object with what stays: not with what it carries, nor with moving objects of its level or above."""
        forest = self.problem.forest
        is_guest = which[contacts.guest]
        mover = torch.where(is_guest, contacts.guest, contacts.host)
        other = torch.where(is_guest, contacts.host, contacts.guest)
        stays = (forest.level[other] < forest.level[mover]) | ~self.moving[other]
        return contacts.take(stays & ~forest.carries(mover, other) & ~which[other])
