"""Faults that rules find in a scene, and the score that follows from them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import prod

from stable_data.rating.criteria import HIGHEST, LOWEST
from stable_data.rating.rating import CriterionScore

_SHOWN = 4  # faults that a rationale lists


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault.

    Attributes:
        severity: How much of what a score is above the lowest one it takes away, from 0 to 1.
        what: The fault in some words.
    """

    severity: float
    what: str

    def __post_init__(self) -> None:
        assert 0 <= self.severity <= 1, f"severity is {self.severity}: {self.what}"


def score_by(faults: Iterable[Fault], checked: Sequence[str], left_out: Sequence[str] = ()) -> CriterionScore:
    """Computes the score of a criterion: ``1 + 9 · Π (1 − severity)``.

    Args:
        faults: The faults.
        checked: What was checked, in some words each.
        left_out: What could not be checked, and is left out.

    Returns:
        The score, rounded to hundredths, with the worst faults in its rationale.
    """
    found = sorted(faults, key=lambda fault: -fault.severity)  # stable: equal ones keep their order
    score = LOWEST + (HIGHEST - LOWEST) * prod(1 - fault.severity for fault in found)
    parts = [fault.what for fault in found[:_SHOWN]]
    parts += [f"{len(found) - _SHOWN} more faults"] if len(found) > _SHOWN else []
    parts += [f"checked: {', '.join(checked)}"] if checked else []
    parts += [f"left out: {', '.join(left_out)}"] if left_out else []
    return CriterionScore(round(score, 2), "; ".join(parts))


def unknown(why: str) -> CriterionScore:
    """Returns the score of a criterion that cannot be judged."""
    return CriterionScore(None, why)


def listed(names: Sequence[str], most: int = 3) -> str:
    """Returns names in one line, of which the first few are shown."""
    shown = ", ".join(names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown
