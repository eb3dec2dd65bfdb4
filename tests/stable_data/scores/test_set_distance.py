"""Distances of sets of features and their diversity: cases with a known value, identities, and input that is no set of features."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from stable_data.errors import ConfigError
from stable_data.scene import FloatArray
from stable_data.scores import set_distance
from stable_data.scores.set_distance import (
    DrawnValue,
    FeatureStatistics,
    frechet_distance,
    kernel_distance,
    kernel_distance_at,
    vendi_at,
    vendi_score,
    vendi_score_of_kernel,
)


def draw(number: int, width: int, seed: int = 0, shift: float = 0.0) -> FloatArray:
    random = np.random.default_rng(seed)
    mixed = random.normal(size=(number, width)) @ random.normal(size=(width, width)) / np.sqrt(width)
    return np.asarray(np.abs(mixed) + shift)


def statistics(mean: FloatArray, covariance: FloatArray, count: int = 100) -> FeatureStatistics:
    return FeatureStatistics(count, np.asarray(mean, np.float64), np.asarray(covariance, np.float64) * (count - 1))


def test_statistics_are_mean_and_unbiased_covariance() -> None:
    rows = draw(50, 7).astype(np.float32)
    found = FeatureStatistics.of(rows)
    assert found.count == 50
    np.testing.assert_allclose(found.mean, rows.astype(np.float64).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.covariance, np.cov(rows.astype(np.float64), rowvar=False), rtol=1e-10)


def test_joined_parts_are_the_whole() -> None:
    rows = draw(97, 6, shift=1000.0)  # far from zero, where sums of squares would lose digits
    parts = [rows[:1], rows[1:40], rows[40:42], rows[42:]]
    whole, joined = FeatureStatistics.of(rows), FeatureStatistics.joined(map(FeatureStatistics.of, parts))
    assert joined.count == whole.count
    np.testing.assert_allclose(joined.mean, whole.mean, rtol=1e-13)
    np.testing.assert_allclose(joined.scatter, whole.scatter, rtol=1e-8, atol=1e-8)
    assert frechet_distance(whole, joined) == 0


def test_frechet_distance_of_independent_normals() -> None:
    """With diagonal covariances the squares of the differences of means and standard deviations are added."""
    random = np.random.default_rng(3)
    means, deviations = random.normal(size=(2, 9)), random.uniform(0.1, 3, (2, 9))
    turn, _ = np.linalg.qr(random.normal(size=(9, 9)))
    expected = ((means[0] - means[1]) ** 2 + (deviations[0] - deviations[1]) ** 2).sum()
    for axes in (np.eye(9), turn):  # and no rotation changes it
        one, other = (statistics(axes @ m, axes @ np.diag(s**2) @ axes.T) for m, s in zip(means, deviations, strict=True))
        assert frechet_distance(one, other) == pytest.approx(expected, rel=1e-10)
        assert frechet_distance(other, one) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("number", "width"), [(200, 8), (12, 64), (2, 64)])
def test_a_set_has_no_distance_from_itself(number: int, width: int) -> None:
    rows = draw(number, width)
    other_order = rows[np.random.default_rng(1).permutation(number)]
    assert frechet_distance(FeatureStatistics.of(rows), FeatureStatistics.of(other_order)) == 0


def test_with_fewer_samples_than_dimensions() -> None:
    """The square root of C1 C2 has the trace of the nuclear norm of the centred samples, which needs no covariance."""
    one, other = draw(9, 80), draw(14, 80, seed=1)
    centred = [(rows - rows.mean(axis=0)) / np.sqrt(len(rows) - 1) for rows in (one, other)]
    shared = np.linalg.svd(centred[0] @ centred[1].T, compute_uv=False).sum()
    expected = (
        ((one.mean(axis=0) - other.mean(axis=0)) ** 2).sum() + (centred[0] ** 2).sum() + (centred[1] ** 2).sum() - 2 * shared
    )
    found = frechet_distance(FeatureStatistics.of(one), FeatureStatistics.of(other))
    assert found == pytest.approx(expected, rel=1e-10)


def test_constant_features_have_the_distance_of_their_means() -> None:
    one, other = np.zeros((5, 4)), np.full((7, 4), 3.0)
    assert frechet_distance(FeatureStatistics.of(one), FeatureStatistics.of(other)) == pytest.approx(36)


def test_a_shift_adds_its_square() -> None:
    rows = draw(60, 12)
    found = [frechet_distance(FeatureStatistics.of(rows), FeatureStatistics.of(rows + s)) for s in (0.0, 0.01, 0.1, 1.0, 10.0)]
    np.testing.assert_allclose(found, [12 * s**2 for s in (0.0, 0.01, 0.1, 1.0, 10.0)], rtol=1e-8)


def kernel_distance_by_pairs(one: FloatArray, other: FloatArray) -> float:
    def kernel(x: FloatArray, y: FloatArray) -> float:
        return float((x @ y / len(x) + 1) ** 3)

    within = [
        np.mean([kernel(a, b) for i, a in enumerate(rows) for j, b in enumerate(rows) if i != j]) for rows in (one, other)
    ]
    return float(sum(within) - 2 * np.mean([kernel(a, b) for a in one for b in other]))


def test_kernel_distance_is_the_unbiased_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = draw(13, 5), draw(17, 5, seed=1, shift=0.2)
    expected = kernel_distance_by_pairs(one, other)
    assert kernel_distance(one, other) == pytest.approx(expected, rel=1e-10)
    monkeypatch.setattr(set_distance, "_MOST_PAIRS", 40)  # in parts
    assert kernel_distance(one, other) == pytest.approx(expected, rel=1e-10)


def test_kernel_distance_of_one_distribution_is_zero_on_average() -> None:
    rows = draw(400, 6)
    values = [kernel_distance(rows[k : k + 20], rows[k + 20 : k + 40]) for k in range(0, 400, 40)]
    assert min(values) < 0 < max(values)
    apart = kernel_distance(rows[:20], draw(20, 6, seed=2, shift=1.0))
    assert abs(np.mean(values)) < 0.1 * apart


def test_frechet_distance_is_biased_for_few_samples_and_kernel_distance_is_not() -> None:
    rows = draw(2000, 40)
    halves = [(rows[:n], rows[1000 : 1000 + n]) for n in (20, 100, 1000)]
    frechet = [frechet_distance(*map(FeatureStatistics.of, pair)) for pair in halves]
    assert all(a > 2 * b for a, b in pairwise(frechet))
    far = abs(kernel_distance(rows[:20], rows[20:40] + 1))
    assert max(abs(kernel_distance(*pair)) for pair in halves) < 0.05 * far


def frozen_features() -> tuple[FloatArray, FloatArray]:
    random = np.random.RandomState(11)  # whose stream is the same with every version of NumPy
    mixed = random.normal(size=(8, 8)) / np.sqrt(8)
    first, second = (np.abs(random.normal(size=(number, 8)) @ mixed) for number in (60, 45))
    return first, second + 0.3


def test_distances_of_fixed_features_are_those_of_other_formulas() -> None:
    """The square root of C1 C2 as a matrix, and the mean of the kernel by loops, which once gave the numbers that are written here."""
    first, second = frozen_features()
    one, other = (np.cov(rows, rowvar=False) for rows in (first, second))
    apart = first.mean(axis=0) - second.mean(axis=0)
    root = np.trace(scipy.linalg.sqrtm(one @ other)).real
    expected = apart @ apart + np.trace(one) + np.trace(other) - 2 * root
    frechet = frechet_distance(FeatureStatistics.of(first), FeatureStatistics.of(second))
    assert frechet == pytest.approx(expected, rel=1e-9)
    assert frechet == pytest.approx(1.0446893997130706, rel=1e-9)
    kernel = kernel_distance(first, second)
    assert kernel == pytest.approx(kernel_distance_by_pairs(first, second), rel=1e-9)
    assert kernel == pytest.approx(1.495607728332324, rel=1e-9)


def test_distances_of_fixed_features_are_those_of_other_libraries() -> None:
    """What pytorch-fid 0.3.0 and torch-fidelity 0.4.0 gave; tests/consumers/test_fid.py runs them."""
    first, second = frozen_features()
    frechet = frechet_distance(FeatureStatistics.of(first), FeatureStatistics.of(second))
    assert frechet == pytest.approx(1.0446893997130706, rel=1e-9)
    assert kernel_distance(first[:45], second) == pytest.approx(1.5493067566777228, rel=1e-9)


def test_draws_of_kernel_distances() -> None:
    one, other = draw(30, 5), draw(40, 5, seed=1, shift=0.2)
    found = kernel_distance_at(one, other, 20, draws=8, seed=5)
    assert (found.size, found.draws) == (20, 8)
    assert found == kernel_distance_at(one, other, 20, draws=8, seed=5)
    assert found.mean != kernel_distance_at(one, other, 20, draws=8, seed=6).mean
    assert found.deviation is not None
    assert found.deviation > 0
    assert kernel_distance_at(one, other, 20, draws=1).deviation is None
    whole = kernel_distance_at(one, other[:30], 30, draws=3)
    assert whole.mean == pytest.approx(kernel_distance(one, other[:30]), rel=1e-9)


def test_vendi_score_counts_what_is_different() -> None:
    assert vendi_score(np.ones((6, 4))) == pytest.approx(1)
    assert vendi_score(np.eye(6)) == pytest.approx(6)
    assert vendi_score(np.repeat(np.eye(3), 4, axis=0)) == pytest.approx(3)
    assert vendi_score(5 * np.repeat(np.eye(3), 4, axis=0)) == pytest.approx(3)  # the length of a row does not matter
    two = np.array([[1.0, 0.0], [np.cos(0.7), np.sin(0.7)]])
    shares = np.array([1 + np.cos(0.7), 1 - np.cos(0.7)]) / 2
    assert vendi_score(two) == pytest.approx(np.exp(-(shares * np.log(shares)).sum()))


@pytest.mark.parametrize("shape", [(9, 30), (30, 9)])
def test_vendi_score_of_features_is_that_of_their_kernel(shape: tuple[int, int]) -> None:
    rows = draw(*shape)
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    assert vendi_score(rows) == pytest.approx(vendi_score_of_kernel(unit @ unit.T), rel=1e-9)


def test_vendi_score_at_one_size_does_not_depend_on_the_size_of_the_set() -> None:
    rows = draw(300, 20)
    few, many = (vendi_at(part, 25, draws=30) for part in (rows[:100], rows))
    assert vendi_score(rows) > 1.1 * vendi_score(rows[:25])
    assert few.deviation is not None
    assert abs(few.mean - many.mean) < 3 * few.deviation
    assert vendi_at(rows[:25], 25).mean == pytest.approx(vendi_score(rows[:25]), rel=1e-9)
    assert vendi_at(rows, 25, draws=4, seed=1) == vendi_at(rows, 25, draws=4, seed=1)
    assert isinstance(few, DrawnValue)


GOOD = draw(6, 4)
WITH_NAN = np.where(np.arange(24).reshape(6, 4) == 9, np.nan, GOOD)
WITH_INFINITY = np.where(np.arange(24).reshape(6, 4) == 9, np.inf, GOOD)


@pytest.mark.parametrize(
    ("compute", "code"),
    [
        (lambda: FeatureStatistics.of(WITH_NAN), "features_invalid"),
        (lambda: FeatureStatistics.of(WITH_INFINITY), "features_invalid"),
        (lambda: FeatureStatistics.of(GOOD[0]), "features_invalid"),
        (lambda: FeatureStatistics.of(GOOD.astype(str)), "features_invalid"),
        (lambda: FeatureStatistics.of(GOOD[:, :0]), "features_invalid"),
        (lambda: FeatureStatistics.of(GOOD[:0]), "too_few_samples"),
        (lambda: FeatureStatistics.joined([]), "too_few_samples"),
        (lambda: FeatureStatistics.joined(map(FeatureStatistics.of, (GOOD, GOOD[:, :3]))), "features_differ"),
        (lambda: frechet_distance(FeatureStatistics.of(GOOD), FeatureStatistics.of(GOOD[:1])), "too_few_samples"),
        (lambda: frechet_distance(FeatureStatistics.of(GOOD), FeatureStatistics.of(GOOD[:, :3])), "features_differ"),
        (lambda: frechet_distance(*[statistics(np.full(2, np.nan), np.eye(2))] * 2), "features_invalid"),
        (lambda: kernel_distance(GOOD, WITH_NAN), "features_invalid"),
        (lambda: kernel_distance(GOOD, GOOD[:, :3]), "features_differ"),
        (lambda: kernel_distance(GOOD[:1], GOOD), "too_few_samples"),
        (lambda: kernel_distance_at(GOOD, GOOD, 7), "too_few_samples"),
        (lambda: kernel_distance_at(GOOD, GOOD, 1), "too_few_samples"),
        (lambda: kernel_distance_at(GOOD, GOOD, 3, draws=0), "setting_invalid"),
        (lambda: vendi_score(WITH_NAN), "features_invalid"),
        (lambda: vendi_score(GOOD[:1]), "too_few_samples"),
        (lambda: vendi_score(GOOD * (np.arange(6) != 2)[:, None]), "features_invalid"),
        (lambda: vendi_at(GOOD, 7), "too_few_samples"),
        (lambda: vendi_at(GOOD, 3, draws=0), "setting_invalid"),
        (lambda: vendi_score_of_kernel(np.ones((1, 1))), "too_few_samples"),
        (lambda: vendi_score_of_kernel(GOOD), "kernel_invalid"),
        (lambda: vendi_score_of_kernel(np.array([[1.0, np.nan], [np.nan, 1.0]])), "kernel_invalid"),
        (lambda: vendi_score_of_kernel(np.array([[1.0, 0.5], [0.4, 1.0]])), "kernel_invalid"),
        (lambda: vendi_score_of_kernel(np.array([[1.0, 0.5], [0.5, 2.0]])), "kernel_invalid"),
        (lambda: vendi_score_of_kernel(np.array([[1.0, 1.5], [1.5, 1.0]])), "kernel_invalid"),
    ],
)
def test_what_is_no_set_is_an_error_and_no_number(compute: Callable[[], Any], code: str) -> None:
    with pytest.raises(ConfigError) as error:
        compute()
    assert error.value.code == code
    assert "\n" not in str(error.value)
