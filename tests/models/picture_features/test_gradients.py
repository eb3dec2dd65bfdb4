"""The feature without weights: its histograms, and what it sees."""

import numpy as np
import pytest

from models.picture_features.extractor import Pictures
from models.picture_features.gradients import GradientFeatures
from stable_data.errors import ConfigError

FEATURES = GradientFeatures()
COLOURS = 3 * 8 * 21  # three channels, eight bins, 16 + 4 + 1 cells


def plain(colour: tuple[int, int, int], size: tuple[int, int] = (60, 80)) -> Pictures:
    return np.broadcast_to(np.array(colour, np.uint8), (1, *size, 3)).copy()


def stripes(*, across: bool) -> Pictures:
    picture = np.zeros((1, 128, 128, 3), np.uint8)
    rows = np.arange(128) // 8 % 2 == 0
    if across:
        picture[:, rows] = 200
    else:
        picture[:, :, rows] = 200
    return picture


def noise(number: int, size: tuple[int, int] = (40, 50)) -> Pictures:
    return np.random.default_rng(0).integers(0, 256, (number, *size, 3), np.uint8)


def test_shape_type_and_sum_of_histograms() -> None:
    rows = FEATURES(noise(3))
    assert rows.shape == (3, 936)
    assert rows.dtype == np.float32
    np.testing.assert_allclose((rows.astype(np.float64) ** 2).sum(axis=1), 3 * 21 + 3 * 16, rtol=1e-5)
    assert FEATURES(noise(3)[:0]).shape == (0, 936)


def test_a_row_depends_on_its_picture_alone() -> None:
    pictures = noise(40)
    rows = FEATURES(pictures)
    np.testing.assert_array_equal(rows, FEATURES(pictures))
    np.testing.assert_array_equal(rows[35:36], FEATURES(pictures[35:36]))


def test_a_plain_picture_has_one_colour_and_no_gradient() -> None:
    row = FEATURES(plain((255, 255, 255)))[0]
    assert (row[:COLOURS] > 0.999).sum() == 21  # the brightest bin; the opponent colours lie between two bins
    gradients = row[COLOURS:].reshape(3, 9, 16)
    np.testing.assert_allclose(gradients[:, -1], 1, atol=1e-6)
    np.testing.assert_allclose(gradients[:, :-1], 0, atol=1e-6)


def test_orientation_of_edges() -> None:
    across, along = (FEATURES(stripes(across=a))[0, COLOURS:].reshape(3, 9, 16)[0, :8].sum(axis=1) for a in (True, False))
    assert across.argmax() == 4  # brightness rises downwards: 90 degrees
    assert along.argmax() == 0
    assert across[0] < 1e-3
    assert along[4] < 1e-3


def test_the_size_of_a_picture_does_not_matter() -> None:
    small = noise(1, (16, 16))
    large = small.repeat(8, axis=1).repeat(8, axis=2)
    np.testing.assert_allclose(FEATURES(small), FEATURES(large), atol=1e-4)
    assert FEATURES(noise(2, (300, 7))).shape == (2, 936)


def test_more_of_another_colour_is_farther() -> None:
    grey = plain((120, 120, 120))
    rows = [FEATURES(grey)]
    for part in (5, 20, 60):
        picture = grey.copy()
        picture[:, :part] = (200, 30, 30)
        rows.append(FEATURES(picture))
    distances = [float(np.linalg.norm(row - rows[0])) for row in rows]
    assert distances[0] == 0 < distances[1] < distances[2] < distances[3]


@pytest.mark.parametrize(
    "pictures",
    [noise(1)[0], noise(1).astype(np.float32), noise(1)[..., :2], noise(1)[:, :0]],
    ids=["one", "float", "two", "empty"],
)
def test_what_is_no_picture_is_refused(pictures: Pictures) -> None:
    with pytest.raises(ConfigError, match="expected \\(N, H, W, 3\\) of uint8") as error:
        FEATURES(pictures)
    assert error.value.code == "pictures_invalid"
