"""What a training sample tells the network besides shapes and coarse poses. Each part is withheld in a share of the samples.

At inference some of it is unknown: the size of the errors, a mesh like those of the training, a category in plain words. A network
that has learned to do without each of them needs none.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.settings import Settings, Share

_MARGIN = 5e-3  # a direction is told only if it holds by this much, metres


@dataclass(frozen=True, slots=True)
class HintSettings(Settings):
    """Shares of samples in which the network is told something."""

    errors: Share = 0.6
    """Share of samples with the sizes of the errors of the coarse layout."""

    order: Share = 0.3
    """Share of samples with directions between objects of the clean scene, as an instruction states them."""

    pairs: Share = 0.1
    """Largest share of a sample's pairs of objects whose direction is told."""

    features: Share = 0.8
    """Share of samples with point features."""

    texts: Share = 0.9
    """Share of objects with text features."""


def give_hints(
    batch: LayoutBatch,
    targets: Tensor,
    error: Tensor,
    settings: HintSettings,
    generator: torch.Generator,
    is_scattered: Tensor | None = None,
) -> LayoutBatch:
    """Draws what each sample of a batch tells.

    Args:
        batch: The scenes, with all features.
        targets: Their clean poses, (B, N, 4).
        error: The errors of their coarse layouts, (B, 2), metres and radians.
        settings: Shares.
        generator: Random generator on the batch's device.
        is_scattered: Scenes whose features and texts are all withheld, (B,) bool.

    Returns:
        The scenes with ``error`` and ``order``; features that are withheld are zero.
    """
    num_scenes, num_slots = batch.mask.shape
    device = batch.mask.device
    draws = torch.rand((4, num_scenes), generator=generator, device=device)
    of_object = torch.rand((num_scenes, num_slots + 1), generator=generator, device=device) < settings.texts
    of_pair = torch.rand((num_scenes, num_slots, num_slots), generator=generator, device=device)
    share = torch.where(draws[1] < settings.order, draws[3] * settings.pairs, 0.0)
    has_features = draws[2] < settings.features
    if is_scattered is not None:
        has_features, of_object = has_features & ~is_scattered, of_object & ~is_scattered[:, None]
    return replace(
        batch,
        error=torch.where((draws[0] < settings.errors)[:, None], error, torch.nan),
        order=_directions(targets, batch.mask, of_pair < share[:, None, None]),
        features=None if batch.features is None else batch.features * has_features[:, None, None],
        texts=None if batch.texts is None else batch.texts * of_object[:, :-1, None],
        table_text=None if batch.table_text is None else batch.table_text * of_object[:, -1:],
    )


def _directions(poses: Tensor, mask: Tensor, is_told: Tensor) -> Tensor:
    """The directions of the told pairs (B, N, N), as in ``SceneTensors.order``; a pair is told in both ways or not at all."""
    apart = poses[:, None, :, :2] - poses[:, :, None, :2]  # [b, i, j] = j − i
    along, across = apart, apart.flip(-1)
    holds = along.abs() > across.abs() + _MARGIN
    one_way = is_told.triu(1)
    chosen = (one_way | one_way.transpose(1, 2)) & mask[:, :, None] & mask[:, None]
    return torch.where(holds & chosen[..., None], along.sign(), 0.0)
