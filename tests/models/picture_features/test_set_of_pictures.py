"""Distances of sets of pictures with the feature that needs no weights: more change is farther."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from models.picture_features.extractor import Pictures
from models.picture_features.gradients import GradientFeatures
from stable_data.scores.set_distance import FeatureStatistics, frechet_distance, kernel_distance

NUMBER, SIDE = 24, 96


def tables() -> Pictures:
    """Pictures of a table on a floor with six things on it, whose place, size and colour are drawn."""
    random = np.random.default_rng(4)
    pictures = np.full((NUMBER, SIDE, SIDE, 3), (70, 80, 90), np.uint8)
    pictures[:, 24:80, 8:88] = (150, 110, 70)
    for picture in pictures:
        for top, left, height, width in random.integers((26, 12, 6, 6), (66, 72, 14, 16), (6, 4)):
            picture[top : top + height, left : left + width] = random.integers(0, 256, 3)
    return pictures


def shifted(pictures: Pictures, pixels: int) -> Pictures:
    """To the right; what was at the border is repeated."""
    return pictures[:, :, np.maximum(np.arange(SIDE) - pixels, 0)]


def blurred(pictures: Pictures, times: int) -> Pictures:
    values = pictures.astype(np.float64)
    for _ in range(times):
        for axis in (1, 2):
            values = (np.roll(values, 1, axis) + values + np.roll(values, -1, axis)) / 3
    return values.round().astype(np.uint8)


def brightened(pictures: Pictures, by: int) -> Pictures:
    return np.minimum(pictures.astype(np.int64) + by, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("change", "amounts"), [(shifted, (0, 2, 6, 14)), (blurred, (0, 1, 4, 16)), (brightened, (0, 10, 30, 70))]
)
def test_more_of_a_change_is_farther(change: Callable[[Pictures, int], Pictures], amounts: tuple[int, ...]) -> None:
    pictures, extract = tables(), GradientFeatures()
    rows = extract(pictures).astype(np.float64)
    changed = [extract(change(pictures, amount)).astype(np.float64) for amount in amounts]
    frechet = [frechet_distance(FeatureStatistics.of(rows), FeatureStatistics.of(other)) for other in changed]
    kernel = [kernel_distance(rows, other) for other in changed]
    assert frechet[0] == 0.0
    for distances in (frechet, kernel):
        assert all(near < far for near, far in pairwise(distances)), distances
