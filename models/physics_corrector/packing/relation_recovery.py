"""From a layout at which nothing meets to a better one: nearer to where things were, with relations won back that were given up."""

import numpy as np

from models.physics_corrector.packing.grid_search import least_blocked_place
from models.physics_corrector.packing.inflation import RELEASED
from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import HARD, is_free_of_overlap, project
from stable_data.scene import FloatArray

_STEPS, _FEW_STEPS = 16, 4
_PLACES = 2  # that are tried for a body


def polish_layout(crowd: PackingProblem, shifts: FloatArray, aims: FloatArray) -> FloatArray:
    """Back to relations that were given up, then nearer to the aims, without passing one body by another.

    Args:
        crowd: The bodies.
        shifts: Where they are, nothing meets, (B, 2), metres.
        aims: Where they want to be, (B, 2).

    Returns:
        Shifts at which nothing meets.
    """
    if crowd.broken(shifts).any():
        for price in (HARD, 0.3):
            shifts = _better(crowd, shifts, project(crowd, shifts, shifts, _FEW_STEPS, price))
    return _nearer(crowd, shifts, aims, _STEPS)


def recover_relations(crowd: PackingProblem, shifts: FloatArray, aims: FloatArray, tries: int) -> FloatArray:
    """Puts bodies of broken directional relations where those hold, and lets others make room.

    Args:
        crowd: The bodies.
        shifts: Where they are, nothing meets, (B, 2), metres.
        aims: Where they want to be, (B, 2).
        tries: How many times a body may be put elsewhere.

    Returns:
        Shifts at which nothing meets, no more relations are broken.
    """
    tried: set[tuple[int, int]] = set()
    for _ in range(tries):
        broken = crowd.broken(shifts)
        ends = ((int(n), int(k)) for n in np.flatnonzero(broken) for k in (crowd.subjects[n], crowd.targets[n]))
        n, k = next(((n, k) for n, k in ends if crowd.is_free[k] and (n, k) not in tried), (-1, -1))
        if k < 0:
            break
        tried.add((n, k))
        prices = np.where(broken, RELEASED, HARD)
        prices[n] = HARD
        for there in _elsewhere(crowd, shifts, aims, k, n):
            moved, is_parted = project(crowd, there, there, _FEW_STEPS, prices)
            if is_parted and crowd.broken(moved).sum() < broken.sum():
                shifts = _nearer(crowd, moved, aims, _FEW_STEPS)
                tried.clear()
                break
    return _nearer(crowd, shifts, aims, _STEPS)


def _elsewhere(crowd: PackingProblem, shifts: FloatArray, aims: FloatArray, k: int, order: int) -> list[FloatArray]:
    """Shifts of all where one body is where a directional relation holds, and may be in others."""
    even = np.ones((len(shifts), len(shifts)))
    found = []
    for place in least_blocked_place(crowd, shifts, aims, k, even, _PLACES, order):
        there = shifts.copy()
        there[k] = place
        found.append(there)
    return found


def _nearer(crowd: PackingProblem, shifts: FloatArray, aims: FloatArray, steps: int) -> FloatArray:
    prices = np.where(crowd.broken(shifts), RELEASED, HARD)
    return _better(crowd, shifts, project(crowd, shifts, aims, steps, prices))


def _better(crowd: PackingProblem, shifts: FloatArray, other: tuple[FloatArray, bool]) -> FloatArray:
    """Other shifts where they part the crowd and break no more relations, else these."""
    moved, is_parted = other
    good = is_parted and is_free_of_overlap(crowd, moved) and crowd.broken(moved).sum() <= crowd.broken(shifts).sum()
    return moved if good else shifts
