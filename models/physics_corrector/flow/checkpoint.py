"""Weights of a corrector as one safetensors file that carries its settings: loaded strictly, or refused.

Nothing is pickled. The header of the file holds ``settings`` (JSON) and whatever else the writer wants to be known, such as the
encoder whose features the network reads.
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
"""Our own small corrector; models/weights/README.md says how it was made and what it does."""

_SETTINGS = "settings"
_NAMED = 6  # how many of many mismatches a message names


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A corrector read from a file.

    Attributes:
        settings: Its settings.
        network: Its network, in evaluation mode, on the CPU.
        flow: Its flow.
        notes: What else the writer wanted to be known.
    """

    settings: CorrectorSettings
    network: VelocityNetwork
    flow: FlowMatching
    notes: Mapping[str, str]


def save_corrector(
    path: Path, settings: CorrectorSettings, state: Mapping[str, Tensor], notes: Mapping[str, str] | None = None
) -> None:
    """Writes a corrector's weights in one step: a reader sees the whole file or none.

    Args:
        path: Where to.
        settings: What the weights belong to.
        state: The network's ``state_dict()``, or an average of several.
        notes: What else is to be known, such as the fingerprint of the encoder.
    """
    if notes and _SETTINGS in notes:
        raise ConfigError(f"{path}: the note {_SETTINGS!r} is taken, expected another name", "config_invalid")
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    # Not by the library's own writer of files, whose files nobody but their owner may read.
    write_file_atomically(path, _with_sorted_header(save(tensors, {**(notes or {}), _SETTINGS: settings.to_json()})))


def _with_sorted_header(content: bytes) -> bytes:
    """Puts what a safetensors file says of itself into order: the library writes it in another one each time."""
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    ordered = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    assert len(ordered) <= length  # the same, in another order
    return content[:8] + ordered.ljust(length) + content[8 + length :]


def load_corrector(path: Path, expected: CorrectorSettings | None = None) -> Checkpoint:
    """A corrector from its file.

    Args:
        path: The file.
        expected: Settings that it must have been written with; None takes what it says.

    Raises:
        ConfigError: The file cannot be read, says nothing of its settings, was written with others, or holds other tensors than
            its settings ask for, or such as are not finite.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = dict(file.metadata() or {})
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 - no mapping
            if _SETTINGS not in header:
                raise ConfigError(f"{path}: says nothing of its settings, expected a corrector's weights", "checkpoint_invalid")
            settings = CorrectorSettings.from_json(header.pop(_SETTINGS))
            if expected is not None and (changed := settings.differences(expected)):
                raise ConfigError(
                    f"{path}: was written with other settings ({'; '.join(changed)}), expected the same; "
                    "train anew or take the settings of the file",
                    "checkpoint_mismatch",
                )
            network, flow = settings.build()
            wanted = {name: tuple(value.shape) for name, value in network.state_dict().items()}
            if wrong := _mismatches(shapes, wanted):
                listed = "; ".join(wrong[:_NAMED]) + (f"; and {len(wrong) - _NAMED} more" if len(wrong) > _NAMED else "")
                raise ConfigError(f"{path}: its tensors do not fit its settings ({listed})", "checkpoint_mismatch")
            tensors = {name: file.get_tensor(name) for name in wanted}
            if broken := [name for name, value in tensors.items() if not value.isfinite().all()]:
                raise ConfigError(
                    f"{path}: {broken[0]} and {len(broken) - 1} more hold numbers that are not finite, expected weights; "
                    "take an earlier checkpoint",
                    "checkpoint_invalid",
                )
            network.load_state_dict(tensors)
    except (OSError, SafetensorError) as error:
        raise ConfigError(f"{path}: cannot be read as safetensors ({error})", "checkpoint_invalid") from error
    return Checkpoint(settings, network.eval(), flow, header)


def _mismatches(found: Mapping[str, tuple[int, ...]], wanted: Mapping[str, tuple[int, ...]]) -> list[str]:
    """``tensor: found shape, expected shape`` wherever the two differ."""
    names = sorted(name for name in found.keys() | wanted.keys() if found.get(name) != wanted.get(name))
    return [f"{name}: found {found.get(name, 'none')}, expected {wanted.get(name, 'none')}" for name in names]
