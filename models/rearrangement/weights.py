"""The file of a rearranger: weights with their settings (:mod:`models.training.weights_file`)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from torch import Tensor

from models.physics_corrector.flow.velocity_network import VelocityNetwork
from models.rearrangement.lego_net import LegoNet
from models.rearrangement.settings import RearrangerSettings
from models.rearrangement.struct_diffusion import StructDiffusion
from models.settings import settings_from_json, settings_to_json
from models.training.weights_file import build_no_larger_than, fill_network, read_notes, save_weights
from stable_data.errors import ConfigError

RearrangementMethod: TypeAlias = LegoNet | StructDiffusion
"""A method: what it is trained by, and how it moves objects."""

_FORMAT = "stable-data rearranger 1"


@dataclass(frozen=True, slots=True, eq=False)
class RearrangerWeights:
    """A rearranger read from a file.

    Attributes:
        settings: Its settings.
        network: Its network, in evaluation mode, on the CPU.
        notes: Further notes of the header.
    """

    settings: RearrangerSettings
    network: VelocityNetwork
    notes: Mapping[str, str]


def method_of(settings: RearrangerSettings) -> RearrangementMethod:
    """Returns the method that settings name."""
    return LegoNet(settings) if settings.method == "lego_net" else StructDiffusion(settings)


def build_network(settings: RearrangerSettings) -> VelocityNetwork:
    """Builds an untrained network."""
    return VelocityNetwork(settings.network, settings.coordinates)


def save_rearranger(path: Path, settings: RearrangerSettings, state: Mapping[str, Tensor], notes: Mapping[str, str]) -> None:
    """Writes a rearranger atomically; equal ones give equal bytes.

    Args:
        path: The file to write.
        settings: Its settings.
        state: The network's ``state_dict()``, or an average of several.
        notes: Further notes for the header, such as the fingerprints of encoders and data.
    """
    save_weights(path, state, {**notes, "format": _FORMAT, "settings": settings_to_json(settings)})


def load_rearranger(path: Path) -> RearrangerWeights:
    """Reads a rearranger from its file.

    Raises:
        ConfigError: The file cannot be read, or is of something else or of another version (``checkpoint_invalid``,
            ``config_invalid``), or its tensors do not match its settings (``checkpoint_mismatch``).
    """
    notes = read_notes(path)
    if (found := notes.pop("format", None)) != _FORMAT or "settings" not in notes:
        raise ConfigError(
            f"{path}: its format is {found or 'not given'}, expected {_FORMAT}: weights that train-rearranger writes",
            "checkpoint_invalid",
        )
    settings = settings_from_json(RearrangerSettings, notes.pop("settings"), "rearranger")
    network = build_no_larger_than(path, lambda: build_network(settings))
    fill_network(path, network)
    return RearrangerWeights(settings, network.eval(), notes)
