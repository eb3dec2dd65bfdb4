"""The settings of a corrector, its presets, and their JSON form."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from models.physics_corrector.flow.flow_matching import FlowMatching, FlowSettings
from models.physics_corrector.flow.pose_coordinates import PoseCoordinates
from models.physics_corrector.flow.velocity_network import VelocityNetwork, VelocityNetworkSettings
from models.settings import Settings, settings_from_json, settings_to_json
from stable_data.config_diff import config_differences, flatten_config
from stable_data.errors import ConfigError


@dataclass(frozen=True, slots=True)
class CorrectorSettings(Settings):
    """The settings that a corrector's weights belong to."""

    network: VelocityNetworkSettings = field(default_factory=VelocityNetworkSettings)
    """The shape of the velocity network."""

    flow: FlowSettings = field(default_factory=FlowSettings)
    """The settings of paths and solver."""

    def build(self) -> tuple[VelocityNetwork, FlowMatching]:
        """Builds an untrained network and the flow that trains and samples it."""
        return VelocityNetwork(self.network, self.flow.coordinates), FlowMatching(self.flow)

    def to_json(self) -> str:
        """Returns the settings as JSON with sorted keys."""
        return settings_to_json(self)

    @classmethod
    def from_json(cls, text: str) -> "CorrectorSettings":
        """Reads settings from JSON, such as the header of a checkpoint.

        Raises:
            ConfigError: The text is not a JSON object, or a key is missing, unknown or of the wrong type.
        """
        return settings_from_json(cls, text, "corrector")

    def differences(self, other: "CorrectorSettings") -> list[str]:
        """Returns ``key: was -> now`` for every setting in which ``other`` differs."""
        return config_differences(flatten_config(asdict(self)), flatten_config(asdict(other)))


_TEXTS = 384  # of the packaged text encoder
_TOLD: dict[str, Any] = {"num_texts": _TEXTS, "reads_errors": True}
_STANDING = FlowSettings(heights="geometry", source="expected", steps=2)

PRESETS: Mapping[str, CorrectorSettings] = {
    # The paper's width, self-conditioning and absolute poses; the paper does not give levels, heads and widths: these are its
    # predecessors'.
    "paper": CorrectorSettings(flow=FlowSettings(PoseCoordinates("absolute", 1.0, 1.0), sigma=0.02)),
    # The same network with residual coordinates.
    "paper_tuned": CorrectorSettings(),
    # Smaller networks for a CPU, which are told more than the paper's and leave heights to geometry.
    "embedded": CorrectorSettings(
        VelocityNetworkSettings(
            channels=96, levels=3, heads=4, context_channels=96, time_channels=192, code_channels=32, **_TOLD
        ),
        _STANDING,
    ),
    # Set transformers with about the cost of the two above; the weights of `embedded_set` are in the repository.
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
            reads_order=True,
            **_TOLD,
        ),
        _STANDING,
    ),
}
"""Named settings."""


def preset(name: str) -> CorrectorSettings:
    """Returns the settings of a name of PRESETS.

    Raises:
        ConfigError: The name is unknown.
    """
    if name not in PRESETS:
        raise ConfigError(f"corrector preset {name!r} is unknown, expected one of {', '.join(PRESETS)}", "config_invalid")
    return PRESETS[name]
