"""Sizes of categories, and the unit that makes an asset as large as such things are.

The table ``sizes.csv`` names the source of each row. A category may have rows of several sources.
"""

import csv
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

from stable_data.assets.text_embeddings import TextEncoder
from stable_data.importers.conversion.naming import Vocabulary, related_categories
from stable_data.scene import FloatArray

RIGHT = math.log(1.5)
"""Logarithm of the factor within which a size counts as right."""

_USUAL_SPREAD = 0.35  # standard deviation of log sizes in a category of which one example is known
_PRIOR_COUNT = 2.0  # examples that this spread weighs as much as
_MOST_COUNTED = 6  # examples of a source that count, so that no source outweighs the others
_SIDE_SPREAD = np.array([1.0, 1.1, 1.5])  # spread of the longest, middle and shortest side, relative to that of the longest
_SAME_SIDE = 0.15  # difference of the logarithms of a height and of a side that is upright
_QUANTILE = 1.645  # of the normal distribution, for 5 and 95 %
_OTHER_NAME, _ALIKE_ONLY = 0.15, 0.45  # further standard deviation if the row is that of another name, or of a similar category
_NEIGHBOURS, _LEAST_ALIKE, _LIKENESS_SCALE = 10, 0.4, 0.08  # similar categories: number, least cosine of the first, decay


@dataclass(frozen=True, slots=True, eq=False)
class CategorySize:
    """How large the things of a category are.

    Attributes:
        category: Its name.
        log_sides: Means of the logarithms of the longest, middle and shortest side, metres, (3,) float64.
        spread: Standard deviation of the logarithm of the longest side.
        num: Examples that this rests on.
        upright: Usual height divided by the longest side.
    """

    category: str
    log_sides: FloatArray
    spread: float
    num: int
    upright: float

    @property
    def vertical(self) -> frozenset[int]:
        """Which sides are upright in the usual pose: 0 the longest, 1 the middle, 2 the shortest; several if they are nearly equal."""
        misfits = np.abs(self.log_sides - self.log_sides[0] - math.log(self.upright))
        nearly = max(_SAME_SIDE, float(misfits.min()))
        return frozenset(k for k in range(3) if misfits[k] <= nearly)

    @property
    def low(self) -> float:
        """Longest side that 5 % are below, metres."""
        return math.exp(self.log_sides[0] - _QUANTILE * self.spread)

    @property
    def high(self) -> float:
        """Longest side that 5 % are above, metres."""
        return math.exp(self.log_sides[0] + _QUANTILE * self.spread)


@dataclass(frozen=True, slots=True)
class Scale:
    """An estimated unit.

    Attributes:
        unit_m: Metres for each unit.
        confidence: Estimated probability that it is right within a factor of 1.5.
        spread: Standard deviation of its logarithm.
    """

    unit_m: float
    confidence: float
    spread: float


@dataclass(frozen=True, slots=True)
class SetScale:
    """The common unit of a set of assets, whose files do not state one.

    Attributes:
        unit_m: Metres for each unit.
        confidence: Estimated probability that it is right within a factor of 1.5.
        num: Assets that it rests on.
    """

    unit_m: float
    confidence: float
    num: int


class SizeTable:
    """Sizes of categories.

    Args:
        encoder: Finds similar categories; None: only names count.
        without: Beginnings of the names of sources whose rows are left out, to measure on that source.

    Attributes:
        sizes: Category -> its sizes.
    """

    def __init__(self, encoder: TextEncoder | None = None, without: Sequence[str] = ()) -> None:
        self.sizes = read_sizes(tuple(without))
        self._vocabulary = Vocabulary(self.sizes, encoder)

    def find(self, category: str) -> tuple[CategorySize, float] | None:
        """Returns the sizes of a category, of one of its names, or of categories like it; None if nothing is known.

        Returns:
            The sizes, and the standard deviation that the likeness adds.
        """
        if category in self.sizes:
            return self.sizes[category], 0.0
        for related in (self._vocabulary.known(category), *related_categories(category)):
            if related in self.sizes:
                return self.sizes[related], _OTHER_NAME
        return self._alike(category)

    def _alike(self, category: str) -> tuple[CategorySize, float] | None:
        """The mean of the sizes of similar categories, weighed by their likeness."""
        likeness = self._vocabulary.likenesses(category.replace("_", " "))
        order = np.argsort(-likeness, kind="stable")[:_NEIGHBOURS]
        if likeness[order[0]] < _LEAST_ALIKE:
            return None
        near = [self.sizes[self._vocabulary.categories[k]] for k in order]
        weights = np.exp((likeness[order] - likeness[order[0]]) / _LIKENESS_SCALE)
        weights /= weights.sum()
        logs = np.array([size.log_sides for size in near])
        mean = weights @ logs
        spread = math.sqrt(float(weights @ (np.array([size.spread for size in near]) ** 2 + (logs[:, 0] - mean[0]) ** 2)))
        upright = float(weights @ np.array([size.upright for size in near]))
        return CategorySize(near[0].category, mean, spread, 1, upright), _ALIKE_ONLY

    def infer_scale(self, category: str, extents: Sequence[float]) -> Scale | None:
        """Estimates the unit of an asset from the sizes of its category; None if no sizes are known.

        Args:
            category: Its category.
            extents: Box of its mesh, units of its file, at least one positive.
        """
        found = self.find(category)
        if found is None:
            return None
        size, added = found
        return _fit(size.log_sides, math.hypot(size.spread, added), extents)

    def set_scale(self, listing: Iterable[tuple[str, Sequence[float]]]) -> SetScale | None:
        """Estimates the common unit of a set: the median of what its assets suggest, each weighed by its certainty.

        Args:
            listing: Category and box (units of the files) of each asset.

        Returns:
            The unit, or None if no category is known.
        """
        found = [scale for each in listing if (scale := self.infer_scale(*each)) is not None]
        if not found:
            return None
        logs, weights = np.log([s.unit_m for s in found]), np.array([s.spread**-2 for s in found])
        middle = _weighted_median(logs, weights)
        # The deviations of a stylised set are larger than those of sizes of real things.
        deviation = max(_weighted_median(np.abs(logs - middle), weights) / 0.6745, 0.1)
        count = weights.sum() ** 2 / (weights**2).sum()
        spread = math.hypot(1.2533 * deviation / math.sqrt(count), deviation)
        return SetScale(math.exp(middle), _probability(spread), len(found))


@lru_cache(maxsize=4)
def read_sizes(without: tuple[str, ...] = ()) -> Mapping[str, CategorySize]:
    """Reads the rows of ``sizes.csv`` and joins those of a category; ``without`` as in :class:`SizeTable`."""
    rows: dict[str, list[dict[str, str]]] = defaultdict(list)
    text = files("stable_data.importers.conversion").joinpath("sizes.csv").read_text("utf-8")
    for row in csv.DictReader(text.splitlines()):
        if not row["source"].startswith(tuple(without)) or not without:
            rows[row["category"]].append(row)
    return {category: _joined(category, found) for category, found in rows.items()}


def _joined(category: str, rows: Sequence[Mapping[str, str]]) -> CategorySize:
    counts = np.array([min(int(row["num"]), _MOST_COUNTED) for row in rows], np.float64)
    logs = np.log([[float(row[name]) for name in ("longest", "middle", "shortest", "height", "low", "high")] for row in rows])
    means = counts @ logs[:, :4] / counts.sum()
    within = ((logs[:, 5] - logs[:, 4]) / (2 * _QUANTILE)) ** 2
    squares = counts @ (within + (logs[:, 0] - means[0]) ** 2) + _PRIOR_COUNT * _USUAL_SPREAD**2
    spread = math.sqrt(squares / (counts.sum() + _PRIOR_COUNT))
    return CategorySize(category, means[:3], spread, int(counts.sum()), math.exp(means[3] - means[0]))


def _fit(log_sides: FloatArray, spread: float, extents: Sequence[float]) -> Scale:
    """The unit that fits the sides of a box to those of a category."""
    sides = np.sort(np.asarray(extents, np.float64))[::-1]
    logs = log_sides - np.log(np.maximum(sides, 1e-4 * sides[0]))
    spreads = np.hypot(_SIDE_SPREAD * spread, 0.05)
    weights = spreads**-2
    # A side that says something else is an odd model or a kind of its own: it is bounded, so that it cannot outweigh the others.
    middle = _weighted_median(logs, weights)
    bounded = middle + np.clip(logs - middle, -spreads, spreads)
    log_unit = float(weights @ bounded / weights.sum())
    misfit = math.sqrt(float(weights @ (bounded - log_unit) ** 2 / weights.sum()))
    total = math.hypot(spread, misfit)
    return Scale(math.exp(log_unit), _probability(total), total)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def _probability(spread: float) -> float:
    """Probability that a normally distributed logarithm is within :data:`RIGHT` of its mean."""
    return math.erf(RIGHT / (spread * math.sqrt(2)))
