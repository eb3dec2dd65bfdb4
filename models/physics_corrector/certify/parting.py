"""Parts a crowd: projection first, then bodies that are stuck are put elsewhere while the others make room."""

import numpy as np

from models.physics_corrector.certify.crowd import Crowd
from models.physics_corrector.certify.projection import HARD, Forces, is_free_of_overlap, project
from models.physics_corrector.certify.search import least_blocked
from stable_data.scene import FloatArray

_STEPS = 16
_SQUEEZE_STEPS = 7
_SHARES = np.append(np.arange(0.3, 1.0, 0.05), 1.0)  # of its size that a body grows through
_GROWTH_STEPS = (3, 6)  # at each of them, in the attempts that are made
_PRICES = (1.0, 0.3, 0.1)  # of a metre by which a directional relation is broken, once not all can be had
_PLACES = 3  # that are tried for a body
RELEASED = 0.1
_REPAIRS = 60
_PATIENCE = 8  # tries that gain nothing before it is given up


def part(crowd: Crowd, shifts: FloatArray, aims: FloatArray, tries: int) -> tuple[FloatArray, list[int]]:
    """Finds shifts at which nothing meets, near the aims and true to the directional relations as far as that goes.

    Args:
        crowd: The bodies.
        shifts: Where they are, (B, 2), metres.
        aims: Where they want to be, (B, 2).
        tries: How many times a body may be put elsewhere.

    Returns:
        The shifts, and the bodies that are still in the way; none where the crowd is parted.
    """
    found, is_parted = project(crowd, shifts, aims, _STEPS)
    parted, stuck = ([_polished(crowd, found, aims)] if is_parted else []), []
    lost_before = crowd.broken(shifts).sum()
    for steps in _GROWTH_STEPS:
        if parted and min(crowd.broken(s).sum() for s in parted) <= lost_before:
            break
        found, is_parted = _grown(crowd, shifts, aims, steps)
        if is_parted:
            parted.append(_polished(crowd, found, aims))
        else:
            stuck.append(found)
    for start in () if parted else tuple(stuck):
        found, is_parted = _squeezed(crowd, start, aims, tries)
        if is_parted:
            return _polished(crowd, found, aims), []
    if not parted:
        return found, in_the_way(crowd, found)
    return _repaired(crowd, min(parted, key=lambda s: int(crowd.broken(s).sum())), aims), []


def _grown(crowd: Crowd, shifts: FloatArray, aims: FloatArray, steps: int) -> tuple[FloatArray, bool]:
    """Parts the bodies while they are small, and again as they grow: they push each other on rather than through each other.

    Directional relations get cheaper once they cannot all be had.
    """
    prices, is_parted, forces = np.full(len(crowd.orders), HARD), False, Forces.none(crowd)
    for share in _SHARES:
        smaller = crowd.shrunk(share)
        shifts, is_parted = project(smaller, shifts, aims, steps, prices, forces)
        for price in _PRICES:
            if is_parted:
                break
            softer = np.minimum(prices, price)
            shifts, is_parted = project(smaller, shifts, aims, steps, softer, forces)
            prices[crowd.broken(shifts)] = RELEASED
    if not is_parted:
        shifts, is_parted = project(crowd, shifts, shifts, _STEPS, prices)
    return shifts, is_parted


def in_the_way(crowd: Crowd, shifts: FloatArray) -> list[int]:
    """Free bodies that meet another one or are where they must not be."""
    depth = crowd.depths(shifts).sum(axis=1) + crowd.outside(shifts)
    return [int(k) for k in np.nonzero((depth > 1e-4) & crowd.is_free)[0]]


def _squeezed(crowd: Crowd, shifts: FloatArray, aims: FloatArray, tries: int) -> tuple[FloatArray, bool]:
    """Puts the body that is deepest in others where it is least in the way, and lets all make room, again and again.

    Pairs that stay in each other weigh more with each try (guided local search), so that it does not go round in circles.
    """
    weights = np.ones((len(shifts), len(shifts)))
    best, least, idle = shifts, _badness(crowd, shifts), 0
    for _ in range(tries):
        depth = crowd.depths(shifts)
        weighted = (weights * depth).sum(axis=1) + crowd.outside(shifts)
        weighted[~crowd.is_free] = 0.0
        k = int(weighted.argmax())
        if weighted[k] <= 1e-4 or idle > _PATIENCE:
            break
        candidates = []
        for place in least_blocked(crowd, shifts, aims, k, weights, _PLACES):
            there = shifts.copy()
            there[k] = place
            moved, is_parted = project(crowd, there, there, _SQUEEZE_STEPS, _PRICES[0])
            if is_parted:
                return moved, True
            candidates.append((float((weights * crowd.depths(moved)).sum()) + _badness(crowd, moved), moved))
        if not candidates:
            break
        shifts = min(candidates, key=lambda c: c[0])[1]
        weights += np.minimum(crowd.depths(shifts) / 0.01, 1.0)
        bad = _badness(crowd, shifts)
        idle = 0 if bad < least - 1e-4 else idle + 1
        if bad < least:
            best, least = shifts, bad
    moved, is_parted = project(crowd, best, best, _STEPS, 0.0)
    return (moved, True) if is_parted else (best, False)


def _badness(crowd: Crowd, shifts: FloatArray) -> float:
    return float(crowd.depths(shifts).sum() / 2 + crowd.outside(shifts).sum())


def _polished(crowd: Crowd, shifts: FloatArray, aims: FloatArray) -> FloatArray:
    """From shifts at which nothing meets: back to the relations that were given up, then nearer to the aims."""
    if crowd.broken(shifts).sum():
        for price in (HARD, *_PRICES):
            shifts = _better(crowd, shifts, project(crowd, shifts, shifts, _SQUEEZE_STEPS, price))
    price = _PRICES[0] if crowd.broken(shifts).sum() else HARD
    return _better(crowd, shifts, project(crowd, shifts, aims, _STEPS, price))


def _repaired(crowd: Crowd, shifts: FloatArray, aims: FloatArray) -> FloatArray:
    """Puts bodies of broken directional relations where those hold, and the others make room, while that gains."""
    best, tried = shifts, set()
    even = np.ones((len(shifts), len(shifts)))
    for _ in range(_REPAIRS):
        broken = crowd.broken(best)
        waiting = [(int(n), int(k)) for n in np.flatnonzero(broken) for k in (crowd.subjects[n], crowd.targets[n]) if (n, k) not in tried and crowd.is_free[k]]
        if not waiting:
            break
        n, k = waiting[0]
        tried.add((n, k))
        prices = np.where(broken, 0.1, HARD)
        prices[n] = HARD
        found = None
        for place in least_blocked(crowd, best, aims, k, even, _PLACES, n):
            there = best.copy()
            there[k] = place
            moved, is_parted = project(crowd, there, there, _SQUEEZE_STEPS, prices)
            if is_parted and crowd.broken(moved).sum() < broken.sum():
                found = moved
                break
        if found is not None:
            best = _better(crowd, found, project(crowd, found, aims, _SQUEEZE_STEPS, np.where(crowd.broken(found), 0.1, HARD)))
            tried.clear()
    return best


def _better(crowd: Crowd, shifts: FloatArray, other: tuple[FloatArray, bool]) -> FloatArray:
    """Other shifts where they part the crowd and break no more relations, else these."""
    moved, is_parted = other
    good = is_parted and is_free_of_overlap(crowd, moved) and crowd.broken(moved).sum() <= crowd.broken(shifts).sum()
    return moved if good else shifts
