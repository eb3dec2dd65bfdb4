"""Where a body that is in the way could stand instead: the table looked at on a grid, against all no-fit polygons at once."""

import numpy as np

from models.physics_corrector.packing.packing_problem import PackingProblem
from stable_data.scene import FloatArray

_SPACING, _MOST = 0.01, 90  # between places that are tried, metres; and how many a side
_NEAREST = 2000  # of those are looked at
_SPREAD = 0.05  # between two places that are handed back, metres
_IMMOVABLE = 5.0  # how much worse it is to be in something that cannot make room
_BROKEN = 0.01  # what a broken directional relation costs, metres of overlap
_PER_METRE = 0.02  # what a metre of movement costs, metres of overlap


def least_blocked_place(
    crowd: PackingProblem, shifts: FloatArray, aims: FloatArray, k: int, weights: FloatArray, num: int, order: int | None = None
) -> list[FloatArray]:
    """Shifts of one body at which it is least in the way of others, near to its aim and true to its relations.

    Args:
        crowd: The bodies.
        shifts: Where all are, (B, 2), metres.
        aims: Where they want to be, (B, 2).
        k: The body.
        weights: How much an overlap of each pair of bodies counts, (B, B).
        num: How many are wanted.
        order: A directional relation that has to hold there.

    Returns:
        At most so many shifts (2,), best first, apart from each other.
    """
    low, high = crowd.low[k], crowd.high[k]
    if (low > high).any():
        return []
    counts = np.minimum(np.ceil((high - low) / _SPACING).astype(int) + 1, _MOST)
    grids = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    points = np.stack(np.meshgrid(*grids, indexing="ij"), axis=2).reshape(-1, 2)
    points = np.concatenate([np.clip(aims[k], low, high)[None], np.clip(shifts[k], low, high)[None], points])
    broken = np.zeros(len(points))
    for n, o in enumerate(crowd.orders):
        if k in (o.first, o.second):
            apart = o.offset + (points - shifts[o.second] if o.first == k else shifts[o.first] - points)
            broken[apart @ o.axis <= np.abs(apart @ o.axis[::-1])] += np.inf if n == order else 1.0
    far = np.linalg.norm(points - aims[k], axis=1)
    nearest = np.argsort(np.where(np.isinf(broken), np.inf, far), kind="stable")[
        : min(_NEAREST, int(np.isfinite(broken).sum()))
    ]
    points, broken, far = points[nearest], broken[nearest], far[nearest]
    cost = _PER_METRE * far + _BROKEN * broken + _overlap_at(crowd, shifts, k, points, weights)
    found: list[FloatArray] = []
    left = np.argsort(cost, kind="stable")
    while len(left) and len(found) < num:
        best = points[left[0]]
        found.append(best)
        left = left[np.linalg.norm(points[left] - best, axis=1) > _SPREAD]
    return found


def _overlap_at(crowd: PackingProblem, shifts: FloatArray, k: int, points: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted sum of how deep a body would be in each other one, (P,) metres, at shifts (P, 2)."""
    depth = np.zeros((len(crowd.stiffness), len(points)))
    for e in np.nonzero((crowd.first_body == k) | (crowd.second_body == k))[0]:
        is_first = crowd.first_body[e] == k
        other = crowd.second_body[e] if is_first else crowd.first_body[e]
        offset = crowd.apart[e] if is_first else -crowd.apart[e]
        normals = crowd.normals[e] if is_first else -crowd.normals[e]
        apart = points + (offset - shifts[other])
        offsets = crowd.offsets[e]
        close = np.nonzero((apart @ normals[::7].T < offsets[::7]).all(axis=1))[0]
        if len(close):
            deep = (offsets - apart[close] @ normals.T).min(axis=1)
            depth[other, close] = np.maximum(depth[other, close], deep)
    return np.asarray((weights[k] * np.where(crowd.is_free, 1.0, _IMMOVABLE)) @ depth)
