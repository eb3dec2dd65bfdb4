"""Grid search for another place of a body: all no-fit polygons are evaluated on a grid over the table."""

import numpy as np

from models.physics_corrector.packing.packing_problem import PackingProblem
from stable_data.scene import FloatArray

# Tuned on: not recorded, for all values below.
_SPACING, _MOST = 0.01, 90  # distance of grid points, metres; their largest number a side
_NEAREST = 2000  # the grid points nearest to the aim that are evaluated
_SPREAD = 0.05  # least distance of two places that are returned, metres
_IMMOVABLE = 5.0  # weight of an overlap with a body that cannot make room
_BROKEN = 0.01  # cost of a broken directional relation, metres of overlap
_PER_METRE = 0.02  # cost of a metre of movement, metres of overlap


def least_blocked_place(
    problem: PackingProblem, shifts: FloatArray, aims: FloatArray, k: int, num: int, order: int | None = None
) -> list[FloatArray]:
    """Finds shifts of one body with little overlap, near its aim, and with its relations preserved.

    Args:
        problem: The bodies.
        shifts: Shifts of all bodies, (B, 2), metres.
        aims: Their wanted shifts, (B, 2).
        k: The body.
        num: Number of shifts to return at most.
        order: A directional relation that must hold.

    Returns:
        Shifts (2,), best first, at a distance from each other.
    """
    low, high = problem.low[k], problem.high[k]
    if (low > high).any():
        return []
    counts = np.minimum(np.ceil((high - low) / _SPACING).astype(int) + 1, _MOST)
    grids = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    points = np.stack(np.meshgrid(*grids, indexing="ij"), axis=2).reshape(-1, 2)
    points = np.concatenate([np.clip(aims[k], low, high)[None], np.clip(shifts[k], low, high)[None], points])
    broken = np.zeros(len(points))
    for n, o in enumerate(problem.orders):
        if k in (o.first, o.second):
            apart = o.offset + (points - shifts[o.second] if o.first == k else shifts[o.first] - points)
            broken[apart @ o.axis <= np.abs(apart @ o.axis[::-1])] += np.inf if n == order else 1.0
    far = np.linalg.norm(points - aims[k], axis=1)
    nearest = np.argsort(np.where(np.isinf(broken), np.inf, far), kind="stable")[
        : min(_NEAREST, int(np.isfinite(broken).sum()))
    ]
    points, broken, far = points[nearest], broken[nearest], far[nearest]
    cost = _PER_METRE * far + _BROKEN * broken + _overlap_at(problem, shifts, k, points)
    found: list[FloatArray] = []
    left = np.argsort(cost, kind="stable")
    while len(left) and len(found) < num:
        best = points[left[0]]
        found.append(best)
        left = left[np.linalg.norm(points[left] - best, axis=1) > _SPREAD]
    return found


def _overlap_at(problem: PackingProblem, shifts: FloatArray, k: int, points: FloatArray) -> FloatArray:
    """Returns the weighted sum of the depths of a body in all others, (P,) metres, at shifts (P, 2)."""
    depth = np.zeros((len(problem.stiffness), len(points)))
    for e in np.nonzero((problem.first_body == k) | (problem.second_body == k))[0]:
        is_first = problem.first_body[e] == k
        other = problem.second_body[e] if is_first else problem.first_body[e]
        offset = problem.apart[e] if is_first else -problem.apart[e]
        normals = problem.normals[e] if is_first else -problem.normals[e]
        apart = points + (offset - shifts[other])
        offsets = problem.offsets[e]
        close = np.nonzero((apart @ normals[::7].T < offsets[::7]).all(axis=1))[0]
        if len(close):
            deep = (offsets - apart[close] @ normals.T).min(axis=1)
            depth[other, close] = np.maximum(depth[other, close], deep)
    return np.asarray(np.where(problem.is_free, 1.0, _IMMOVABLE) @ depth)
