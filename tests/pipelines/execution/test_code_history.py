"""A run that is stopped and goes on with other code: it does, and says so; with another version it does not."""

import json
import shutil
from pathlib import Path

import pytest

from pipelines.execution import code_history
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from pipelines.train.run import refuse_changes
from stable_data import __version__
from stable_data.code_version import code_version
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.runs import SMALL, content

NOW = code_version()
OTHER = f"{__version__}+000000000000"


def manifest_of(out: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads((out / "manifest.json").read_text("utf-8"))
    return found


def begun_with(run: Path, out: Path, **code: object) -> Path:
    """A run that other code began, a shard of which is missing."""
    shutil.copytree(run, out)
    (out / "manifest.json").write_text(json.dumps(manifest_of(out) | code), "utf-8")
    next(iter(sorted((out / "scenes").glob("part-*")))).unlink()
    return out


def test_a_run_of_one_code_says_nothing(bare: Path, bare_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = begun_with(bare_run, tmp_path / "out")
    preprocess(str(bare), str(out), SMALL, WorkerPool(), report=False)
    assert (manifest_of(out)["code_version"], manifest_of(out)["code_versions"]) == (NOW, [NOW])
    assert "other code" not in capsys.readouterr().err


@pytest.mark.parametrize("was", [{"code_versions": [OTHER]}, {"code_versions": None}])
def test_a_run_goes_on_with_other_sources_and_names_both(
    bare: Path, bare_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], was: dict[str, object]
) -> None:
    out = begun_with(bare_run, tmp_path / "out", code_version=OTHER, **was)
    for number in range(2):  # what is mixed stays so
        preprocess(str(bare), str(out), SMALL, WorkerPool())
        assert content(out) == content(bare_run)
        assert (manifest_of(out)["code_version"], manifest_of(out)["code_versions"]) == (NOW, [OTHER, NOW])
        lines = [line for line in capsys.readouterr().err.splitlines() if "other code" in line]
        assert len(lines) == (1 if number == 0 else 0)
        for line in lines:
            assert f"{out}: earlier rows were made with other code ({OTHER}), missing rows are made with {NOW}" in line
            assert "choose a new folder" in line
    assert f"code {OTHER}, {NOW}, tables" in (out / "report" / "index.html").read_text("utf-8")


def test_code_that_makes_nothing_is_not_named(
    bare: Path, bare_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run that is whole, looked at again: its page is made anew, its rows are not."""
    out = tmp_path / "out"
    shutil.copytree(bare_run, out)
    (out / "manifest.json").write_text(
        json.dumps(manifest_of(out) | {"code_version": OTHER, "code_versions": [OTHER]}), "utf-8"
    )
    preprocess(str(bare), str(out), SMALL, WorkerPool(), report=False)
    assert (manifest_of(out)["code_version"], manifest_of(out)["code_versions"]) == (OTHER, [OTHER])
    assert "other code" not in capsys.readouterr().err


def test_the_code_that_is_gone_back_to_is_named_last(bare: Path, bare_run: Path, tmp_path: Path) -> None:
    out = begun_with(bare_run, tmp_path / "out", code_version=OTHER, code_versions=[NOW, OTHER])
    preprocess(str(bare), str(out), SMALL, WorkerPool(), report=False)
    assert manifest_of(out)["code_versions"] == [OTHER, NOW]


def test_another_version_is_refused(bare: Path, bare_run: Path, tmp_path: Path) -> None:
    out = begun_with(bare_run, tmp_path / "out", code_version="0.0.9+000000000000")
    before = content(out)
    with pytest.raises(ConfigError, match=rf"code_version: 0\.0\.9 -> {__version__}\); choose a new folder") as caught:
        preprocess(str(bare), str(out), SMALL, WorkerPool(), report=False)
    assert caught.value.code == "config_changed"
    assert content(out) == before


def test_a_training_goes_on_with_other_sources_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "manifest.json").write_text(json.dumps({"job": "train", "code_version": OTHER, "settings": {}}), "utf-8")
    folder, now = RunFolder(str(tmp_path)), {"job": "train", "code_version": NOW, "code_versions": [NOW], "settings": {}}
    refuse_changes(folder, now, ("job", "code_version"))
    assert now["code_versions"] == [OTHER, NOW]
    assert "other code" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="code_version"):
        refuse_changes(folder, now | {"code_version": "9.9.9+0"}, ("job", "code_version"))


def test_only_the_hash_of_the_sources_is_left_out_of_what_is_compared() -> None:
    assert code_history.with_release({"job": "a", "code_version": OTHER}) == {"job": "a", "code_version": __version__}
