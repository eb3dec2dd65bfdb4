"""Distances between two sets of features of pictures, and the diversity of one set.

A feature is a row of numbers that describes one picture; features that are compared come from one extractor. Three figures:

* Fréchet distance (Heusel et al. 2017, equation 6): both sets are taken as normal distributions, whose distance is
  ``|m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2))``. On the features of Inception v3 it is called FID. It is biased: for few samples it is
  far too large, so only sets of one size may be compared.
* Kernel distance (Bińkowski et al. 2018): the unbiased estimate of the squared maximum mean discrepancy with the kernel
  ``(x . y / D + 1)^3``. On the features of Inception v3 it is called KID. Its mean does not depend on the number of samples, so it is the
  figure for small sets. As an unbiased estimate of 0 it may be a little negative.
* Vendi score (Friedman & Dieng 2022, equation 2): the exponential of the entropy of the eigenvalues of a similarity kernel: 1 if all
  samples are alike, N if none is like another one. It grows with the number of samples, so sets are compared at one size.

The draws of subsets are those of NumPy's ``RandomState``, whose stream never changes: a seed gives the same value with every version of
NumPy. Nothing here needs torch.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.linalg
from scipy.linalg.lapack import dpstrf

from stable_data.errors import ConfigError
from stable_data.scene import FloatArray

Features: TypeAlias = npt.NDArray[np.floating[Any]]
"""(N, D), one row for each picture."""

_MOST_PAIRS = 1 << 22  # values of a kernel that are in memory at a time
_SYMMETRIC = 1e-8  # largest difference of a kernel from its transpose, and of its diagonal from 1
_NEGATIVE = 1e-6  # largest negative eigenvalue of a kernel that is taken for rounding, as a share of its trace


@dataclass(frozen=True, slots=True, eq=False)
class FeatureStatistics:
    """Count, mean and spread of features; parts can be joined, so that the features of a large set need not be kept.

    Attributes:
        count: Number of samples.
        mean: (D,) float64.
        scatter: (D, D) float64, the sum of the outer products of the deviations from the mean.
    """

    count: int
    mean: FloatArray
    scatter: FloatArray

    @classmethod
    def of(cls, features: Features) -> "FeatureStatistics":
        """Computes the statistics of features, (N, D), at least one row.

        Raises:
            ConfigError: The features cannot be used (``features_invalid``), or there are none (``too_few_samples``).
        """
        rows = _checked(features, "features", fewest=1)
        mean = rows.mean(axis=0)
        deviations = rows - mean
        return cls(len(rows), mean, deviations.T @ deviations)

    @classmethod
    def joined(cls, parts: Iterable["FeatureStatistics"]) -> "FeatureStatistics":
        """Joins the statistics of the parts of a set, one after the other; only the sum is kept.

        Raises:
            ConfigError: There is no part (``too_few_samples``), or parts have features of different lengths (``features_differ``).
        """
        total: FeatureStatistics | None = None
        for part in parts:
            total = part if total is None else total._with(part)
        if total is None:
            raise ConfigError("a set of features has no parts, expected at least one", "too_few_samples")
        return total

    def _with(self, other: "FeatureStatistics") -> "FeatureStatistics":
        """The statistics of both sets together (Chan, Golub & LeVeque 1979)."""
        _check_lengths(len(self.mean), len(other.mean))
        count = self.count + other.count
        apart = other.mean - self.mean
        between = self.count * other.count / count * np.outer(apart, apart)
        return FeatureStatistics(count, self.mean + other.count / count * apart, self.scatter + other.scatter + between)

    @property
    def covariance(self) -> FloatArray:
        """The unbiased covariance, (D, D) float64.

        Raises:
            ConfigError: There is only one sample (``too_few_samples``).
        """
        if self.count < 2:
            raise ConfigError(f"a set has {self.count} sample, expected at least 2 for a covariance", "too_few_samples")
        return self.scatter / (self.count - 1)


@dataclass(frozen=True, slots=True)
class DrawnValue:
    """A value over random subsets of a set.

    Attributes:
        mean: Mean over the subsets.
        deviation: Standard deviation over them (of the population, as usual for KID); None for one subset.
        size: Samples of a subset.
        draws: Number of subsets.
    """

    mean: float
    deviation: float | None
    size: int
    draws: int


def frechet_distance(first: FeatureStatistics, second: FeatureStatistics) -> float:
    """Computes the Fréchet distance of two sets: FID, if the features are those of Inception v3.

    The trace of the square root of C1 C2 is the sum of the singular values of F1^T F2, where C = F F^T. In contrast to the square root
    of the product, which is not symmetric, this needs no inverse and has no imaginary parts: covariances may be singular, as they are
    with fewer samples than dimensions.

    Args:
        first: Statistics of the one set.
        second: Statistics of the other one.

    Returns:
        The distance, not negative; 0 for one set and itself.

    Raises:
        ConfigError: A set has fewer than 2 samples (``too_few_samples``), the features differ in length (``features_differ``), or
            statistics are not finite (``features_invalid``).
    """
    _check_lengths(len(first.mean), len(second.mean))
    one, other = first.covariance, second.covariance
    if not all(np.isfinite(part).all() for part in (first.mean, second.mean, one, other)):
        raise ConfigError(
            "statistics of features have values that are no finite numbers, expected finite ones", "features_invalid"
        )
    apart = first.mean - second.mean
    shared = np.linalg.svd(_factor(one).T @ _factor(other), compute_uv=False).sum()
    spread = float(np.trace(one) + np.trace(other))
    distance = float(apart @ apart + spread - 2 * shared)
    # Below the rounding of its terms the difference has no meaning: equal sets have exactly 0, in whatever order they are read.
    terms = spread + float(first.mean @ first.mean + second.mean @ second.mean)
    rounding = np.finfo(np.float64).eps * 16 * terms
    return distance if distance > rounding else 0.0


def kernel_distance(first: Features, second: Features) -> float:
    """Computes the kernel distance of two whole sets: KID, if the features are those of Inception v3.

    Args:
        first: (M, D), M at least 2.
        second: (N, D), N at least 2.

    Returns:
        The unbiased estimate of MMD², with the kernel (x · y / D + 1)³; it may be a little negative for sets that are alike.

    Raises:
        ConfigError: Features cannot be used (``features_invalid``, ``features_differ``, ``too_few_samples``).
    """
    return _kernel_distance(*_checked_pair(first, second))


def kernel_distance_at(first: Features, second: Features, size: int, draws: int = 100, seed: int = 2020) -> DrawnValue:
    """Computes the kernel distance over random subsets of both sets, as KID is usually given.

    Args:
        first: (M, D).
        second: (N, D).
        size: Samples of each subset, without repetition; usually 1000, or all of the smaller set.
        draws: Number of pairs of subsets.
        seed: Seed of the draws; equal seeds draw the subsets that torch-fidelity draws, whose seed is 2020.

    Raises:
        ConfigError: Features cannot be used (``features_invalid``, ``features_differ``), a set has fewer than ``size`` samples or
            ``size`` is below 2 (``too_few_samples``), or ``draws`` is below 1 (``setting_invalid``).
    """
    one, other = _checked_pair(first, second)
    fewest = min(len(one), len(other))

    def distance(random: np.random.RandomState) -> float:
        subset = one[random.choice(len(one), size, replace=False)]
        return _kernel_distance(subset, other[random.choice(len(other), size, replace=False)])

    return _drawn(distance, fewest, size, draws, seed)


def vendi_score(features: Features) -> float:
    """Computes the Vendi score of features with the cosine as similarity: the effective number of different samples.

    Args:
        features: (N, D), N at least 2; no row may be zero.

    Returns:
        From 1, all rows point in one direction, to N, all are at right angles to each other.

    Raises:
        ConfigError: Features cannot be used (``features_invalid``, ``too_few_samples``).
    """
    return _vendi_score(_unit_rows(features))


def vendi_score_of_kernel(kernel: FloatArray) -> float:
    """Computes the Vendi score of a similarity kernel.

    Args:
        kernel: (N, N), N at least 2: symmetric, positive semi-definite, 1 on the diagonal.

    Raises:
        ConfigError: It is no such kernel (``kernel_invalid``), or N is below 2 (``too_few_samples``).
    """
    given = np.asarray(kernel, np.float64)
    if given.ndim != 2 or given.shape[0] != given.shape[1]:
        raise ConfigError(f"kernel has the shape {given.shape}, expected a square", "kernel_invalid")
    _check_count(len(given), "kernel")
    if not np.isfinite(given).all():
        raise ConfigError("kernel has values that are no finite numbers, expected finite ones", "kernel_invalid")
    if abs(given - given.T).max() > _SYMMETRIC or abs(np.diag(given) - 1).max() > _SYMMETRIC:
        raise ConfigError(
            "kernel is not symmetric with 1 on the diagonal, expected the similarity of samples", "kernel_invalid"
        )
    values = scipy.linalg.eigvalsh(given / len(given))
    if values.min() < -_NEGATIVE:
        raise ConfigError(
            f"kernel has the eigenvalue {values.min() * len(given):.3g}, expected none below 0: it is no similarity",
            "kernel_invalid",
        )
    return _exponential_of_entropy(values)


def vendi_at(features: Features, size: int, draws: int = 20, seed: int = 0) -> DrawnValue:
    """Computes the Vendi score over random subsets of one size, so that sets of different sizes can be compared.

    Args:
        features: (N, D); no row may be zero.
        size: Samples of each subset, without repetition.
        draws: Number of subsets.
        seed: Seed of the draws.

    Raises:
        ConfigError: Features cannot be used (``features_invalid``), the set has fewer than ``size`` samples or ``size`` is below 2
            (``too_few_samples``), or ``draws`` is below 1 (``setting_invalid``).
    """
    rows = _unit_rows(features)
    return _drawn(
        lambda random: _vendi_score(rows[random.choice(len(rows), size, replace=False)]), len(rows), size, draws, seed
    )


def _drawn(value: Callable[[np.random.RandomState], float], fewest: int, size: int, draws: int, seed: int) -> DrawnValue:
    """Mean and deviation of a value over draws of one random stream."""
    _check_count(size, "a subset")
    if size > fewest:
        raise ConfigError(f"subsets have {size} samples, but a set has only {fewest}; choose a smaller size", "too_few_samples")
    if draws < 1:
        raise ConfigError(f"draws is {draws}, expected at least 1", "setting_invalid")
    random = np.random.RandomState(seed)
    values = np.array([value(random) for _ in range(draws)])
    return DrawnValue(float(values.mean()), float(values.std()) if draws > 1 else None, size, draws)


def _factor(covariance: FloatArray) -> FloatArray:
    """F with C = F F^T, (D, R) float64, R the numerical rank of the covariance (D, D): a Cholesky decomposition with pivots."""
    lower, pivots, rank, _ = dpstrf(covariance, lower=1)
    factor = np.zeros((len(covariance), rank))
    factor[pivots - 1] = np.tril(lower)[:, :rank]
    return factor


def _kernel_distance(first: FloatArray, second: FloatArray) -> float:
    between = _kernel_sum(first, second) / (len(first) * len(second))
    return _mean_within(first) + _mean_within(second) - 2 * between


def _mean_within(rows: FloatArray) -> float:
    """Mean of the kernel over all pairs of different rows."""
    same = float((((rows * rows).sum(axis=1) / rows.shape[1] + 1) ** 3).sum())
    return (_kernel_sum(rows, rows) - same) / (len(rows) * (len(rows) - 1))


def _kernel_sum(first: FloatArray, second: FloatArray) -> float:
    """Sum of the kernel over all pairs of a row of each; only a part of the kernel is in memory at a time."""
    step = max(1, _MOST_PAIRS // len(second))
    blocks = (first[k : k + step] @ second.T / first.shape[1] + 1 for k in range(0, len(first), step))
    return sum(float((block * block * block).sum()) for block in blocks)


def _vendi_score(rows: FloatArray) -> float:
    """The score of unit rows. X X^T / N and X^T X / N have the same eigenvalues above 0; the smaller one is taken."""
    product = rows @ rows.T if len(rows) <= rows.shape[1] else rows.T @ rows
    return _exponential_of_entropy(scipy.linalg.eigvalsh(product / len(rows), check_finite=False))


def _exponential_of_entropy(eigenvalues: npt.NDArray[Any]) -> float:
    positive = eigenvalues[eigenvalues > 0]
    return float(np.exp(-(positive * np.log(positive)).sum()))


def _unit_rows(features: Features) -> FloatArray:
    rows = _checked(features, "features")
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    if (lengths == 0).any():
        row = int(np.flatnonzero(lengths[:, 0] == 0)[0])
        raise ConfigError(f"features: row {row} is zero, expected rows with a direction", "features_invalid")
    return np.asarray(rows / lengths)


def _checked_pair(first: Features, second: Features) -> tuple[FloatArray, FloatArray]:
    one, other = _checked(first, "first features"), _checked(second, "second features")
    _check_lengths(one.shape[1], other.shape[1])
    return one, other


def _checked(features: Features, name: str, fewest: int = 2) -> FloatArray:
    """Features as float64, if they can be used."""
    given = np.asarray(features)
    if (
        given.ndim != 2
        or given.shape[1] == 0
        or not (np.issubdtype(given.dtype, np.floating) or np.issubdtype(given.dtype, np.integer))
    ):
        raise ConfigError(
            f"{name} have the shape {given.shape} and the type {given.dtype}, expected rows of numbers", "features_invalid"
        )
    _check_count(len(given), name, fewest)
    rows: FloatArray = given.astype(np.float64)
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise ConfigError(
            f"{name}: {bad.sum()} of {len(rows)} rows have values that are no finite numbers, row {np.flatnonzero(bad)[0]} first",
            "features_invalid",
        )
    return rows


def _check_count(count: int, name: str, fewest: int = 2) -> None:
    if count < fewest:
        raise ConfigError(f"{name}: {count} samples, expected at least {fewest}", "too_few_samples")


def _check_lengths(first: int, second: int) -> None:
    if first != second:
        raise ConfigError(
            f"features have {first} and {second} numbers, expected features of one extractor in both sets", "features_differ"
        )
