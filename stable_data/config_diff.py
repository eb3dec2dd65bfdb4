"""Nested values by their dotted keys, and how two of them differ: settings, fingerprints of inputs."""

from collections.abc import Mapping
from typing import Any


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by their dotted keys; what is empty stays as it is."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) and value else {prefix + key: value}
    return found


def differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """``key: was -> now`` for every key whose value differs."""
    return [
        f"{key}: {was.get(key)} -> {now.get(key)}" for key in sorted(was.keys() | now.keys()) if was.get(key) != now.get(key)
    ]
