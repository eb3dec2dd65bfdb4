"""Separates bodies: by projection, else by growth, else without some bodies; then restores broken relations."""

from collections.abc import Sequence

import numpy as np

from models.physics_corrector.packing.inflation import inflate_bodies
from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import project
from models.physics_corrector.packing.relation_recovery import polish_layout, recover_relations
from models.physics_corrector.packing.subset_packing import pack_subset
from stable_data.scene import FloatArray

_STEPS = 16
_GROWTH_STEPS = (3, 6)  # steps at each size; the second number if the first does not separate the bodies


def separate_bodies(
    problem: PackingProblem, aims: FloatArray, spare: Sequence[int], tries: int
) -> tuple[FloatArray, list[int]] | None:
    """Finds shifts without overlap, near the aims, with as many directional relations preserved as possible.

    Args:
        problem: The bodies.
        aims: Their wanted shifts, (B, 2), metres.
        spare: Bodies that may be left out if there is not a place for all, the least important first.
        tries: How many times a body may be relocated to restore a directional relation.

    Returns:
        The shifts, (B, 2), and the bodies that are left out; None if no such shifts were found.
    """
    here, out = np.zeros_like(aims), list[int]()
    separated = []
    found, is_separated = project(problem, here, aims, _STEPS)
    if is_separated:
        separated.append(polish_layout(problem, found, aims))
    if not separated or problem.broken(separated[0]).sum() > problem.broken(here).sum():
        for steps in _GROWTH_STEPS:
            found, is_separated = inflate_bodies(problem, here, aims, steps)
            if is_separated:
                separated.append(polish_layout(problem, found, aims))
                break
    if not separated:
        fit = pack_subset(problem, aims, spare)
        if fit is None:
            return None
        found, out = fit
        problem = problem.without(out)
        separated.append(polish_layout(problem, found, aims))
    best = min(separated, key=lambda shifts: int(problem.broken(shifts).sum()))
    return recover_relations(problem, best, aims, tries), out
