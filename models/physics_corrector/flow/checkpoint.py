"""Checkpoints of a corrector: one safetensors file with weights and settings, without pickle.

The header of the file holds ``settings`` (JSON) and further notes, such as the fingerprint of the point encoder. A file whose
tensors differ from its settings is refused.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from models.physics_corrector.flow.flow_matching import FlowMatching
from models.physics_corrector.flow.presets import CorrectorSettings
from models.physics_corrector.flow.velocity_network import VelocityNetwork
from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError

DEFAULT_WEIGHTS = Path(__file__).resolve().parents[2] / "weights" / "physics_corrector.safetensors"
"""The small corrector of this repository; models/weights/README.md describes its training and its results."""

_SETTINGS = "settings"
_MAX_LISTED = 6  # mismatches that a message lists


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
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    # safetensors.save_file would write a file that only its owner may read.
    write_file_atomically(path, _with_sorted_header(save(tensors, {**(notes or {}), _SETTINGS: settings.to_json()})))


def _with_sorted_header(content: bytes) -> bytes:
    """Sorts the metadata of a safetensors file: the library writes them in a random order, and equal files must be equal bytes."""
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    ordered = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    assert len(ordered) <= length  # the same entries; padding keeps the offsets of the tensors
    return content[:8] + ordered.ljust(length) + content[8 + length :]


def load_corrector(path: Path, expected: CorrectorSettings | None = None) -> Checkpoint:
    """Reads a corrector from its file.

    Args:
        path: The file.
        expected: The settings that the file must have; None accepts any.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``), has no settings or values that are not finite (likewise), or
            has other settings than expected or tensors that do not match its settings (``checkpoint_mismatch``).
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = dict(file.metadata() or {})
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 - no mapping
            if _SETTINGS not in header:
                raise ConfigError(
                    f"{path}: has no settings in its header, expected weights of a corrector", "checkpoint_invalid"
                )
            settings = CorrectorSettings.from_json(header.pop(_SETTINGS))
            if expected is not None and (changed := settings.differences(expected)):
                raise ConfigError(
                    f"{path}: was written with other settings ({'; '.join(changed)}), expected the same; "
                    "train again or use the settings of the file",
                    "checkpoint_mismatch",
                )
            network, flow = settings.build()
            required = {name: tuple(value.shape) for name, value in network.state_dict().items()}
            if wrong := _mismatches(shapes, required):
                rest = f"; and {len(wrong) - _MAX_LISTED} more" if len(wrong) > _MAX_LISTED else ""
                listed = "; ".join(wrong[:_MAX_LISTED]) + rest
                raise ConfigError(f"{path}: its tensors do not match its settings ({listed})", "checkpoint_mismatch")
            tensors = {name: file.get_tensor(name) for name in required}
            if broken := [name for name, value in tensors.items() if not value.isfinite().all()]:
                raise ConfigError(
                    f"{path}: {broken[0]} and {len(broken) - 1} more tensors have values that are not finite, expected finite "
                    "weights; use an earlier checkpoint",
                    "checkpoint_invalid",
                )
            network.load_state_dict(tensors)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"{path}: cannot be read as safetensors ({error})", "checkpoint_invalid") from error
    return Checkpoint(settings, network.eval(), flow, header)


def _mismatches(found: Mapping[str, tuple[int, ...]], required: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Returns ``tensor: found shape, expected shape`` for each difference."""
    names = sorted(name for name in found.keys() | required.keys() if found.get(name) != required.get(name))
    return [f"{name}: found {found.get(name, 'none')}, expected {required.get(name, 'none')}" for name in names]
