"""Checkpoints of a training, with which another process can resume it."""

import json
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from stable_data.atomic_files import temporary_path
from stable_data.config_diff import flatten_config, refuse_changed
from stable_data.errors import ConfigError

# The errors of torch.load for bytes that are not a checkpoint, and those for missing keys.
_UNREADABLE = (
    *(AssertionError, AttributeError, EOFError, LookupError, OSError, RuntimeError, TypeError, ValueError),
    pickle.UnpicklingError,
)  # of torch, too, which asserts that what it reads has the right type

_ABOUT = "about"


def save_checkpoint(path: Path, state: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Writes a checkpoint atomically.

    Args:
        path: The file to write.
        state: Tensors and plain values.
        about: What determines the training: settings, and fingerprints of the training data.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = temporary_path(path)
    try:
        with aside.open("wb") as file:
            torch.save({_ABOUT: json.dumps(about, sort_keys=True), **state}, file)
            file.flush()
            os.fsync(file.fileno())  # after a crash, the renamed file must not exist without its content
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def load_checkpoint(path: Path, about: Mapping[str, Any], *needed: str) -> dict[str, Any] | None:
    """Reads a checkpoint of :func:`save_checkpoint`; returns None if there is no file.

    Args:
        path: The file to read.
        about: What determines the training that resumes.
        needed: Required keys of the state.

    Raises:
        ConfigError: The file cannot be read (``checkpoint_invalid``) or is from another training (``config_changed``).
    """
    if not path.is_file():
        return None
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        was = flatten_config(json.loads(state[_ABOUT]))
        for key in needed:
            _ = state[key]
    except _UNREADABLE as error:
        raise ConfigError(
            f"{path}: cannot be read as a checkpoint ({type(error).__name__}); remove it to start again", "checkpoint_invalid"
        ) from error
    refuse_changed(str(path), was, about)
    return state
