"""Packs as many bodies as possible: some are left out and put back where the others leave or make room."""

from collections.abc import Sequence

import numpy as np

from models.physics_corrector.packing.grid_search import least_blocked_place
from models.physics_corrector.packing.inflation import RELEASED, inflate_bodies
from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import project
from stable_data.scene import FloatArray

_STEPS = 16
_GROWTH_STEPS = 3  # at each size
# Places at which a body that was left out is tried again: the most and the fewest, so that all bodies together have about _TRIES.
_PLACES, _FEWEST_PLACES, _TRIES = 8, 2, 160
_ROUNDS = 2  # rounds in which all of these are tried
_NEIGHBOUR, _RINGS = 0.03, 4  # distance of neighbours, metres; rings of them that make room for a body that is put back
_SHARES = (0.2, 0.4, 0.6)  # shares of the bodies that are left out at first


def pack_subset(problem: PackingProblem, aims: FloatArray, spare: Sequence[int]) -> tuple[FloatArray, list[int]] | None:
    """Finds shifts without overlap with as few bodies as possible left out.

    Large bodies are placed first and small ones into the remaining space. If some have no place, the result is compared with
    leaving out other bodies of ``spare``, which may be larger and make room for many.

    Args:
        problem: The bodies.
        aims: Their wanted shifts, (B, 2), metres.
        spare: Bodies that may be left out, the least important first.

    Returns:
        The shifts, and the bodies that are left out; None if even without all of ``spare`` no shifts were found.
    """
    free = np.flatnonzero(problem.is_free)
    smallest = sorted(free.tolist(), key=lambda k: -_room(problem, k))
    best: tuple[FloatArray, list[int]] | None = None
    for share in _SHARES:
        found = _without(problem, aims, smallest[: max(1, int(share * len(smallest)))])
        if found is not None and set(found[1]) <= set(spare) and (best is None or len(found[1]) < len(best[1])):
            best = found
        if best is not None and not best[1]:
            return best
    many = 1
    while spare and (best is None or many < len(best[1])):
        found = _without(problem, aims, spare[:many])
        if found is not None:
            return found if best is None or len(found[1]) < len(best[1]) else best
        if many >= len(spare):
            break
        many = min(2 * many, len(spare))
    return best


def _without(problem: PackingProblem, aims: FloatArray, out: Sequence[int]) -> tuple[FloatArray, list[int]] | None:
    """Separates the bodies without some of them, then puts back those for which there is room."""
    shifts, is_separated = inflate_bodies(problem.without(out), np.zeros_like(aims), aims, _GROWTH_STEPS)
    return _put_back(problem, aims, shifts, list(out)) if is_separated else None


def _put_back(problem: PackingProblem, aims: FloatArray, shifts: FloatArray, out: list[int]) -> tuple[FloatArray, list[int]]:
    """Puts bodies that were left out at free places or where others make room, the largest first."""
    for _ in range(_ROUNDS):
        before, places = len(out), max(_FEWEST_PLACES, min(_PLACES, _TRIES // max(1, len(out))))
        for k in sorted(out, key=lambda k: _room(problem, k)):
            others = problem.without([b for b in out if b != k])
            for place in least_blocked_place(others, shifts, aims, k, places):
                there = shifts.copy()
                there[k] = place
                around = others.around(k, there, _NEIGHBOUR, _RINGS)
                moved, is_separated = project(around, there, there, _STEPS, RELEASED)
                if is_separated:
                    shifts, out = moved, [b for b in out if b != k]
                    break
        if not out or len(out) == before:
            break
    return shifts, out


def _room(problem: PackingProblem, k: int) -> float:
    """Returns the area over which a body may shift, square metres: small for a large body."""
    return float(np.prod(problem.high[k] - problem.low[k]))
