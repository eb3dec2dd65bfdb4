"""Which objects may meet: pairs whose yawed boxes do, as index lists over padded scenes."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPairs:
    """Pairs of objects of the same scene, E of them, in the order of scene, first, second.

    Attributes:
        scene: (E,) int64.
        first: Place of one object in its scene, (E,) int64.
        second: Place of the other, larger than the first's, (E,) int64.
    """

    scene: Tensor
    first: Tensor
    second: Tensor

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.scene)

    def take(self, pairs: Tensor) -> "ObjectPairs":
        """Some of the pairs, by index or mask."""
        return ObjectPairs(self.scene[pairs], self.first[pairs], self.second[pairs])

    def both_ways(self) -> "ObjectPairs":
        """Every pair twice, (2E): as it is, and with first and second exchanged."""
        scene, first, second = self.scene, self.first, self.second
        return ObjectPairs(torch.cat([scene, scene]), torch.cat([first, second]), torch.cat([second, first]))


@torch.no_grad()
def near_pairs(poses: Tensor, half_extents: Tensor, mask: Tensor) -> ObjectPairs:
    """Pairs whose boxes, turned by their yaws, meet.

    Heights and circles are compared first; what they leave is separated along the four sides of the two boxes, which is exact.

    Args:
        poses: x, y, z in metres and yaw in radians, world frame, (B, N, 4).
        half_extents: Half of each box in its yaw frame, grown by half of what may lie between two that count as near,
            (B, N, 3), metres.
        mask: True where there is an object that counts, (B, N) bool.

    Returns:
        The pairs.
    """
    first, second = torch.triu_indices(mask.shape[1], mask.shape[1], 1, device=mask.device)
    apart = poses[:, second, :3] - poses[:, first, :3]
    radius = torch.linalg.vector_norm(half_extents[..., :2], dim=-1)
    is_near = mask[:, first] & mask[:, second]
    is_near &= apart[..., 2].abs() <= half_extents[:, first, 2] + half_extents[:, second, 2]
    is_near &= apart[..., :2].square().sum(dim=-1) <= (radius[:, first] + radius[:, second]).square()
    scene, pair = is_near.nonzero(as_tuple=True)
    pairs = ObjectPairs(scene, first[pair], second[pair])
    meet = _rectangles_meet(
        apart[scene, pair, :2], *(_rectangle(poses, half_extents, scene, k) for k in (pairs.first, pairs.second))
    )
    return pairs.take(meet)


def _rectangle(poses: Tensor, half_extents: Tensor, scene: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Half sides (E, 2) and yaw (E,) of objects."""
    return half_extents[scene, place, :2], poses[scene, place, 3]


def _rectangles_meet(apart: Tensor, one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> Tensor:
    """Whether rectangles whose centres are so far apart (E, 2) meet, (E,) bool."""
    turn = other[1] - one[1]
    c, s = turn.cos().abs(), turn.sin().abs()
    meet = torch.ones_like(c, dtype=torch.bool)
    for (half, yaw), (guest, _) in ((one, other), (other, one)):
        along = torch.stack(
            [yaw.cos() * apart[:, 0] + yaw.sin() * apart[:, 1], yaw.cos() * apart[:, 1] - yaw.sin() * apart[:, 0]], 1
        )
        shadow = torch.stack([c * guest[:, 0] + s * guest[:, 1], s * guest[:, 0] + c * guest[:, 1]], 1)
        meet &= (along.abs() <= half + shadow).all(dim=1)
    return meet
