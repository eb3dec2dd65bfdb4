"""Intervals of rates and means: known values."""

import math

import pytest

from stable_data.scores.intervals import mean_interval, wilson_interval


def test_wilson_intervals() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
    low, high = wilson_interval(8, 10)
    assert (round(low, 3), round(high, 3)) == (0.49, 0.943)  # Wilson 1927
    with pytest.raises(ValueError, match="3 successes of 2"):
        wilson_interval(3, 2)


def test_the_interval_of_a_mean() -> None:
    assert mean_interval([1.0, 3.0]) == pytest.approx((2.0, 2 - 12.706, 2 + 12.706), abs=1e-3)  # t of one degree of freedom
    assert mean_interval([5.0]) == (5.0, -math.inf, math.inf)
