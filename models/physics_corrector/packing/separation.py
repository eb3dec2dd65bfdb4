"""Parts a crowd: projection first, then growth, then by leaving bodies out and putting them back; at last what was lost is repaired."""

from collections.abc import Sequence

import numpy as np

from models.physics_corrector.packing.inflation import inflate_bodies
from models.physics_corrector.packing.packing_problem import PackingProblem
from models.physics_corrector.packing.projection import project
from models.physics_corrector.packing.relation_recovery import polish_layout, recover_relations
from models.physics_corrector.packing.subset_packing import pack_subset
from stable_data.scene import FloatArray

_STEPS = 16
_GROWTH_STEPS = (3, 6)  # at each size, until it parts


def separate_bodies(
    crowd: PackingProblem, aims: FloatArray, spare: Sequence[int], tries: int
) -> tuple[FloatArray, list[int]] | None:
    """Finds shifts at which nothing meets, near the aims and true to the directional relations as far as that goes.

    Args:
        crowd: The bodies.
        aims: Where they want to be, (B, 2), metres.
        spare: Bodies that may be left out where not all find a place, those that should go first, first.
        tries: How many times a body may be put elsewhere to mend what parting has lost.

    Returns:
        The shifts, (B, 2), and the bodies that have to be left out; None where not even that does.
    """
    here, out = np.zeros_like(aims), list[int]()
    parted = []
    found, is_parted = project(crowd, here, aims, _STEPS)
    if is_parted:
        parted.append(polish_layout(crowd, found, aims))
    if not parted or crowd.broken(parted[0]).sum() > crowd.broken(here).sum():
        for steps in _GROWTH_STEPS:
            found, is_parted = inflate_bodies(crowd, here, aims, steps)
            if is_parted:
                parted.append(polish_layout(crowd, found, aims))
                break
    if not parted:
        fit = pack_subset(crowd, aims, spare)
        if fit is None:
            return None
        found, out = fit
        crowd = crowd.without(out)
        parted.append(polish_layout(crowd, found, aims))
    best = min(parted, key=lambda shifts: int(crowd.broken(shifts).sum()))
    return recover_relations(crowd, best, aims, tries), out
