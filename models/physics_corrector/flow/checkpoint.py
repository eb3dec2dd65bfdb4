"""Checkpoints of a corrector: one file with weights and settings (:mod:`models.training.weights_file`).

The header of the file holds ``settings`` (JSON) and further notes, such as the fingerprint of the point encoder.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from models.physics_corrector.flow.flow_matching import FlowMatching
from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.flow.velocity_network import VelocityNetwork
from models.training.weights_file import build_no_larger_than, fill_network, read_notes, save_weights
from stable_data.errors import ConfigError

DEFAULT_WEIGHTS = Path(__file__).resolve().parents[2] / "weights" / "physics_corrector.safetensors"
"""The small corrector of this repository; models/weights/physics_corrector.md describes its training and its results."""

_SETTINGS = "settings"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A corrector read from a file.

    Attributes:
        settings: Its settings.
        network: Its network, in evaluation mode, on the CPU.
        flow: Its flow.
        notes: Further notes of the header.
    """

    settings: CorrectorSettings
    network: VelocityNetwork
    flow: FlowMatching
    notes: Mapping[str, str]


def save_corrector(
    path: Path, settings: CorrectorSettings, state: Mapping[str, Tensor], notes: Mapping[str, str] | None = None
) -> None:
    """Writes a corrector's weights atomically.

    Args:
        path: The file to write.
        settings: The settings of the network and its flow.
        state: The network's ``state_dict()``, or an average of several.
        notes: Further notes for the header, such as the fingerprint of the encoder.

    Raises:
        ConfigError: A note has the reserved name ``settings``.
    """
    if notes and _SETTINGS in notes:
        raise ConfigError(f"{path}: the note name {_SETTINGS!r} is reserved, expected another name", "config_invalid")
    save_weights(path, state, {**(notes or {}), _SETTINGS: settings.to_json()})


def load_corrector(path: Path, expected: CorrectorSettings | None = None) -> Checkpoint:
    """Reads a corrector from its file.

    Args:
        path: The file.
        expected: The settings that the file must have; None accepts any.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``), has no settings or values that are not finite (likewise), or
            has other settings than expected or tensors that do not match its settings (``checkpoint_mismatch``).
    """
    notes = read_notes(path)
    if _SETTINGS not in notes:
        raise ConfigError(f"{path}: has no settings in its header, expected weights of a corrector", "checkpoint_invalid")
    settings = CorrectorSettings.from_json(notes.pop(_SETTINGS))
    if expected is not None and (changed := settings.differences(expected)):
        raise ConfigError(
            f"{path}: was written with other settings ({'; '.join(changed)}), expected the same; "
            "train again or use the settings of the file",
            "checkpoint_mismatch",
        )
    network, flow = build_no_larger_than(path, settings.build)
    fill_network(path, network)
    return Checkpoint(settings, network.eval(), flow, notes)
