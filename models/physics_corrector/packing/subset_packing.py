"""Crowds that growth alone does not part: some bodies are left out, and put back where the others leave or make room."""

from collections.abc import Sequence

import numpy as np

from models.physics_corrector.packing.grid_search import least_blocked_place
from models.physics_corrector.packing.inflation import RELEASED, inflate_bodies
from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import project
from stable_data.scene import FloatArray

_STEPS = 16
_GROWTH_STEPS = 3
_PLACES = 8  # where a body that was left out is tried again
_ROUNDS = 2  # in which all of those are tried
_SHARES = (0.2, 0.4, 0.6)  # of the bodies that are left out for a while


def pack_subset(crowd: PackingProblem, aims: FloatArray, spare: Sequence[int]) -> tuple[FloatArray, list[int]] | None:
    """Finds shifts at which nothing meets once as few bodies as possible are left out.

    Large things are placed first and small ones into what is left; where some find no place, that is weighed against leaving
    out larger ones, which make room for many.

    Args:
        crowd: The bodies.
        aims: Where they want to be, (B, 2).
        spare: Those that may be left out, those that should go first, first.

    Returns:
        The shifts, and the bodies that are left out; None where leaving out all of ``spare`` does not do.
    """
    free = np.flatnonzero(crowd.is_free)
    smallest = sorted(free.tolist(), key=lambda k: -_room(crowd, k))
    best: tuple[FloatArray, list[int]] | None = None
    for share in _SHARES:
        found = _without(crowd, aims, smallest[: max(1, int(share * len(smallest)))])
        if found is not None and set(found[1]) <= set(spare) and (best is None or len(found[1]) < len(best[1])):
            best = found
        if best is not None and not best[1]:
            return best
    many = 1
    while spare and (best is None or many < len(best[1])):
        found = _without(crowd, aims, spare[:many])
        if found is not None:
            return found if best is None or len(found[1]) < len(best[1]) else best
        if many >= len(spare):
            break
        many = min(2 * many, len(spare))
    return best


def _without(crowd: PackingProblem, aims: FloatArray, out: Sequence[int]) -> tuple[FloatArray, list[int]] | None:
    """Parts a crowd without some bodies, then puts back those for which there is room."""
    shifts, is_parted = inflate_bodies(crowd.without(out), np.zeros_like(aims), aims, _GROWTH_STEPS)
    return _put_back(crowd, aims, shifts, list(out)) if is_parted else None


def _put_back(crowd: PackingProblem, aims: FloatArray, shifts: FloatArray, out: list[int]) -> tuple[FloatArray, list[int]]:
    """Bodies that were left out to the nearest free places, or to where others make room for them, the largest first."""
    even = np.ones((len(shifts), len(shifts)))
    for _ in range(_ROUNDS):
        before = len(out)
        for k in sorted(out, key=lambda k: _room(crowd, k)):
            others = crowd.without([b for b in out if b != k])
            for place in least_blocked_place(others, shifts, aims, k, even, _PLACES):
                there = shifts.copy()
                there[k] = place
                moved, is_parted = project(others, there, there, _STEPS, RELEASED)
                if is_parted:
                    shifts, out = moved, [b for b in out if b != k]
                    break
        if not out or len(out) == before:
            break
    return shifts, out


def _room(crowd: PackingProblem, k: int) -> float:
    """Area over which a body may shift, square metres: the less, the larger it is."""
    return float(np.prod(crowd.high[k] - crowd.low[k]))
