"""How sure a rate or a mean is."""

import math
from collections.abc import Sequence
from statistics import mean, stdev

from scipy.stats import binomtest
from scipy.stats import t as student


def wilson_interval(successes: int, attempts: int) -> tuple[float, float]:
    """Returns Wilson's 95 % interval of the probability of success; (0, 1) without attempts.

    Args:
        successes: Attempts that succeeded.
        attempts: All attempts, taken as independent of each other.

    Raises:
        ValueError: There are more successes than attempts, or a number is negative.
    """
    if not 0 <= successes <= attempts:
        raise ValueError(f"{successes} successes of {attempts} attempts, expected 0 to {attempts}")
    if not attempts:
        return 0.0, 1.0
    found = binomtest(successes, attempts).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def share_text(num: int, of: int) -> str:
    """Returns a share for a table, such as ``6/8 [41, 93]``, with Wilson's 95 % interval in percent; ``0/0`` has none."""
    if not of:
        return "0/0"
    low, high = wilson_interval(num, of)
    return f"{num}/{of} [{100 * low:.0f}, {100 * high:.0f}]"


def mean_text(values: Sequence[float | None], digits: int) -> str | None:
    """Returns a mean for a table, with half of the width of its 95 % interval; None if a value, or every one, is not known.

    Args:
        values: Independent values; a single one has no interval.
        digits: Decimals.
    """
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None
    centre, low, high = mean_interval(known)
    return f"{centre:.{digits}f}" if len(known) < 2 else f"{centre:.{digits}f} ±{(high - low) / 2:.{digits}f}"


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns the mean of repetitions and its 95 % interval (Student's t); infinitely wide for fewer than two.

    Args:
        values: At least one value, taken as independent of each other.
    """
    centre = mean(values)
    if len(values) < 2:
        return centre, -math.inf, math.inf
    half = float(student.ppf(0.975, len(values) - 1)) * stdev(values) / math.sqrt(len(values))
    return centre, centre - half, centre + half
