"""Improves a layout without overlap: bodies move nearer to their aims, and released relations are restored."""

import numpy as np

from models.physics_corrector.packing.grid_search import least_blocked_place
from models.physics_corrector.packing.inflation import RELEASED
from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import HARD, is_free_of_overlap, project
from stable_data.scene import FloatArray

_STEPS, _FEW_STEPS = 16, 4  # of a projection
_PLACES = 2  # places that are tried for a body


def polish_layout(problem: PackingProblem, shifts: FloatArray, aims: FloatArray) -> FloatArray:
    """Restores released relations, then moves bodies nearer to their aims, without moving one past another.

    Args:
        problem: The bodies.
        shifts: Their shifts, without overlap, (B, 2), metres.
        aims: Their wanted shifts, (B, 2).

    Returns:
        Shifts without overlap.
    """
    if problem.broken(shifts).any():
        for price in (HARD, 0.3):
            shifts = _better(problem, shifts, project(problem, shifts, shifts, _FEW_STEPS, price))
    return _nearer(problem, shifts, aims, _STEPS)


def recover_relations(problem: PackingProblem, shifts: FloatArray, aims: FloatArray, tries: int) -> FloatArray:
    """Moves bodies of broken directional relations to places where these hold, and the others out of their way.

    Args:
        problem: The bodies.
        shifts: Their shifts, without overlap, (B, 2), metres.
        aims: Their wanted shifts, (B, 2).
        tries: How many times a body may be relocated.

    Returns:
        Shifts without overlap, with at most as many broken relations as before.
    """
    tried: set[tuple[int, int]] = set()
    for _ in range(tries):
        broken = problem.broken(shifts)
        ends = ((int(n), int(k)) for n in np.flatnonzero(broken) for k in (problem.subjects[n], problem.targets[n]))
        n, k = next(((n, k) for n, k in ends if problem.is_free[k] and (n, k) not in tried), (-1, -1))
        if k < 0:
            break
        tried.add((n, k))
        prices = np.where(broken, RELEASED, HARD)
        prices[n] = HARD
        for place in least_blocked_place(problem, shifts, aims, k, _PLACES, n):
            there = shifts.copy()
            there[k] = place
            moved, is_separated = project(problem, there, there, _FEW_STEPS, prices)
            if is_separated and problem.broken(moved).sum() < broken.sum():
                shifts = _nearer(problem, moved, aims, _FEW_STEPS)
                tried.clear()
                break
    return _nearer(problem, shifts, aims, _STEPS)


def _nearer(problem: PackingProblem, shifts: FloatArray, aims: FloatArray, steps: int) -> FloatArray:
    prices = np.where(problem.broken(shifts), RELEASED, HARD)
    return _better(problem, shifts, project(problem, shifts, aims, steps, prices))


def _better(problem: PackingProblem, shifts: FloatArray, other: tuple[FloatArray, bool]) -> FloatArray:
    """Returns the other shifts if they are without overlap and break no more relations, else the first ones."""
    moved, is_separated = other
    is_better = (
        is_separated and is_free_of_overlap(problem, moved) and problem.broken(moved).sum() <= problem.broken(shifts).sum()
    )
    return moved if is_better else shifts
