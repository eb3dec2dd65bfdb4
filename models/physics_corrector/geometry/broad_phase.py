"""Broad phase: pairs of objects whose yawed boxes overlap, as index lists over padded scenes."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPairs:
    """Pairs of objects of the same scene, E of them, sorted by scene, first, second.

    Attributes:
        scene: (E,) int64.
        first: Index of one object in its scene, (E,) int64.
        second: Index of the other object, larger than the first, (E,) int64.
    """

    scene: Tensor
    first: Tensor
    second: Tensor

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.scene)

    def take(self, pairs: Tensor) -> "ObjectPairs":
        """Selects pairs by index or mask."""
        return ObjectPairs(self.scene[pairs], self.first[pairs], self.second[pairs])

    def both_ways(self) -> "ObjectPairs":
        """Returns the pairs, followed by the same pairs with first and second exchanged, (2E)."""
        scene, first, second = self.scene, self.first, self.second
        return ObjectPairs(torch.cat([scene, scene]), torch.cat([first, second]), torch.cat([second, first]))


@torch.no_grad()
def near_pairs(poses: Tensor, half_extents: Tensor, mask: Tensor) -> ObjectPairs:
    """Finds pairs whose yawed boxes overlap.

    Height ranges and circumscribed circles are compared first; the separating axis test on the remaining rectangles is exact.

    Args:
        poses: x, y, z in metres and yaw in radians, world frame, (B, N, 4).
        half_extents: Half sizes of the boxes in the yaw frame, (B, N, 3), metres. To find pairs within a distance, enlarge each by
            half of it.
        mask: The objects to test, (B, N) bool.
    """
    first, second = torch.triu_indices(mask.shape[1], mask.shape[1], 1, device=mask.device)
    apart = poses[:, second, :3] - poses[:, first, :3]
    radius = torch.linalg.vector_norm(half_extents[..., :2], dim=-1)
    is_near = mask[:, first] & mask[:, second]
    is_near &= apart[..., 2].abs() <= half_extents[:, first, 2] + half_extents[:, second, 2]
    is_near &= apart[..., :2].square().sum(dim=-1) <= (radius[:, first] + radius[:, second]).square()
    scene, pair = is_near.nonzero(as_tuple=True)
    pairs = ObjectPairs(scene, first[pair], second[pair])
    rectangles = [(half_extents[scene, index, :2], poses[scene, index, 3]) for index in (pairs.first, pairs.second)]
    return pairs.take(_rectangles_overlap(apart[scene, pair, :2], *rectangles))


def _rectangles_overlap(apart: Tensor, one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> Tensor:
    """Whether rectangles, of half sides (E, 2) and yaw (E,), overlap at an offset of their centres (E, 2); (E,) bool."""
    turn = other[1] - one[1]
    c, s = turn.cos().abs(), turn.sin().abs()
    overlap = torch.ones_like(c, dtype=torch.bool)
    for (half, yaw), (guest, _) in ((one, other), (other, one)):
        along = torch.stack(
            [yaw.cos() * apart[:, 0] + yaw.sin() * apart[:, 1], yaw.cos() * apart[:, 1] - yaw.sin() * apart[:, 0]], 1
        )
        projected = torch.stack([c * guest[:, 0] + s * guest[:, 1], s * guest[:, 0] + c * guest[:, 1]], 1)
        overlap &= (along.abs() <= half + projected).all(dim=1)
    return overlap
