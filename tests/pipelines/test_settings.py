"""Settings: a file, then --set, and every mistake named."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from pipelines.preprocess.plan import PreprocessSettings
from pipelines.settings import resolve
from stable_data.config_diff import differences
from stable_data.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Sample:
    section: ClassVar[str] = "sample"

    steps: int = 3
    share: float = 0.5
    name: str = "a"
    quick: bool = False


def test_set_is_stronger_than_the_file(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[sample]\nsteps = 7\nshare = 1\n", "utf-8")
    found = resolve(Sample, "sample", file, ["sample.steps=9", "name=b", "quick=true"])
    assert found == Sample(9, 1.0, "b", True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stops=1", "did you mean steps"),
        ("section=foo", "setting sample.section is not known"),
        ("steps=many", "expected int"),
        ("steps=1.5", "expected int"),
        ("quick=1", "expected bool"),
        ("steps", "expected key=value"),
        ("share=nan", "expected a finite number"),
        ("share=inf", "expected a finite number"),
    ],
)
def test_a_mistake_is_named(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        resolve(Sample, "sample", None, [text])


def test_a_file_that_is_no_toml_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[sample", "utf-8")
    with pytest.raises(ConfigError, match="cannot be read as TOML"):
        resolve(Sample, "sample", file, [])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[sampel]\nsteps = 7\n", "sampel is not a known table; did you mean sample"),
        ("[sample]\n[training]\n", "training is not a known table; known are sample, preprocess"),
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
        resolve(Sample, "sample", file, [])


def test_one_file_may_hold_the_settings_of_several_jobs(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[sample]\nsteps = 7\n[preprocess]\nseed = 1\n", "utf-8")
    assert resolve(Sample, "sample", file, []) == Sample(steps=7)


def test_differences_say_was_and_now() -> None:
    assert differences({"a": 1, "b": 2}, {"a": 1, "b": 3}) == ["b: 2 -> 3"]


@pytest.mark.parametrize("workflow", sorted((ROOT / "workflows").glob("*.toml")), ids=lambda p: p.stem)
def test_every_workflow_is_a_valid_configuration(workflow: Path) -> None:
    resolve(PreprocessSettings, "preprocess", workflow, [])
