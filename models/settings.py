"""What every settings class shares: ranges that stand in types, checked by pydantic, and errors of one line.

Settings are frozen dataclasses. A field's type says what it may be (:data:`Share`, ``Literal["adamw", "muon"]``), the text below
the field says what it means, its unit first where it has one (``\"\"\"Metres; ...\"\"\"``). What no type can say, such as two fields
that depend on each other, is in :meth:`Settings.check`.
"""

import json
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, TypeAlias, TypeVar, get_type_hints

from annotated_types import Ge, Gt, Interval
from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from stable_data.errors import ConfigError

S = TypeVar("S")

Positive: TypeAlias = Annotated[float, Gt(0)]
NonNegative: TypeAlias = Annotated[float, Ge(0)]
Share: TypeAlias = Annotated[float, Interval(ge=0, le=1)]
Count: TypeAlias = Annotated[int, Ge(0)]
PositiveCount: TypeAlias = Annotated[int, Ge(1)]

_Kind: TypeAlias = Any  # a dataclass; to mypy a class is not hashable, as functions that are cached ask for
_CONFIG = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True)
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
    """Base of settings: each value is checked against its field's type when an object is made."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ConfigError: One of them is of the wrong type or out of its range, or they do not go together.
        """
        kind: _Kind = type(self)
        values = {name: getattr(self, name) for name in _hints(kind)}
        try:
            _model_of_fields(kind).model_validate(values)
        except ValidationError as error:
            raise _config_error(error, getattr(self, "section", "")) from None
        self.check()

    def check(self) -> None:
        """Raises a ConfigError where values do not go together."""


def fill_settings(kind: type[S], values: Mapping[str, Any], name: str) -> S:
    """Settings from nested values, such as a file's; what is not said takes its default.

    Args:
        kind: A dataclass of settings.
        values: By field; nested settings are mappings again, sets are lists.
        name: What the settings are called in errors.

    Raises:
        ConfigError: A value has the wrong type or is out of its range, a key is not known, or values do not go together.
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


@cache
def setting_meanings(kind: _Kind) -> dict[str, str]:
    """What each field of a settings class means, by its name: the text below it, in one line; empty where there is none."""
    found = dict.fromkeys(_hints(kind), "")
    for part in reversed(kind.__mro__):  # pydantic reads the texts of a class's own fields alone
        if part in (object, Settings):
            continue
        schema = _model_around(part).model_json_schema()["$defs"][part.__name__]["properties"]
        found |= {key: " ".join(of["description"].split()) for key, of in schema.items() if "description" in of}
    return found


@cache
def _hints(kind: _Kind) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


@cache
def _model_of_fields(kind: _Kind) -> type[BaseModel]:
    """A model of the fields: settings in them are objects that are checked already."""
    of_fields: dict[str, Any] = {name: (hint, ...) for name, hint in _hints(kind).items()}
    return create_model(kind.__name__, __config__=ConfigDict(**_CONFIG, protected_namespaces=()), **of_fields)


@cache
def _model_around(kind: _Kind) -> type[BaseModel]:
    """A model with the settings as its field ``value``, which hands its configuration down to all that are in them."""
    return create_model(kind.__name__, __config__=_CONFIG, value=(kind, ...))


def _as_json(value: Any) -> Any:
    if isinstance(value, frozenset):
        return sorted(value)
    return {type(value).__name__: str(value)}  # a date of TOML, which no setting is: a table in its place is refused


def _config_error(error: ValidationError, name: str) -> ConfigError:
    """The first mistake in one line."""
    first = error.errors(include_url=False)[0]
    path = ".".join(part for part in (name, *(str(key) for key in first["loc"] if key != "value")) if part)
    context = first.get("ctx", {})
    if isinstance(own := context.get("error"), ConfigError):  # of check()
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
