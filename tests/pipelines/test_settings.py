"""Settings: a file, then --set, every mistake named in one line, and every key listed with its meaning."""

import json
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import pytest
from annotated_types import Interval
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from models.semantic_reasoner.training.settings import training_preset
from models.settings import PositiveCount, Settings
from pipelines.__main__ import app
from pipelines.edit.settings import EditSettings
from pipelines.generate.settings import GenerateSettings
from pipelines.preprocess.settings import PreprocessSettings
from pipelines.retired import RETIRED
from pipelines.settings import JOBS, list_settings, resolve_settings
from stable_data.config_diff import config_differences
from stable_data.errors import ConfigError
from tests.bounds import soon

ROOT = Path(__file__).resolve().parents[2]
PRESETS = [(verb, "") for verb in JOBS]
PRESETS += [("train-corrector", name) for name in ("paper", "paper_tuned", "paper_set", "embedded", "embedded_set")]
PRESETS += [("train-rearranger", name) for name in ("lego_net", "struct_diffusion")]
PRESETS += [("train-reasoner", name) for name in ("paper", "embedded")]


@dataclass(frozen=True, slots=True)
class Inner(Settings):
    """Settings in settings."""

    reach: Annotated[float, Interval(ge=0, lt=2)] = 0.5
    """Metres; how far it reaches."""

    words: frozenset[str] | None = None
    """Words that are allowed."""


@dataclass(frozen=True, slots=True)
class Sample(Settings):
    """Settings with one field of each kind."""

    section: ClassVar[str] = "sample"

    steps: PositiveCount = 3
    """Steps."""

    share: float = 0.5
    """Share of something, over
    two lines.
    """

    name: str = "a"
    """A name."""

    quick: bool = False
    """Whether it is quick."""

    mode: Literal["near", "far"] = "near"
    """Where."""

    inner: Inner = field(default_factory=Inner)
    """More."""

    def check(self) -> None:
        """Refuses many steps that are quick."""
        if self.quick and self.steps > 100:
            raise ConfigError(f"steps is {self.steps} where quick, expected at most 100", "too_many")


def test_set_is_stronger_than_the_file(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('[sample]\nsteps = 7\nshare = 1\n[sample.inner]\nwords = ["b", "a"]\n', "utf-8")
    found = resolve_settings(Sample, "sample", file, ["sample.steps=9", "name=b", "quick=true", "inner.reach=1"])
    assert found == Sample(9, 1.0, "b", True, inner=Inner(1.0, frozenset({"a", "b"})))
    assert type(found.share) is float


def test_what_nobody_says_is_that_of_the_base() -> None:
    base = Sample(5, inner=Inner(words=frozenset({"a"})))
    assert resolve_settings(Sample, "sample", None, ["inner.reach=1.5"], base) == Sample(5, inner=Inner(1.5, frozenset({"a"})))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stops=1", "setting sample.stops is not known; did you mean steps?"),
        ("reach=1", "setting sample.reach is not known; did you mean inner.reach?"),
        ("inner.reech=1", "setting sample.inner.reech is not known; did you mean inner.reach?"),
        ("section=foo", "setting sample.section is not known; known are steps, share"),
        ("=1", "setting sample. is not known"),
        ("steps.deep=1", "setting sample.steps.deep is not known: sample.steps is a value"),
        ("steps=many", "setting sample.steps is 'many', expected a whole number"),
        ("steps=1.5", "setting sample.steps is 1.5, expected a whole number"),
        ("steps=true", "setting sample.steps is True, expected a whole number"),
        ("steps=0", "setting sample.steps is 0, expected at least 1"),
        ("quick=1", "setting sample.quick is 1, expected true or false"),
        ("name=1", "setting sample.name is 1, expected text"),
        ("name=2026-01-01", "setting sample.name is {'date': '2026-01-01'}, expected text"),
        ("mode=up", "setting sample.mode is 'up', expected near or far"),
        ("inner=3", "setting sample.inner is 3, expected a table"),
        ("inner.words=a", "setting sample.inner.words is 'a', expected a list of words"),
        ("inner.reach=2", "setting sample.inner.reach is 2, expected less than 2"),
        ("steps", "--set steps: expected key=value"),
        ("share=nan", "setting sample.share is nan, expected a finite number"),
        ("share=inf", "setting sample.share is inf, expected a finite number"),
        ("share=true", "setting sample.share is True, expected a number"),
    ],
)
def test_a_mistake_is_named(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        resolve_settings(Sample, "sample", None, [text])
    assert str(caught.value).startswith(message)


def test_values_that_do_not_go_together_are_refused_in_a_file_and_in_code() -> None:
    attempts: tuple[Callable[[], Sample], ...] = (
        lambda: resolve_settings(Sample, "sample", None, ["quick=true", "steps=101"]),
        lambda: Sample(101, quick=True),
    )
    for wrong in attempts:
        with pytest.raises(ConfigError, match="steps is 101 where quick") as caught:
            wrong()
        assert caught.value.code == "too_many"
    with pytest.raises(ConfigError, match=r"setting sample\.steps is 0, expected at least 1"):
        Sample(0)
    with pytest.raises(ConfigError, match=r"setting reach is 2\.5, expected less than 2"):
        Inner(2.5)


NINES = "9" * 5000
HOSTILE = [f"steps = {NINES}", f"steps = 0x{'f' * 5000}", f"inner.words = [0x{'f' * 5000}]", f"share = {'9' * 400}"]
HOSTILE += ["name = " + "[" * 5000 + "]" * 5000, ".".join(["inner"] * 5000) + " = 1", "steps = 1\x00", "name = " + "{a=" * 5000]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_values_are_one_line(text: str, tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text(f"[sample]\n{text}\n", "utf-8")
    for path, overrides in ((file, []), (None, [text.replace(" = ", "=")])):
        with pytest.raises(ConfigError) as caught:
            resolve_settings(Sample, "sample", path, overrides)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 1000


@given(st.text(max_size=40))
def test_any_text_is_settings_or_one_line(text: str) -> None:
    try:
        line = str(resolve_settings(Sample, "sample", None, [text]))
    except ConfigError as error:
        line = str(error)
    assert len(line.splitlines()) == 1


def test_a_file_that_is_no_toml_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[sample", "utf-8")
    with pytest.raises(ConfigError, match="cannot be read as TOML"):
        resolve_settings(Sample, "sample", file, [])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[sampel]\nsteps = 7\n", "sampel is not a known table; did you mean sample"),
        ("[sample]\n[weather]\n", "weather is not a known table; known are sample, import, preprocess"),
        ("steps = 7\n", "steps is not a known table"),
        ("sample = 7\n", r"expected a table \[sample\]"),
        ("", r"has no table \[sample\]"),
        ("[sample]\nshare = nan\n", "sample.share is nan, expected a finite number"),
    ],
)
def test_a_file_that_would_set_nothing_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "run.toml"
    file.write_text(text, "utf-8")
    with pytest.raises(ConfigError, match=message):
        resolve_settings(Sample, "sample", file, [])


def test_one_file_may_hold_the_settings_of_several_jobs(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[sample]\nsteps = 7\n[sample.inner]\n[preprocess]\nseed = 1\n", "utf-8")
    assert resolve_settings(Sample, "sample", file, []) == Sample(steps=7)


def test_differences_say_was_and_now() -> None:
    assert config_differences({"a": 1, "b": 2}, {"a": 1, "b": 3}) == ["b: 2 -> 3"]


@pytest.mark.parametrize("workflow", sorted((ROOT / "workflows").glob("*.toml")), ids=lambda p: p.stem)
def test_every_workflow_is_a_valid_configuration(workflow: Path) -> None:
    resolve_settings(PreprocessSettings, "preprocess", workflow, [])


@pytest.mark.parametrize(("verb", "preset"), PRESETS)
def test_settings_where_nothing_is_said_are_the_jobs_own_to_the_byte(verb: str, preset: str) -> None:
    own: Any = JOBS[verb].defaults(preset)
    found = resolve_settings(type(own), verb.replace("-", "_"), None, [], own)
    assert found == own
    assert repr(asdict(found)) == repr(asdict(own))  # 1 and 1.0 are equal, but name another shard


@pytest.mark.parametrize("verb", JOBS)
def test_every_setting_has_a_meaning_and_is_a_setting(verb: str) -> None:
    listed = list_settings(verb)
    assert [setting.key for setting in listed if len(setting.meaning) < 5] == []
    assert len({setting.key for setting in listed}) == len(listed)
    own: Any = JOBS[verb].defaults()
    said = [f"{s.key}={json.dumps(s.default)}" for s in listed if s.default is not None]
    assert resolve_settings(type(own), verb.replace("-", "_"), None, said, own) == own


def test_a_listed_setting_has_its_unit_apart() -> None:
    (found,) = (setting for setting in list_settings("generate") if setting.key == "earlier_move")
    assert (found.default, found.unit) == (10.0, "metres")
    assert found.meaning.startswith("How far a correction may move")


def test_defaults_are_those_of_the_preset() -> None:
    found = {setting.key: setting.default for setting in list_settings("train-reasoner", "paper")}
    assert found["max_tokens"] == training_preset("paper").max_tokens
    assert found["seed"] == 0


@pytest.mark.parametrize("verb", JOBS)
def test_the_command_lists_all_and_the_help_of_the_job_names_it(verb: str) -> None:
    text, lines = (CliRunner().invoke(app, ["settings", verb, *more]) for more in ([], ["--json"]))
    keys = [setting.key for setting in list_settings(verb)]
    assert [json.loads(line)["key"] for line in lines.output.splitlines()] == keys
    assert re.findall(r"^([\w.]+) = ", text.output, re.MULTILINE) == keys
    shown = CliRunner().invoke(app, [verb, "--help"], env={"COLUMNS": "200"}).output
    assert f"python -m pipelines settings {verb}" in " ".join(shown.split())


def test_the_command_refuses_what_has_no_settings() -> None:
    for words in (["synthesize"], ["generate", "--preset", "paper"], ["train-reasoner", "--preset", "paperr"]):
        done = CliRunner().invoke(app, ["settings", *words])
        assert done.exit_code == 2
        (line,) = done.output.strip().splitlines()
        assert line.startswith("error: ")


@pytest.mark.parametrize("kind", [EditSettings, GenerateSettings])
def test_a_setting_that_is_gone_is_one_line_that_names_what_to_write(kind: type[Any], tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    for key in (name for name in RETIRED if "." in name):
        table, _, last = key.rpartition(".")
        file.write_text(f"[{kind.section}.{table}]\n{last} = 1\n", "utf-8")
        for path, overrides in ((file, []), (None, [f"{key}=1"])):
            with pytest.raises(ConfigError, match=f"setting {kind.section}.{key} is retired; ") as caught:
                resolve_settings(kind, kind.section, path, overrides)
            assert caught.value.code == "retired"
        assert key not in {setting.key for setting in list_settings(kind.section)}


DOCS = {"correct.md": "correct", "edit.md": "edit", "generate.md": "generate", "reasoner.md": "generate"}
"""Documents with a table of settings, and whose they are."""


@pytest.mark.parametrize("doc", DOCS)
def test_a_table_of_settings_has_no_key_that_is_not_there(doc: str) -> None:
    keys = {setting.key for setting in list_settings(DOCS[doc])}
    rows = re.findall(r"^\| key \|.*\n\|[-| ]*\n((?:\|.*\n)+)", (ROOT / "docs" / doc).read_text("utf-8"), re.MULTILINE)
    named: list[str] = []
    for row in "".join(rows).splitlines():
        for key in re.findall(r"`([^`]+)`", row.split("|")[1]):
            named.append(named[-1].rpartition(".")[0] + key if key.startswith(".") else key)  # `a.b`, `.c` is a.b and a.c
    assert named
    assert [k for k in named if k not in keys and not (k.endswith(".*") and any(key.startswith(k[:-1]) for key in keys))] == []


@pytest.mark.parametrize("file", [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"], ids=lambda p: p.stem)
def test_every_key_that_a_document_sets_is_there(file: Path) -> None:
    keys = {setting.key for verb in JOBS for setting in list_settings(verb)}
    assert set(re.findall(r"--set '?(?!key=)([\w.]+)=", file.read_text("utf-8"))) <= keys


def test_a_large_file_is_not_parsed(tmp_path: Path) -> None:
    """The time of the parser grows with the square of a key's length: 100,000 parts took minutes."""
    file = tmp_path / "run.toml"
    file.write_text("[sample]\na" + ".a" * 100_000 + " = 1\n", "utf-8")
    with soon(2.0), pytest.raises(ConfigError, match=r"at most 16,384 bytes \(text\.max_config_bytes in STABLE_DATA_LIMITS\)"):
        resolve_settings(Sample, "sample", file, [])
    with soon(2.0), pytest.raises(ConfigError, match="has 100,007 characters, expected at most 16,384 characters"):
        resolve_settings(Sample, "sample", None, [f"name={{a{'.a' * 50_000} = 1}}"])
