"""Parts bodies while they are small, and again as they grow: they push each other on rather than through each other."""

import numpy as np

from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import HARD, ConstraintForces, project
from stable_data.scene import FloatArray

RELEASED = 0.1
"""Price of a metre by which a directional relation is broken that has been given up."""

_SHARES = np.append(np.arange(0.5, 1.0, 0.05), 1.0)  # of its size that a body grows through
_SOFTER = (1.0, 0.3, 0.1)  # what relations cost while those that have to give way are looked for
_STEPS = 16


def inflate_bodies(crowd: PackingProblem, shifts: FloatArray, aims: FloatArray, steps: int) -> tuple[FloatArray, bool]:
    """Parts a crowd. Directional relations that are in the way of that are given up one by one, the others stay dear.

    Args:
        crowd: The bodies.
        shifts: Where they are, (B, 2), metres.
        aims: Where they want to be, (B, 2).
        steps: Steps at each size.

    Returns:
        The shifts, and whether the crowd is parted.
    """
    prices, is_parted, forces = np.full(len(crowd.orders), HARD), False, ConstraintForces.none(crowd)
    for share in _SHARES:
        smaller = crowd.shrunk(share)
        shifts, is_parted = project(smaller, shifts, aims, steps, prices, forces)
        for price in _SOFTER:
            if is_parted:
                break
            shifts, is_parted = project(smaller, shifts, aims, steps, np.minimum(prices, price), forces)
            prices[crowd.broken(shifts)] = RELEASED
    if not is_parted:
        shifts, is_parted = project(crowd, shifts, shifts, _STEPS, prices)
    return shifts, is_parted
