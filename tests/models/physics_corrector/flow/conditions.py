"""Conditions and small networks for the tests of the corrector's network and flow."""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from models.physics_corrector.flow.condition import Condition
from models.physics_corrector.flow.flow_matching import FlowSettings
from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.flow.velocity_network import VelocityNetwork, VelocityNetworkSettings

NUM_FEATURES, NUM_TEXTS = 8, 6
PER_OBJECT = ("poses", "mask", "sizes", "is_fixed", "parent", "features", "texts")

SMALL: dict[str, Any] = {
    "channels": 32,
    "levels": 2,
    "heads": 2,
    "context_channels": 32,
    "time_channels": 32,
    "pair_channels": 16,
    "num_features": NUM_FEATURES,
    "code_channels": 8,
    "num_texts": NUM_TEXTS,
    "text_channels": 8,
    "reads_errors": True,
}


def small_settings(backbone: str = "unet1d", flow: FlowSettings | None = None, **changes: Any) -> CorrectorSettings:
    shape = {**SMALL, "backbone": backbone, "reads_order": backbone == "set_transformer", **changes}
    return CorrectorSettings(VelocityNetworkSettings(**shape), flow or FlowSettings())


def awake_network(settings: CorrectorSettings, seed: int = 0) -> VelocityNetwork:
    """A network whose layers that start at zero do not: otherwise every test of it would pass."""
    torch.manual_seed(seed)
    network, _ = settings.build()
    for parameter in network.parameters():
        if not parameter.any():
            nn.init.normal_(parameter, std=0.2)
    return network.eval()


def condition(num_scenes: int, num_objects: int, *, seed: int = 0, real: int | None = None) -> Condition:
    """Random scenes; the first ``real`` objects are there. Objects stand on the table, on an earlier object, or on nothing."""
    g = torch.Generator().manual_seed(seed)
    lead = (num_scenes, num_objects)
    poses = torch.rand(*lead, 4, generator=g) * torch.tensor([1.2, 0.8, 0.2, 6.0]) - torch.tensor([0, 0, 0, 3.0])
    parent = torch.randint(-2, max(num_objects, 1), lead, generator=g)
    place = torch.arange(num_objects).expand(lead)
    known = torch.randint(-1, 2, (num_scenes, num_objects, num_objects, 2), generator=g).float()
    error = torch.rand(num_scenes, 2, generator=g)
    return Condition(
        poses=poses,
        mask=place < (num_objects if real is None else real),
        sizes=torch.rand(*lead, 3, generator=g) * 0.15 + 0.02,
        is_fixed=torch.rand(lead, generator=g) < 0.25,
        parent=torch.where(parent < place, parent, -1),
        table=torch.rand(num_scenes, 2, generator=g) + 0.8,
        zone=torch.tensor([0.2, 0.5, 0.1, 0.3]).expand(num_scenes, 4),
        has_zone=torch.arange(num_scenes) % 2 == 0,
        features=torch.randn(*lead, NUM_FEATURES, generator=g),
        texts=torch.randn(*lead, NUM_TEXTS, generator=g),
        table_text=torch.randn(num_scenes, NUM_TEXTS, generator=g),
        error=torch.where(error < 0.3, torch.nan, error),
        order=known - known.transpose(1, 2),
    )


def permuted(scenes: Condition, order: Tensor) -> Condition:
    """The same scenes with object ``order[i]`` at place i, parents renamed accordingly."""
    changed = {name: getattr(scenes, name)[:, order] for name in PER_OBJECT}
    now_at = torch.argsort(order)
    parent = changed["parent"]
    changed["parent"] = torch.where(parent >= 0, now_at[parent.clamp_min(0)], parent)
    assert scenes.order is not None
    changed["order"] = scenes.order[:, order][:, :, order]
    return replace(scenes, **changed)


def padded(scenes: Condition, extra: int) -> Condition:
    """The same scenes with ``extra`` slots of garbage, some of it nan, as a careless batch would hold it."""
    num_scenes = len(scenes.mask)
    fill: dict[str, Any] = {
        "poses": math.nan,
        "sizes": -3.0,
        "features": math.inf,
        "texts": math.nan,
        "parent": 0,
        "is_fixed": True,
        "mask": False,
    }
    changed = {}
    for name in PER_OBJECT:
        value = getattr(scenes, name)
        changed[name] = torch.cat([value, torch.full((num_scenes, extra, *value.shape[2:]), fill[name], dtype=value.dtype)], 1)
    assert scenes.order is not None
    num_objects = scenes.mask.shape[1]
    changed["order"] = torch.full((num_scenes, num_objects + extra, num_objects + extra, 2), math.nan)
    changed["order"][:, :num_objects, :num_objects] = scenes.order
    return Condition.of(replace(scenes, **changed))


def query(scenes: Condition, seed: int = 1) -> tuple[Tensor, Tensor]:
    """Coordinates and times to ask a network at."""
    g = torch.Generator().manual_seed(seed)
    return torch.randn(*scenes.mask.shape, 4, generator=g), torch.rand(len(scenes.mask), generator=g)
