"""Which network and flow: the settings of a corrector, the named ones, and their way to JSON and back."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from models.physics_corrector.flow.flow_matching import FlowMatching, FlowSettings
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from models.physics_corrector.flow.velocity_network import VelocityNetwork, VelocityNetworkSettings
from models.settings import Settings, fill_settings
from stable_data.config_diff import config_differences, flatten_config
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class CorrectorSettings(Settings):
    """What a corrector's weights mean something together with."""

    network: VelocityNetworkSettings = field(default_factory=VelocityNetworkSettings)
    """The shape of the velocity network."""

    flow: FlowSettings = field(default_factory=FlowSettings)
    """How paths are drawn and followed."""

    def build(self) -> tuple[VelocityNetwork, FlowMatching]:
        """An untrained network, and the flow that trains and samples it."""
        return VelocityNetwork(self.network, self.flow.coordinates), FlowMatching(self.flow)

    def to_json(self) -> str:
        """As JSON, keys sorted."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> "CorrectorSettings":
        """From JSON, such as a checkpoint's.

        Raises:
            ConfigError: It is no JSON object, or a key is missing, not known or of the wrong type.
        """
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"settings of a corrector: not JSON ({error})", "config_invalid") from error
        if not isinstance(values, dict):
            raise ConfigError(f"settings of a corrector: found {values!r:.80}, expected an object", "config_invalid")
        settings = fill_settings(cls, values, "corrector")
        if lacking := flatten_config(asdict(settings)).keys() - flatten_config(values).keys():
            raise ConfigError(f"settings of a corrector: found no {', '.join(sorted(lacking))}, expected all", "config_invalid")
        return settings

    def differences(self, other: "CorrectorSettings") -> list[str]:
        """``key: was -> now`` for every setting in which another differs from these."""
        return config_differences(flatten_config(asdict(self)), flatten_config(asdict(other)))


PRESETS: Mapping[str, CorrectorSettings] = {
    # The paper's width and self-conditioning; what it leaves open (levels, heads, widths of context and time) as its ancestors.
    "paper": CorrectorSettings(),
    # Its smaller sibling: what the weights in the repository are.
    "embedded": CorrectorSettings(
        VelocityNetworkSettings(channels=96, levels=3, heads=4, context_channels=96, time_channels=192, code_channels=32)
    ),
    # The set transformer at about the same cost as each.
    "paper_set": CorrectorSettings(VelocityNetworkSettings("set_transformer", levels=8, heads=8, time_channels=512)),
    "embedded_set": CorrectorSettings(
        VelocityNetworkSettings(
            "set_transformer",
            channels=128,
            levels=5,
            heads=4,
            context_channels=128,
            time_channels=128,
            pair_channels=32,
            code_channels=32,
        )
    ),
}
"""Named settings. The paper's absolute coordinates: ``replace(flow, coordinates=Coordinates("absolute", 1.0, 1.0))``."""


def preset(name: str) -> CorrectorSettings:
    """Named settings.

    Raises:
        ConfigError: There are none of that name.
    """
    if name not in PRESETS:
        raise ConfigError(f"corrector preset {name!r} is not known, expected one of {', '.join(PRESETS)}", "config_invalid")
    return PRESETS[name]


def absolute_preset(settings: CorrectorSettings) -> CorrectorSettings:
    """The same in the paper's absolute coordinates: metres and radians as they are."""
    flow = asdict(settings.flow) | {"coordinates": PoseCoordinates("absolute", 1.0, 1.0)}
    return CorrectorSettings(settings.network, FlowSettings(**flow))
