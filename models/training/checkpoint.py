"""Where a training stands, kept so that another process can go on with it."""

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

# What torch.load raises on bytes that are no checkpoint, and what a checkpoint of something else lacks.
_UNREADABLE = (OSError, EOFError, RuntimeError, ValueError, KeyError, TypeError, pickle.UnpicklingError)

_ABOUT = "about"


def save_checkpoint(path: Path, state: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Writes a checkpoint in one step.

    Args:
        path: Where.
        state: Tensors and plain values.
        about: What shapes the training: settings, and fingerprints of what it learns from.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = temporary_path(path)
    try:
        with aside.open("wb") as file:
            torch.save({_ABOUT: json.dumps(about, sort_keys=True), **state}, file)
            file.flush()
            os.fsync(file.fileno())  # a rename must not outlive its content
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def load_checkpoint(path: Path, about: Mapping[str, Any], *needed: str) -> dict[str, Any] | None:
    """What :func:`save_checkpoint` wrote; None where nothing was.

    Args:
        path: Where.
        about: What shapes the training that wants to go on.
        needed: Keys of the state that it cannot go on without.

    Raises:
        ConfigError: It cannot be read (``checkpoint_invalid``), or is of another training (``config_changed``).
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
            f"{path}: cannot be read as a checkpoint ({type(error).__name__}); remove it to start anew", "checkpoint_invalid"
        ) from error
    refuse_changed(str(path), was, about)
    return state
