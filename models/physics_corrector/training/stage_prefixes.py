"""The layouts that the corrector receives in Algorithm 1: O^t, O^t ∪ O^B, the whole scene; earlier objects may be fixed."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.scene_tensors import NO_PARENT
from models.settings import Settings, Share
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class PrefixSettings(Settings):
    """Shares of the parts of scenes in training."""

    task: Share = 0.2
    """Share of samples that end with O^t."""

    important: Share = 0.2
    """Share of samples that end with O^B; the rest are whole scenes."""

    fixed: Share = 0.4
    """Share of samples in which objects of earlier stages are fixed at their clean pose."""

    def check(self) -> None:
        """Refuses shares over 1; see the base class."""
        if self.task + self.important > 1:
            found = f"task {self.task}, important {self.important}"
            raise ConfigError(f"prefixes: {found}, expected shares that add up to at most 1", "config_invalid")


def take_prefix(batch: LayoutBatch, stage: Tensor, settings: PrefixSettings, generator: torch.Generator) -> LayoutBatch:
    """Draws a prefix of each scene.

    The whole scene replaces a prefix without objects; if a stage adds no object, nothing is fixed.

    Args:
        batch: Whole scenes.
        stage: Stage of each object, 0 O^t, 1 O^B, 2 O^b, negative if a scene has no stages, (B, N) int64.
        settings: Shares.
        generator: Random generator on the batch's device.

    Returns:
        The scenes with new ``mask``, ``is_fixed`` and ``parent``.
    """
    draws = torch.rand((2, len(batch)), generator=generator, device=stage.device)
    last = (draws[0] >= settings.task).long() + (draws[0] >= settings.task + settings.important).long()
    return prefix(batch, stage, last, draws[1] < settings.fixed)


def prefix(batch: LayoutBatch, stage: Tensor, last: Tensor, is_frozen: Tensor) -> LayoutBatch:
    """As `take_prefix`, for given last stages (B,) int64 and given scenes with fixed earlier objects (B,) bool."""
    is_staged = (stage >= 0).where(batch.mask, True).all(1)
    mask = batch.mask & ((stage <= last[:, None]) | ~is_staged[:, None])
    mask = torch.where(mask.any(1, keepdim=True), mask, batch.mask)
    is_earlier = mask & (stage < last[:, None]) & (is_frozen & is_staged)[:, None]
    is_earlier &= (mask & ~is_earlier).any(1, keepdim=True)
    parent = torch.where(mask, batch.parent, NO_PARENT)
    is_lost = (parent >= 0) & ~mask.gather(1, parent.clamp_min(0))  # the parent is of a later stage
    return replace(batch, mask=mask, is_fixed=batch.is_fixed | is_earlier, parent=torch.where(is_lost, NO_PARENT, parent))


def drop_empty_slots(batch: LayoutBatch) -> LayoutBatch:
    """Moves objects before padding and removes slots that no scene needs; at least one remains. Directions must not be known."""
    order = torch.argsort(~batch.mask, dim=1, stable=True)
    new_index = torch.argsort(order, dim=1)
    num_slots = max(1, int(batch.mask.sum(1).max())) if len(batch) else 1
    order = order[:, :num_slots]

    def reorder(value: Tensor) -> Tensor:
        return value.gather(1, order.reshape(*order.shape, *[1] * (value.dim() - 2)).expand(-1, -1, *value.shape[2:]))

    parent = torch.where(batch.parent >= 0, new_index.gather(1, batch.parent.clamp_min(0)), batch.parent)
    return replace(
        batch,
        poses=reorder(batch.poses),
        mask=reorder(batch.mask),
        sizes=reorder(batch.sizes),
        shape_index=reorder(batch.shape_index),
        is_fixed=reorder(batch.is_fixed),
        parent=reorder(parent),
        features=None if batch.features is None else reorder(batch.features),
        texts=None if batch.texts is None else reorder(batch.texts),
        coarse=None if batch.coarse is None else reorder(batch.coarse),
    )
