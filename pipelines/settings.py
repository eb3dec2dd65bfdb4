"""Settings of a run: frozen dataclasses, filled from a TOML file and ``--set key=value``, and the list of all of them.

Values are checked in one place, :mod:`models.settings`.
"""

import difflib
import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from importlib import import_module
from itertools import accumulate, groupby
from pathlib import Path
from textwrap import wrap
from typing import Any, TypeVar

from models.settings import fill_settings, setting_meanings
from pipelines.retired import RETIRED
from stable_data.config_diff import flatten_config
from stable_data.errors import ConfigError, one_line
from stable_data.limits import LIMITS, at_most

C = TypeVar("C")

UNITS = ("Centimetres", "Metres", "Radians", "Seconds", "Tokens")
"""Units with which a meaning may begin, such as ``Metres; ...``."""

_WIDTH = 100  # characters of a line
_INT64 = 2**63  # the range of TOML's integers


@dataclass(frozen=True, slots=True)
class SettingsLocation:
    """The location of a job's settings in the code.

    Attributes:
        kind: Their class, as ``module:name``.
        presets: The function that returns a preset, as ``module:name``; empty if the job has no presets.
        preset: The name of the default preset.
    """

    kind: str
    presets: str = ""
    preset: str = ""

    def defaults(self, preset: str = "") -> Any:
        """The default settings, or those of a preset.

        Raises:
            ConfigError: The preset is unknown.
        """
        if preset and not self.presets:
            raise ConfigError(f"preset {preset!r} is not known: this job has none, leave out --preset", "usage")
        return _load_name(self.presets)(preset or self.preset) if self.presets else _load_name(self.kind)()


JOBS: Mapping[str, SettingsLocation] = {
    "import": SettingsLocation("pipelines.asset_import.settings:ImportSettings"),
    "preprocess": SettingsLocation("pipelines.preprocess.settings:PreprocessSettings"),
    "correct": SettingsLocation("pipelines.correct.settings:CorrectSettings"),
    "views": SettingsLocation("pipelines.views.settings:ViewsSettings"),
    "edit": SettingsLocation("pipelines.edit.settings:EditSettings"),
    "generate": SettingsLocation("pipelines.generate.settings:GenerateSettings"),
    "demonstrate": SettingsLocation("pipelines.demonstrate.settings:DemonstrateSettings"),
    "reach": SettingsLocation("pipelines.reach.settings:ReachSettings"),
    "rate": SettingsLocation("pipelines.rate.settings:RateSettings"),
    "evaluate": SettingsLocation("pipelines.evaluate.settings:EvaluateSettings"),
    "evaluate-policy": SettingsLocation("pipelines.evaluate_policy.settings:EvaluatePolicySettings"),
    "train-corrector": SettingsLocation(
        "models.physics_corrector.training.settings:CorrectorTrainingSettings",
        "models.physics_corrector.training.settings:training_preset",
        "embedded_set",
    ),
    "train-rearranger": SettingsLocation(
        "models.rearrangement.training:RearrangerTrainingSettings",
        "models.rearrangement.training:training_preset",
        "lego_net",
    ),
    "train-reasoner": SettingsLocation(
        "models.semantic_reasoner.training.settings:ReasonerTrainingSettings",
        "models.semantic_reasoner.training.settings:training_preset",
        "embedded",
    ),
    "train-reader": SettingsLocation("models.instruction_reader.training:ReaderTrainingSettings"),
    "train-policy": SettingsLocation("models.policy.training:PolicyTrainingSettings"),
}
"""The jobs with settings, by verb."""

SECTIONS = tuple(verb.replace("-", "_") for verb in JOBS)
"""The tables that a file may have, one for each job."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting of a job.

    Attributes:
        key: Its key, with dots for nested tables.
        default: Its default, or None.
        unit: Its unit, or empty.
        meaning: Its meaning.
    """

    key: str
    default: Any
    unit: str
    meaning: str


def resolve_settings(kind: type[C], section: str, file: Path | None, overrides: Iterable[str], base: C | None = None) -> C:
    """The settings of one job.

    Args:
        kind: A frozen dataclass whose fields have defaults; such dataclasses in it are nested settings.
        section: Its table in the file; nested settings are tables in it.
        file: A TOML file, or None.
        overrides: ``key=value`` or ``section.key=value``, which override the file; ``outer.inner=value`` for nested settings.
        base: The values of all other settings; by default the defaults of the class.

    Raises:
        ConfigError: A table or key is unknown, or a value has the wrong type or is outside its range.
    """
    defaults: dict[str, Any] = asdict(kind() if base is None else base)  # type: ignore[call-overload]
    values = asdict(kind() if base is None else base)  # type: ignore[call-overload]
    try:
        if file is not None:
            _merge(values, _section(file, section), section, defaults)
        for text in overrides:
            key, equals, value = text.partition("=")
            if not equals:
                raise ConfigError(f"--set {_line(text)}: expected key=value", "config_invalid")
            path = key.strip().removeprefix(f"{section}.").split(".")
            _merge(values, _nested(path, _parse_value(value.strip())), section, defaults)
    except RecursionError:
        raise ConfigError(f"settings of {section}: tables or lists are nested too deep", "config_invalid") from None
    return fill_settings(kind, values, section)


def list_settings(verb: str, preset: str = "") -> list[Setting]:
    """Every setting of a job, in the order of its classes; nested tables come after the settings beside them.

    Args:
        verb: One of :data:`JOBS`.
        preset: A preset whose values are shown as defaults; empty uses the default preset of the job.

    Raises:
        ConfigError: There is no such job, or no such preset.
    """
    if verb not in JOBS:
        raise ConfigError(f"{verb!r} has no settings{_hint(verb, JOBS)}", "usage")
    return list(_iterate_settings(JOBS[verb].defaults(preset), ""))


def settings_text(settings: Iterable[Setting]) -> str:
    """Settings as text, each nested table under its heading; values are written as in TOML."""
    lines: list[str] = []
    for table, group in groupby(settings, lambda setting: setting.key.rpartition(".")[0]):
        lines += ["", f"[{table}]"] if table else []
        for setting in group:
            default = "none" if setting.default is None else json.dumps(setting.default, ensure_ascii=False)
            unit = f" {setting.unit}" if setting.unit else ""
            lines.append(f"{setting.key} = {default}{unit}")
            lines += wrap(setting.meaning, _WIDTH, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    return "\n".join(lines)


def _iterate_settings(settings: Any, prefix: str) -> Iterator[Setting]:
    nested = []
    kind: Any = type(settings)
    texts = setting_meanings(kind)
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            nested.append((value, f"{prefix}{field.name}."))
            continue
        unit, _, rest = texts[field.name].partition("; ")
        is_unit = unit in UNITS
        text = rest[:1].upper() + rest[1:] if is_unit else texts[field.name]
        default = sorted(value) if isinstance(value, frozenset) else value
        yield Setting(prefix + field.name, default, unit.lower() if is_unit else "", text.replace("``", "`"))
    for value, own in nested:
        yield from _iterate_settings(value, own)


def _merge(values: dict[str, Any], new: Mapping[str, Any], name: str, defaults: Mapping[str, Any]) -> None:
    """Replaces values by new ones, table by table."""
    for key, value in new.items():
        path = f"{name}.{_line(key)}"
        if line := RETIRED.get(path.partition(".")[2]):
            raise ConfigError(f"setting {path} is retired; {line}", "retired")
        if key not in values:
            section, _, inner = path.partition(".")
            raise ConfigError(f"setting {path} is not known{_near(inner, defaults, section)}", "config_invalid")
        if isinstance(value, dict) and isinstance(values[key], dict):
            _merge(values[key], value, path, defaults)
            continue
        if isinstance(value, dict):
            raise ConfigError(
                f"setting {path}.{_line(next(iter(value), ''))} is not known: {path} is a value", "config_invalid"
            )
        if type(value) is int and not -_INT64 <= value < _INT64:
            raise ConfigError(f"setting {path} is a whole number of over 64 bits, expected a smaller one", "config_invalid")
        values[key] = value


def _nested(path: list[str], value: Any) -> dict[str, Any]:
    for key in reversed(path):
        value = {key: value}
    found: dict[str, Any] = value
    return found


def _near(key: str, defaults: Mapping[str, Any], section: str) -> str:
    """A hint at the expected setting: one with a similar name, or a table or a setting with the same name in another table."""
    known = flatten_config(defaults)
    tables = dict.fromkeys(table for name in known for table in accumulate(name.split(".")[:-1], "{}.{}".format))
    last = key.rpartition(".")[2]
    near = difflib.get_close_matches(key, known, 1)
    near = near or [name for name in (*tables, *known) if name.rpartition(".")[2] == last]
    verb = section.replace("_", "-")
    every = f"; python -m pipelines settings {verb} lists all" if verb in JOBS else f"; known are {', '.join(known)}"
    return f"; did you mean {near[0]}?" if near else every


def _section(file: Path, section: str) -> Mapping[str, Any]:
    try:
        with file.open("rb") as stream:
            content = stream.read(LIMITS.text.max_config_bytes + 1)
        if len(content) > LIMITS.text.max_config_bytes:  # time and memory of the parser grow with the square of a key's length
            raise ValueError(f"it is larger, expected {at_most(LIMITS.text, 'max_config_bytes', 'bytes')}")
        document = tomllib.loads(content.decode())
    except (OSError, ValueError) as error:  # ValueError: no UTF-8, no TOML, or a number of thousands of digits
        raise ConfigError(f"{file}: cannot be read as TOML ({error})", "config_invalid") from error
    known = dict.fromkeys((section, *SECTIONS))
    for name in document:
        if line := RETIRED.get(name):
            raise ConfigError(f"{file}: the table [{name}] belongs to a retired verb; {line}", "retired")
        if name not in known:
            raise ConfigError(f"{file}: {_line(name)} is not a known table{_hint(name, known)}", "config_invalid")
    if section not in document:
        raise ConfigError(f"{file}: has no table [{section}], expected one; an empty table uses all defaults", "config_invalid")
    found = document[section]
    if not isinstance(found, dict):
        raise ConfigError(f"{file}: {section} is {found!r:.80}, expected a table [{section}]", "config_invalid")
    return found


def _hint(name: str, known: Iterable[str]) -> str:
    known = list(known)
    near = difflib.get_close_matches(name, known, 1)
    return f"; did you mean {near[0]}?" if near else f"; known are {', '.join(known)}"


def _parse_value(value: str) -> Any:
    if len(value) > LIMITS.text.max_config_bytes:  # it may have keys too
        most = at_most(LIMITS.text, "max_config_bytes", "characters")
        raise ConfigError(f"--set: {_line(value)} has {len(value):,} characters, expected {most}", "config_invalid")
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return value  # a bare word is a string
    except ValueError as error:
        raise ConfigError(f"--set: {_line(value)} cannot be read ({error})", "config_invalid") from error


def _line(text: str) -> str:
    """Text of a file or a command line as an error shows it: one line, not long."""
    text = one_line(text[:80])
    return text if len(text) < 80 else f"{text[:80]}…"


def _load_name(name: str) -> Any:
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)
