"""Sums of values of which some may be unknown."""

from collections.abc import Iterable
from typing import TypeVar

_Number = TypeVar("_Number", int, float)


def total(values: Iterable[_Number | None]) -> _Number | None:
    """Returns the sum of values; None if one of them is not known."""
    found: _Number = 0
    for value in values:
        if value is None:
            return None
        found += value
    return found
