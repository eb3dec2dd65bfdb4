"""Random draws for the objects of scenes that depend on the scene alone: not on its batch, its padding or the order of its objects."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from models.physics_corrector.flow.condition import Condition


class SceneNoise:
    """Standard normal draws from one random stream for each scene; an object gets those of its rank by content.

    Args:
        condition: The scenes.
        seeds: The seed of each scene, nonnegative.
    """

    def __init__(self, condition: Condition, seeds: Sequence[int]) -> None:
        self._device = condition.poses.device
        self._ranks: list[npt.NDArray[np.int64]] = [
            rank[is_object].cpu().numpy() for rank, is_object in zip(condition.content_ranks(), condition.mask, strict=True)
        ]
        self._num_slots, self._mask = condition.mask.shape[1], condition.mask.cpu().numpy()
        # NumPy's streams give the same first numbers whatever number is drawn at a time; those of torch do not.
        self._streams = [np.random.default_rng(seed) for seed in seeds]

    def draw(self) -> Tensor:
        """Returns the next draws, (B, N, 4) float32; zeros for padding."""
        found = np.zeros((len(self._ranks), self._num_slots, 4), np.float32)
        for b, (stream, ranks) in enumerate(zip(self._streams, self._ranks, strict=True)):
            found[b, self._mask[b]] = stream.standard_normal((len(ranks), 4))[ranks]
        return torch.from_numpy(found).to(self._device)


def drawn_seeds(count: int, generator: torch.Generator) -> list[int]:
    """Draws seeds of scenes."""
    seeds: list[int] = torch.randint(2**48, (count,), generator=generator, device=generator.device).tolist()
    return seeds
