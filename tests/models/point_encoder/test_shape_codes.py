from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.point_encoder import shape_codes
from models.point_encoder.cloud import SCANNET, PointCloud
from models.point_encoder.shape_codes import ShapeCodes
from stable_data.geometry.shape import Shape
from tests.models.point_encoder.clouds import tiny_encoder
from tests.scenes import cup

CUP = cup(0.04, 0.1, 0.005)
SHAPES = [CUP, Shape.box((0.3, 0.02, 0.05)), Shape(1.37 * CUP.vertices, CUP.faces)]


@pytest.fixture
def sampled(monkeypatch: pytest.MonkeyPatch) -> list[Shape]:
    """The shapes that are sampled from now on."""
    found: list[Shape] = []
    of_shape = PointCloud.of_shape

    def count(shape: Shape, num_points: int) -> PointCloud:
        found.append(shape)
        return of_shape(shape, num_points)

    monkeypatch.setattr(PointCloud, "of_shape", count)
    return found


def test_features_are_those_of_the_encoder_and_computed_once(tmp_path: Path, sampled: list[Shape]) -> None:
    encoder = tiny_encoder()
    codes = ShapeCodes(encoder, tmp_path)
    found = codes(SHAPES)
    expected = encoder.codes([PointCloud.of_shape(s, encoder.preprocessing.num_points) for s in SHAPES])
    np.testing.assert_allclose(found, expected, atol=1e-2)  # the vertices are rounded
    np.testing.assert_array_equal(found[0], found[2])  # the same at another scale
    assert not np.array_equal(found[0], found[1])
    sampled.clear()
    np.testing.assert_array_equal(codes(SHAPES[::-1]), found[::-1])
    np.testing.assert_array_equal(ShapeCodes(encoder, tmp_path)(SHAPES), found)  # another process
    assert not sampled
    assert codes([]).shape == (0, 64)


def test_another_encoder_reads_other_files(tmp_path: Path, sampled: list[Shape]) -> None:
    ShapeCodes(tiny_encoder(), tmp_path)(SHAPES[:1])
    other = tiny_encoder()
    next(other.parameters()).data += 1
    sampled.clear()
    ShapeCodes(other, tmp_path)(SHAPES[:1])
    assert len(sampled) == 1


def test_a_feature_that_depends_on_the_size_is_kept_for_each_size() -> None:
    centred = replace(SCANNET, num_points=128, channels=("coord", "normal"))
    codes = ShapeCodes(tiny_encoder(preprocessing=centred))(SHAPES)
    assert not np.array_equal(codes[0], codes[2])


@pytest.mark.parametrize("content", [b"", b"not a file of arrays"])
def test_a_damaged_file_is_computed_again(tmp_path: Path, content: bytes) -> None:
    encoder = tiny_encoder()
    found = ShapeCodes(encoder, tmp_path)(SHAPES)
    for path in tmp_path.iterdir():
        path.write_bytes(content)
    np.testing.assert_array_equal(ShapeCodes(encoder, tmp_path)(SHAPES), found)


def test_memory_keeps_the_features_of_the_call_when_it_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shape_codes, "_MOST", 1)
    codes = ShapeCodes(tiny_encoder())
    found = codes(SHAPES)
    np.testing.assert_array_equal(codes(SHAPES), found)
    codes(SHAPES[1:2])
    np.testing.assert_array_equal(codes(SHAPES), found)
