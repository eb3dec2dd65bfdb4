"""Nested configurations by dotted keys, and the differences between two of them: settings, fingerprints of inputs."""

import json
from collections.abc import Mapping
from typing import Any

from stable_data.errors import ConfigError


def flatten_config(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested values by their dotted keys; an empty dictionary counts as a value."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= flatten_config(value, f"{prefix}{key}.") if isinstance(value, dict) and value else {prefix + key: value}
    return flat


def config_differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Returns ``key: was -> now`` for every key whose value differs."""
    return [
        f"{key}: {was.get(key)} -> {now.get(key)}" for key in sorted(was.keys() | now.keys()) if was.get(key) != now.get(key)
    ]


def refuse_changed(where: str, was: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuses to continue work that was started with another configuration.

    Args:
        where: The folder or file that was made.
        was: The configuration that it was made with, as read from JSON.
        now: The current configuration; it is converted to JSON first, so that a tuple equals a list.

    Raises:
        ConfigError: ``config_changed``: a value differs; the message lists ``key: was -> now``.
    """
    # The JSON round trip turns tuples into lists, as in the stored configuration.
    if changed := config_differences(flatten_config(was), flatten_config(json.loads(json.dumps(now)))):
        found = f"was made with another configuration ({'; '.join(changed)})"
        raise ConfigError(f"{where}: {found}; choose a new folder or restore it", "config_changed")
