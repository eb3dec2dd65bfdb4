"""Contacts of pairs of objects: the sample of one that is deepest in the other, or nearest to it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.physics_corrector.geometry.broad_phase import ObjectPairs, near_pairs
from models.physics_corrector.geometry.closest_point import ClosestPointQueries, closest_sample, in_host, near_samples
from models.physics_corrector.refinement.problem import RefinementProblem


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """E contacts; objects are flat indices.

    Attributes:
        guest: The object whose sample is in contact, (E,) int64.
        host: The object in whose signed distance it is, (E,) int64.
        distance: Signed distance, (E,), metres, negative inside.
        normal: Direction away from the host, (E, 3), unit, world frame.
    """

    guest: Tensor
    host: Tensor
    distance: Tensor
    normal: Tensor

    def __len__(self) -> int:
        """Number of contacts."""
        return len(self.guest)

    def take(self, which: Tensor) -> "Contacts":
        """Selects contacts by index or mask."""
        return Contacts(self.guest[which], self.host[which], self.distance[which], self.normal[which])


@torch.no_grad()
def find_contacts(poses: Tensor, problem: RefinementProblem, pairs: ObjectPairs, limit: float) -> Contacts:
    """Finds the contact of each pair of objects, and of each pair exchanged.

    Args:
        poses: (B, N, 4), metres and radians.
        problem: The scenes.
        pairs: Pairs of objects.
        limit: Contacts farther apart than this are left out, metres.
    """
    queries = _both_ways(pairs)
    limits = poses.new_full((len(queries),), limit)
    sample, distance = closest_sample(poses, problem.layout, problem.shapes.tensors, queries, problem.shapes.samples, limits)
    found = torch.isfinite(distance)
    return _contacts_at(poses, problem, queries.take(found), sample[found])[0]


@torch.no_grad()
def find_touching(poses: Tensor, problem: RefinementProblem, pairs: ObjectPairs, reach: float) -> tuple[Contacts, Tensor]:
    """Finds all contacts of pairs of objects that are nearer than ``reach``, metres, and their points, (E, 3), world frame."""
    queries = _both_ways(pairs)
    limits = poses.new_full((len(queries),), reach)
    query, sample, _ = near_samples(poses, problem.layout, problem.shapes.tensors, queries, problem.shapes.samples, limits)
    return _contacts_at(poses, problem, queries.take(query), sample)


def _both_ways(pairs: ObjectPairs) -> ClosestPointQueries:
    both = pairs.both_ways()
    return ClosestPointQueries(both.scene, both.first, both.second)


def _contacts_at(
    poses: Tensor, problem: RefinementProblem, queries: ClosestPointQueries, sample: Tensor
) -> tuple[Contacts, Tensor]:
    """Returns the contacts of a sample (E,) of the guest of each query with its host, and the points, (E, 3), world frame."""
    layout, shapes = problem.layout, problem.shapes
    points = shapes.samples[layout.shape_index[queries.scene, queries.guest], sample]
    turn, offset = in_host(poses, queries)
    distance, local = shapes.tensors.signed_distance_with_normal(
        layout.shape_index[queries.scene, queries.host], _turned(points, turn) + offset
    )
    normal = _turned(local, poses[queries.scene, queries.host, 3])
    guest = poses[queries.scene, queries.guest]
    first = queries.scene * layout.mask.shape[1]
    found = Contacts(first + queries.guest, first + queries.host, distance, normal)
    return found, _turned(points, guest[:, 3]) + guest[:, :3]


def _turned(points: Tensor, yaw: Tensor) -> Tensor:
    """Turns points (E, 3) about the vertical."""
    c, s = yaw.cos(), yaw.sin()
    x, y, z = points.unbind(1)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=1)


def pairs_of_bodies(poses: Tensor, problem: RefinementProblem, margin: float) -> ObjectPairs:
    """Finds pairs of objects of different bodies whose boxes are nearer than a margin, metres; at least one of them may move."""
    pairs, root = near_pairs(poses, problem.half_sizes(margin), problem.layout.mask), problem.forest.root
    first = pairs.scene * problem.layout.mask.shape[1]
    one, other = root[first + pairs.first], root[first + pairs.second]
    return pairs.take((one != other) & ((problem.mobility[one] > 0) | (problem.mobility[other] > 0)))


def pairs_in_bodies(poses: Tensor, problem: RefinementProblem, moving: Tensor, margin: float) -> ObjectPairs:
    """Finds pairs of objects of the same body whose boxes are nearer than a margin, metres, one of which is moving, (M,) bool."""
    pairs, root = near_pairs(poses, problem.half_sizes(margin), problem.layout.mask), problem.forest.root
    first = pairs.scene * problem.layout.mask.shape[1]
    one, other = first + pairs.first, first + pairs.second
    return pairs.take((root[one] == root[other]) & (moving[one] | moving[other]))
