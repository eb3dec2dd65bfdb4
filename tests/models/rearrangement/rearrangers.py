"""Small rearrangers for the tests."""

from typing import Any

from models.physics_corrector.flow.flow_matching import FlowSettings
from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.flow.velocity_network import VelocityNetwork, VelocityNetworkSettings
from models.rearrangement.settings import LegoNetSettings, Method, RearrangerSettings, StructDiffusionSettings
from tests.models.physics_corrector.flow.conditions import SMALL, awake_network

FEW_STEPS = LegoNetSettings(max_steps=6, still=0.0)
FEW_LEVELS = StructDiffusionSettings(times=6, samples=3)


def small(method: Method, **changes: Any) -> RearrangerSettings:
    """Few steps, and a network that reads what ``conditions`` have."""
    shape = {**SMALL, "backbone": "set_transformer", "reads_order": True, "reads_errors": method != "lego_net", **changes}
    return RearrangerSettings(method, VelocityNetworkSettings(**shape), lego_net=FEW_STEPS, struct_diffusion=FEW_LEVELS)


def boxes_alone(method: Method) -> RearrangerSettings:
    """One that reads neither features nor texts."""
    return small(method, num_features=0, num_texts=0)


def awake(settings: RearrangerSettings, seed: int = 0) -> VelocityNetwork:
    """A network whose head is not zero."""
    return awake_network(CorrectorSettings(settings.network, FlowSettings(settings.coordinates)), seed)
