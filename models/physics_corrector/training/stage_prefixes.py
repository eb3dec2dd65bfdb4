"""The layouts that Algorithm 1 hands to the corrector: O^t, then O^t ∪ O^B, then the whole scene; earlier objects may be fixed."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.scene_tensors import NO_PARENT
from models.settings import Settings, Share
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class PrefixSettings(Settings):
    """Which part of a scene is trained on."""

    task: Share = 0.2
    """Share of samples that end with O^t."""

    important: Share = 0.2
    """Share of samples that end with O^B; the rest are whole scenes."""

    fixed: Share = 0.4
    """Share of samples in which the objects of earlier stages are fixed at their clean pose; in the others they may move."""

    def check(self) -> None:
        """Refuses shares over 1; see the base class."""
        if self.task + self.important > 1:
            found = f"task {self.task}, important {self.important}"
            raise ConfigError(f"prefixes: {found}, expected shares that add up to at most 1", "config_invalid")


def take_prefix(batch: LayoutBatch, stage: Tensor, settings: PrefixSettings, generator: torch.Generator) -> LayoutBatch:
    """A prefix of each scene.

    A prefix without objects is replaced by the whole scene; where a stage adds nothing, nothing is fixed.

    Args:
        batch: Whole scenes.
        stage: Stage of each object, 0 O^t, 1 O^B, 2 O^b, negative where a scene is not staged, (B, N) int64.
        settings: Shares.
        generator: Randomness, on the batch's device.

    Returns:
        The scenes: ``mask`` ends with the stage that was drawn, ``is_fixed`` says which earlier objects are.
    """
    draws = torch.rand((2, len(batch)), generator=generator, device=stage.device)
    last = (draws[0] >= settings.task).long() + (draws[0] >= settings.task + settings.important).long()
    return prefix(batch, stage, last, draws[1] < settings.fixed)


def prefix(batch: LayoutBatch, stage: Tensor, last: Tensor, is_frozen: Tensor) -> LayoutBatch:
    """As `cut`, with the last stage (B,) int64 and whether earlier objects are fixed (B,) bool given."""
    is_staged = (stage >= 0).where(batch.mask, True).all(1)
    mask = batch.mask & ((stage <= last[:, None]) | ~is_staged[:, None])
    mask = torch.where(mask.any(1, keepdim=True), mask, batch.mask)
    is_earlier = mask & (stage < last[:, None]) & (is_frozen & is_staged)[:, None]
    is_earlier &= (mask & ~is_earlier).any(1, keepdim=True)
    parent = torch.where(mask, batch.parent, NO_PARENT)
    is_gone = (parent >= 0) & ~mask.gather(1, parent.clamp_min(0))  # a carrier comes with or before what it carries
    return replace(batch, mask=mask, is_fixed=batch.is_fixed | is_earlier, parent=torch.where(is_gone, NO_PARENT, parent))


def drop_empty_slots(batch: LayoutBatch) -> LayoutBatch:
    """The same scenes with their objects first and no more slots than the fullest one needs, at least one."""
    order = torch.argsort(~batch.mask, dim=1, stable=True)
    place = torch.argsort(order, dim=1)
    num_slots = max(1, int(batch.mask.sum(1).max())) if len(batch) else 1
    order = order[:, :num_slots]

    def moved(value: Tensor) -> Tensor:
        return value.gather(1, order.reshape(*order.shape, *[1] * (value.dim() - 2)).expand(-1, -1, *value.shape[2:]))

    parent = torch.where(batch.parent >= 0, place.gather(1, batch.parent.clamp_min(0)), batch.parent)
    return replace(
        batch,
        poses=moved(batch.poses),
        mask=moved(batch.mask),
        sizes=moved(batch.sizes),
        shape_index=moved(batch.shape_index),
        is_fixed=moved(batch.is_fixed),
        parent=moved(parent),
        features=None if batch.features is None else moved(batch.features),
    )
