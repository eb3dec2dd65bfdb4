"""Pictures of a folder: what is none of the four kinds is not opened, whatever its name says."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from models.picture_features.picture_folder import read_picture
from stable_data.errors import ConfigError
from tests.bounds import limit

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 100 100\n%%EndComments\nshowpage\n"


def test_a_picture_cannot_start_another_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow would draw PostScript with Ghostscript."""

    def run(*_: object, **__: object) -> None:
        raise AssertionError("a program was started")

    monkeypatch.setattr("subprocess.Popen", run)
    monkeypatch.setattr("subprocess.check_call", run)
    bitmap = io.BytesIO()
    Image.new("RGB", (4, 4)).save(bitmap, "BMP")
    for content in (EPS, bitmap.getvalue(), b""):
        (tmp_path / "a.png").write_bytes(content)
        with pytest.raises(ConfigError, match="cannot be read") as caught:
            read_picture(tmp_path / "a.png")
        assert caught.value.code == "pictures_invalid"


def test_the_pixels_of_a_picture_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("RGB", (20, 10), "white").save(tmp_path / "a.png")
    assert np.array_equal(read_picture(tmp_path / "a.png"), np.full((10, 20, 3), 255))
    limit(monkeypatch, "image", max_pixels=199)
    with pytest.raises(ConfigError, match=r"200 pixels.* expected at most 199 pixels \(image\.max_pixels in "):
        read_picture(tmp_path / "a.png")
