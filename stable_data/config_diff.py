"""Nested values by their dotted keys, and how two of them differ: settings, fingerprints of inputs."""

import json
from collections.abc import Mapping
from typing import Any

from stable_data.errors import ConfigError


def flatten_config(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by their dotted keys; what is empty stays as it is."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flatten_config(value, f"{prefix}{key}.") if isinstance(value, dict) and value else {prefix + key: value}
    return found


def config_differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """``key: was -> now`` for every key whose value differs."""
    return [
        f"{key}: {was.get(key)} -> {now.get(key)}" for key in sorted(was.keys() | now.keys()) if was.get(key) != now.get(key)
    ]


def refuse_changed(where: str, was: Mapping[str, Any], now: Mapping[str, Any], *, instead: str = "") -> None:
    """Refuses to go on with what was made with another configuration.

    Args:
        where: What was made: a folder or a file.
        was: What it was made with, as its JSON has it.
        now: What it is to go on with; values as JSON has them.
        instead: What to do, where that is not to choose a new folder.

    Raises:
        ConfigError: A value differs: ``key: was -> now``.
    """
    if changed := config_differences(flatten_config(was), flatten_config(json.loads(json.dumps(now)))):
        remedy = instead or "choose a new folder or restore it"
        raise ConfigError(f"{where}: was made with another configuration ({'; '.join(changed)}); {remedy}", "config_changed")
