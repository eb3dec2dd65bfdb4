"""Settings of a run: frozen dataclasses, filled from a TOML file and ``--set key=value``, with every mistake named."""

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from stable_data.errors import ConfigError

C = TypeVar("C")

SECTIONS = ("preprocess",)
"""Tables that a file may have: one for each job."""


def resolve(kind: type[C], section: str, file: Path | None, overrides: Iterable[str]) -> C:
    """The settings of one job.

    Args:
        kind: A frozen dataclass whose fields are str, int, float or bool, all with defaults.
        section: Its table in the file.
        file: A TOML file, or None.
        overrides: ``key=value`` or ``section.key=value``, stronger than the file.

    Raises:
        ConfigError: A table or key is not known, or a value has the wrong type or is not finite.
    """
    values = dict(_section(file, section)) if file else {}
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: expected key=value", "config_invalid")
        values[key.strip().removeprefix(f"{section}.")] = _parsed(value.strip())
    hints = get_type_hints(kind)
    for key, value in values.items():
        if key not in hints:
            raise ConfigError(f"setting {section}.{key} is not known{_hint(key, hints)}", "config_invalid")
        wanted = hints[key]
        if wanted is float and type(value) is int:
            values[key] = float(value)
        elif type(value) is not wanted:
            raise ConfigError(
                f"setting {section}.{key} is {value!r}, expected {wanted.__name__} such as {_default(kind, key)!r}",
                "config_invalid",
            )
        if wanted is float and not math.isfinite(values[key]):
            raise ConfigError(f"setting {section}.{key} is {value}, expected a finite number", "config_invalid")
    return kind(**values)


def differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """``key: was -> now`` for every setting that differs."""
    return [
        f"{key}: {was.get(key)} -> {now.get(key)}" for key in sorted(was.keys() | now.keys()) if was.get(key) != now.get(key)
    ]


def _section(file: Path, section: str) -> Mapping[str, Any]:
    try:
        document = tomllib.loads(file.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read as TOML ({error})", "config_invalid") from error
    known = dict.fromkeys((section, *SECTIONS))
    for name in document:
        if name not in known:
            raise ConfigError(f"{file}: {name} is not a known table{_hint(name, known)}", "config_invalid")
    if section not in document:
        raise ConfigError(f"{file}: has no table [{section}], expected one; an empty one takes all defaults", "config_invalid")
    found = document[section]
    if not isinstance(found, dict):
        raise ConfigError(f"{file}: {section} is {found!r}, expected a table [{section}]", "config_invalid")
    return found


def _hint(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    return f"; did you mean {near[0]}?" if near else f"; known are {', '.join(known)}"


def _parsed(value: str) -> Any:
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return value  # a bare word is a string


def _default(kind: type, key: str) -> Any:
    return next(f.default for f in fields(kind) if f.name == key and f.default is not MISSING)
