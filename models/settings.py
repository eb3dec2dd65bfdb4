"""The base of all settings classes: types with ranges, which pydantic checks, and errors of one line.

Settings are frozen dataclasses. The type of a field gives its valid values (:data:`Share`, ``Literal["adamw", "muon"]``), and
the docstring below the field gives its meaning, after its unit if it has one (``\"\"\"Metres; ...\"\"\"``). :meth:`Settings.check`
contains the checks that a type cannot express, such as those of two fields that depend on each other.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, TypeAlias, TypeVar, get_type_hints

from annotated_types import Ge, Gt, Interval
from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from stable_data.config_diff import flatten_config
from stable_data.errors import ConfigError

S = TypeVar("S")

Positive: TypeAlias = Annotated[float, Gt(0)]
NonNegative: TypeAlias = Annotated[float, Ge(0)]
Share: TypeAlias = Annotated[float, Interval(ge=0, le=1)]
Count: TypeAlias = Annotated[int, Ge(0)]
PositiveCount: TypeAlias = Annotated[int, Ge(1)]

_Kind: TypeAlias = Any  # a dataclass; for mypy a class is not hashable, which the argument of a cached function must be
_CONFIG = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
# Docstrings are looked for in the source of all modules, which takes seconds: only where they are shown.
_WITH_DOCSTRINGS = ConfigDict(**_CONFIG, use_attribute_docstrings=True)
_EXPECTED = {
    "bool_type": "true or false",
    "dataclass_type": "a table",
    "float_type": "a number",
    "frozen_set_type": "a list of words",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "int_type": "a whole number",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
    "string_type": "text",
}


class Settings:
    """Base of settings: the constructor checks each value against the type of its field."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ConfigError: A value has the wrong type or is out of its range, or values contradict each other.
        """
        kind: _Kind = type(self)
        values = {name: getattr(self, name) for name in _hints(kind)}
        try:
            _model_of_fields(kind).model_validate(values)
        except ValidationError as error:
            raise _config_error(error, getattr(self, "section", "")) from None
        self.check()

    def check(self) -> None:
        """Raises a ConfigError if values contradict each other."""


def fill_settings(kind: type[S], values: Mapping[str, Any], name: str) -> S:
    """Makes settings from nested values, such as those of a file; a missing value gets its default.

    Args:
        kind: A dataclass of settings.
        values: Field -> value; nested settings are mappings, sets are lists.
        name: Name of the settings in errors.

    Raises:
        ConfigError: A value has the wrong type or is out of its range, a key is unknown, or values contradict each other.
    """
    try:
        text = json.dumps({"value": values}, default=_as_json)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{name}: settings cannot be read ({error})", "config_invalid") from None
    cached: _Kind = kind
    try:
        found = _model_around(cached).model_validate_json(text)
    except ValidationError as error:
        raise _config_error(error, name) from None
    return found.value  # type: ignore[attr-defined, no-any-return]


def settings_to_json(settings: Any) -> str:
    """Returns settings, a dataclass, as JSON with sorted keys."""
    return json.dumps(asdict(settings), sort_keys=True)


def settings_from_json(kind: type[S], text: str, name: str) -> S:
    """Reads settings from JSON, such as the header of a file of weights.

    Args:
        kind: A dataclass of settings.
        text: The JSON text; it must have all values.
        name: What the settings are of, in errors.

    Raises:
        ConfigError: The text is not a JSON object, or a key is missing, unknown or of the wrong type.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"settings of a {name}: not JSON ({error})", "config_invalid") from error
    if not isinstance(values, dict):
        raise ConfigError(f"settings of a {name}: found {values!r:.80}, expected an object", "config_invalid")
    settings: Any = fill_settings(kind, values, name)
    # Defaults may change between versions: a file must give every value that its weights were trained with.
    if missing := flatten_config(asdict(settings)).keys() - flatten_config(values).keys():
        raise ConfigError(f"settings of a {name}: found no {', '.join(sorted(missing))}, expected all", "config_invalid")
    found: S = settings
    return found


@cache
def setting_meanings(kind: _Kind) -> dict[str, str]:
    """Returns field name -> its meaning, which is the docstring below the field in one line, or empty without a docstring."""
    found = dict.fromkeys(_hints(kind), "")
    parts: list[_Kind] = [part for part in reversed(kind.__mro__) if is_dataclass(part)]
    for part in parts:  # pydantic does not read the docstrings of inherited fields
        model = create_model(part.__name__, __config__=_WITH_DOCSTRINGS, value=(part, ...))
        schema = model.model_json_schema()["$defs"][part.__name__]["properties"]
        found |= {key: " ".join(of["description"].split()) for key, of in schema.items() if "description" in of}
    return found


@cache
def _hints(kind: _Kind) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


@cache
def _model_of_fields(kind: _Kind) -> type[BaseModel]:
    """Makes a pydantic model of the fields; nested settings are objects, which are already checked."""
    of_fields: dict[str, Any] = {name: (hint, ...) for name, hint in _hints(kind).items()}
    return create_model(kind.__name__, __config__=ConfigDict(**_CONFIG, protected_namespaces=()), **of_fields)


@cache
def _model_around(kind: _Kind) -> type[BaseModel]:
    """Makes a pydantic model with the settings as its field ``value``; its configuration also applies to nested settings."""
    return create_model(kind.__name__, __config__=_CONFIG, value=(kind, ...))


def _as_json(value: Any) -> Any:
    if isinstance(value, frozenset):
        return sorted(value)
    return {type(value).__name__: str(value)}  # a TOML date: no setting is one, and a mapping in its place is refused


def _config_error(error: ValidationError, name: str) -> ConfigError:
    """Describes the first error in one line."""
    first = error.errors(include_url=False)[0]
    path = ".".join(part for part in (name, *(str(key) for key in first["loc"] if key != "value")) if part)
    context = first.get("ctx", {})
    if isinstance(own := context.get("error"), ConfigError):  # raised by check()
        return ConfigError(f"{path}: {own}" if path else str(own), own.code)
    if first["type"] == "unexpected_keyword_argument":
        return ConfigError(f"setting {path} is not known", "config_invalid")
    if first["type"] == "literal_error":
        expected = context["expected"].replace("'", "")
    else:
        expected = _EXPECTED.get(first["type"], first["msg"].removeprefix("Input should be ")).format(**context)
    return ConfigError(f"setting {path} is {_shown(first['input'])}, expected {expected}", "config_invalid")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}…"
