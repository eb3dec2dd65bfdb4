"""Settings of a run: frozen dataclasses, filled from a TOML file and ``--set key=value``, with every mistake named."""

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

from pipelines.retired import RETIRED
from stable_data.config_diff import flat
from stable_data.errors import ConfigError

C = TypeVar("C")

SECTIONS = ("preprocess", "correct", "edit", "generate", "train_corrector", "train_reasoner")
"""Tables that a file may have: one for each job."""


def resolve(kind: type[C], section: str, file: Path | None, overrides: Iterable[str], base: C | None = None) -> C:
    """The settings of one job.

    Args:
        kind: A frozen dataclass whose fields are str, one of several words, int, float, bool, a frozenset of str (given as a
            list), one of these or None, or such dataclasses again, all with defaults. A class variable ``REMOVED`` says for
            settings of earlier versions what to do instead.
        section: Its table in the file; nested settings are tables in it.
        file: A TOML file, or None.
        overrides: ``key=value`` or ``section.key=value``, stronger than the file; ``outer.inner=value`` for nested settings.
        base: What stands where neither says anything; by default the defaults.

    Raises:
        ConfigError: A table or key is not known, or a value has the wrong type or is not finite.
    """
    values = flat(_section(file, section)) if file else {}
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: expected key=value", "config_invalid")
        values[key.strip().removeprefix(f"{section}.")] = _parsed(value.strip())
    return _filled(kind() if base is None else base, section, values)


def _filled(base: C, name: str, values: Mapping[str, Any]) -> C:
    """Settings with some of their values, by dotted key, replaced."""
    hints = {key: hint for key, hint in get_type_hints(type(base)).items() if get_origin(hint) is not ClassVar}
    changed: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for key, value in values.items():
        head, _, rest = key.partition(".")
        if instead := getattr(type(base), "REMOVED", {}).get(head):
            raise ConfigError(f"setting {name}.{key} is no more: {instead}", "config_invalid")
        if head not in hints:
            raise ConfigError(f"setting {name}.{key} is not known{_hint(head, hints)}", "config_invalid")
        if is_dataclass(hints[head]) and rest:
            inner.setdefault(head, {})[rest] = value
        elif rest:
            raise ConfigError(f"setting {name}.{key} is not known: {name}.{head} is a value", "config_invalid")
        else:
            changed[key] = _checked(value, hints[key], f"{name}.{key}", getattr(base, key))
    for head, of_head in inner.items():
        changed[head] = _filled(getattr(base, head), f"{name}.{head}", of_head)
    return replace(base, **changed)  # type: ignore[type-var]


def _checked(value: Any, wanted: Any, name: str, example: Any) -> Any:
    """A value of the type that a setting wants."""
    if isinstance(wanted, UnionType):  # None can be a default, but no file says it
        wanted = next(option for option in get_args(wanted) if option is not NoneType)
    if wanted == frozenset[str]:
        if not isinstance(value, list) or not all(isinstance(word, str) for word in value):
            raise ConfigError(f"setting {name} is {value!r}, expected a list of words", "config_invalid")
        return frozenset(value)
    if wanted is float and type(value) is int:
        value = float(value)
    words = get_args(wanted) if get_origin(wanted) is Literal else ()
    if is_dataclass(wanted) or (value not in words if words else type(value) is not wanted):
        expected = " or ".join(words) or ("a table" if is_dataclass(wanted) else f"{wanted.__name__} such as {example!r}")
        raise ConfigError(f"setting {name} is {value!r}, expected {expected}", "config_invalid")
    if wanted is float and not math.isfinite(value):
        raise ConfigError(f"setting {name} is {value}, expected a finite number", "config_invalid")
    return value


def _section(file: Path, section: str) -> Mapping[str, Any]:
    try:
        document = tomllib.loads(file.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read as TOML ({error})", "config_invalid") from error
    known = dict.fromkeys((section, *SECTIONS))
    for name in document:
        if name in RETIRED:
            raise ConfigError(f"{file}: the table [{name}] is of a verb that is retired; write {RETIRED[name]}", "retired")
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
