"""Unit quaternions of any finite ones."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.rotations import normalise_quat

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@given(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS).filter(any))
def test_any_quaternion_that_is_not_zero_has_a_direction(quat: tuple[float, float, float, float]) -> None:
    unit = normalise_quat(quat)
    assert math.hypot(*unit) == pytest.approx(1.0)
    longest = max(map(abs, quat))
    ratios = [q / longest for q in quat]
    assert unit == pytest.approx([r / math.hypot(*ratios) for r in ratios])
