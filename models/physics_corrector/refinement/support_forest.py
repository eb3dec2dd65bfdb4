"""Which object carries which in a batch of scenes, as flat indices."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_tensors import ON_TABLE, SceneTensors


@dataclass(frozen=True, slots=True, eq=False)
class SupportForest:
    """The supports of all objects of B scenes of N slots; object n of scene b has the flat index b * N + n, of M = B * N.

    Attributes:
        parent: The support of each object; the object itself if it stands on the table, or is padding, (M,) int64.
        root: The lowest object of each stack, (M,) int64: a *body* is a root with all that it carries.
        level: Number of objects below an object, (M,) int64.
        chain: The object, its support, the support's support and so on, repeated at the root, (M, D) int64.
    """

    parent: Tensor
    root: Tensor
    level: Tensor
    chain: Tensor

    @classmethod
    def of(cls, layout: SceneTensors) -> "SupportForest":
        """Converts the supports of a batch.

        An object without a known support stands on the table. Supports in a circle count as standing on the table too.
        """
        num_scenes, num_slots = layout.mask.shape
        own = torch.arange(num_scenes * num_slots, device=layout.mask.device)
        first = own - own % num_slots
        parent = layout.parent.reshape(-1)
        has_parent = (parent >= 0) & layout.mask.reshape(-1)
        parent = torch.where(has_parent, first + parent.clamp_min(0), own)
        chain = [own, parent]
        for _ in range(num_slots):  # ends at the depth of the highest stack
            if bool((chain[-1] == parent[chain[-1]]).all()):
                break
            chain.append(parent[chain[-1]])
        else:
            in_circle = chain[-1] != parent[chain[-1]]
            return cls.of(_without_supports(layout, in_circle.view_as(layout.mask)))
        steps = torch.stack(chain, dim=1)
        level = (steps[:, 1:] != steps[:, :-1]).sum(dim=1)
        return cls(parent, chain[-1], level, steps)

    def to(self, device: torch.device | str) -> "SupportForest":
        """Copies the tensors to a device."""
        return SupportForest(*(getattr(self, name).to(device) for name in self.__slots__))

    def carries(self, lower: Tensor, upper: Tensor) -> Tensor:
        """Whether objects ``lower`` (E,) carry objects ``upper`` (E,), directly or not, or are the same; (E,) bool."""
        return (self.chain[upper] == lower[:, None]).any(dim=1)

    def nearest(self, marked: Tensor) -> Tensor:
        """Returns the first marked object of each chain, (M,) int64; -1 if none is.

        Args:
            marked: (M,) bool.
        """
        found = marked[self.chain]
        first = found.to(torch.uint8).argmax(dim=1, keepdim=True)  # the first of equal ones
        return torch.where(found.any(dim=1), self.chain.gather(1, first)[:, 0], -1)


def _without_supports(layout: SceneTensors, where: Tensor) -> SceneTensors:
    """Returns the scenes with some objects on the table."""
    return replace(layout, parent=torch.where(where, ON_TABLE, layout.parent))
