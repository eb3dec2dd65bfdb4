"""Files of weights: one safetensors file with tensors and notes, without pickle. Equal weights give equal bytes.

A file whose tensors differ from the network that its notes describe is refused.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn.modules.module import (
    register_module_buffer_registration_hook,
    register_module_module_registration_hook,
    register_module_parameter_registration_hook,
)
from torch.overrides import TorchFunctionMode

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import ConfigError

T = TypeVar("T")

_MAX_LISTED = 6  # mismatches that a message lists
_OF_MODULE = 1000  # numbers that a module counts for, however small: its objects take some kilobytes
_SLACK = 1 << 20  # numbers of a network that its file need not have, such as buffers


def save_weights(path: Path, state: Mapping[str, Tensor], notes: Mapping[str, str]) -> None:
    """Writes weights atomically.

    Args:
        path: The file to write.
        state: The network's ``state_dict()``, or an average of several.
        notes: Notes of the header.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {name: value.detach().cpu().contiguous() for name, value in state.items()}
    # safetensors.save_file would write a file that only its owner may read.
    write_file_atomically(path, _with_sorted_header(save(tensors, dict(notes))))


def _with_sorted_header(content: bytes) -> bytes:
    """Sorts the notes of a safetensors file: the library writes them in a random order, and equal files must be equal bytes."""
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    ordered = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    assert len(ordered) <= length  # the same entries; padding keeps the offsets of the tensors
    return content[:8] + ordered.ljust(length) + content[8 + length :]


def read_notes(path: Path) -> dict[str, str]:
    """Reads the notes of a file of weights.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``).
    """
    try:
        with safe_open(path, framework="pt") as file:
            return dict(file.metadata() or {})
    except (OSError, SafetensorError) as error:
        raise _unreadable(path, error) from error


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Reads the tensors and the notes of a file of weights, for a network that fills itself.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``).
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
            return tensors, dict(file.metadata() or {})
    except (OSError, SafetensorError) as error:
        raise _unreadable(path, error) from error


def fill_network(path: Path, network: nn.Module) -> None:
    """Reads weights from a file into a network.

    Raises:
        ConfigError: The file cannot be read or has values that are not finite (``checkpoint_invalid``), or its tensors are not those
            of the network (``checkpoint_mismatch``).
    """
    required = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    try:
        with safe_open(path, framework="pt") as file:
            found = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118 - no mapping
            if wrong := _mismatches(found, required):
                rest = f"; and {len(wrong) - _MAX_LISTED} more" if len(wrong) > _MAX_LISTED else ""
                listed = "; ".join(wrong[:_MAX_LISTED]) + rest
                raise ConfigError(f"{path}: its tensors do not match its settings ({listed})", "checkpoint_mismatch")
            tensors = {name: file.get_tensor(name) for name in required}
    except (OSError, SafetensorError) as error:
        raise _unreadable(path, error) from error
    if broken := [name for name, value in tensors.items() if not value.isfinite().all()]:
        raise ConfigError(
            f"{path}: {broken[0]} and {len(broken) - 1} more tensors have values that are not finite, expected finite "
            "weights; use an earlier checkpoint",
            "checkpoint_invalid",
        )
    network.load_state_dict(tensors)


def build_no_larger_than(path: Path, build: Callable[[], T]) -> T:
    """Builds the network that a file describes, which must not have more numbers than the file has bytes; a module counts for some.

    The notes of a file from elsewhere, or the shapes of its tensors, may describe a network of any size, and its tensors are
    compared only when it is built. It is first built without memory for its numbers.

    Args:
        path: The file.
        build: Builds the network.

    Returns:
        What ``build`` returns.

    Raises:
        ConfigError: The network is larger (``weights_invalid``).
    """
    left = path.stat().st_size + _SLACK

    def count(num: int) -> None:
        nonlocal left
        left -= num
        if left < 0:
            raise ConfigError(
                f"{path}: it describes a network with more numbers than the file has bytes, or too many modules for these numbers, "
                "expected the network of its tensors; do not trust it",
                "weights_invalid",
            )

    def count_tensor(module: nn.Module, name: str, tensor: Tensor | None) -> None:
        count(0 if tensor is None else tensor.numel())

    def count_module(module: nn.Module, name: str, part: nn.Module | None) -> None:
        count(0 if part is None else _OF_MODULE)

    hooks = [
        register_module_parameter_registration_hook(count_tensor),
        register_module_buffer_registration_hook(count_tensor),
        register_module_module_registration_hook(count_module),
    ]
    try:
        with torch.device("meta"), _NoDraws():
            build()
    finally:
        for hook in hooks:
            hook.remove()
    return build()


class _NoDraws(TorchFunctionMode):
    """Leaves out the draws of initial weights: without memory they do nothing, but the first one imports torch's compiler for seconds."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is nn.init.normal_:
            return kwargs["tensor"]
        return func(*args, **(kwargs or {}))


def _mismatches(found: Mapping[str, tuple[int, ...]], required: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Returns ``tensor: found shape, expected shape`` for each difference."""
    names = sorted(name for name in found.keys() | required.keys() if found.get(name) != required.get(name))
    return [f"{name}: found {found.get(name, 'none')}, expected {required.get(name, 'none')}" for name in names]


def _unreadable(path: Path, error: Exception) -> ConfigError:
    return ConfigError(f"{path}: cannot be read as safetensors ({error})", "checkpoint_invalid")
