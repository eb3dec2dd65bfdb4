"""The mean of repeated measurements and how sure it is."""

import math
from collections.abc import Sequence
from statistics import mean, stdev

from scipy.stats import t as student


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns the mean of repetitions and its 95 % interval (Student's t); infinitely wide for fewer than two."""
    centre = mean(values)
    if len(values) < 2:
        return centre, -math.inf, math.inf
    half = float(student.ppf(0.975, len(values) - 1)) * stdev(values) / math.sqrt(len(values))
    return centre, centre - half, centre + half
