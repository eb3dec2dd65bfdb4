"""Separates bodies at a small size and again as they grow, so that they push each other aside and do not pass through."""

import numpy as np

from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import HARD, ConstraintForces, project
from stable_data.scene import FloatArray

RELEASED = 0.1
"""Price of a metre by which a released directional relation is broken."""

_SHARES = np.append(np.arange(0.5, 1.0, 0.05), 1.0)  # sizes of a growing body, shares of its full size
_SOFTER = (1.0, 0.3, 0.1)  # prices of relations in the search for those to release
_STEPS = 16


def inflate_bodies(problem: PackingProblem, shifts: FloatArray, aims: FloatArray, steps: int) -> tuple[FloatArray, bool]:
    """Separates bodies by growth. Relations that prevent this are released one by one; the others keep their price.

    Args:
        problem: The bodies.
        shifts: Their shifts, (B, 2), metres.
        aims: Their wanted shifts, (B, 2).
        steps: Steps at each size.

    Returns:
        The shifts, and whether the bodies are separated.
    """
    prices, is_separated, forces = np.full(len(problem.orders), HARD), False, ConstraintForces.none(problem)
    for share in _SHARES:
        smaller = problem.shrunk(share)
        shifts, is_separated = project(smaller, shifts, aims, steps, prices, forces)
        for price in _SOFTER:
            if is_separated:
                break
            shifts, is_separated = project(smaller, shifts, aims, steps, np.minimum(prices, price), forces)
            prices[problem.broken(shifts)] = RELEASED
    if not is_separated:  # a last attempt without the pull to the aims
        shifts, is_separated = project(problem, shifts, shifts, _STEPS, prices)
    return shifts, is_separated
