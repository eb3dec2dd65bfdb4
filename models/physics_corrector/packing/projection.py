"""Regularised projection: the least movement that parts a crowd, where each pair goes apart across one line.

Each step fixes, for every pair of slabs that is near, the half-plane of its no-fit polygon that it is beyond or nearest to, and
solves the convex problem that remains: weighted squared distance from the aims, every broken half-plane and every directional
relation at a price per metre. A half-plane is part of the free region, so what a step finds free stays free in the next.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from models.physics_corrector.packing.packing_problem import PackingProblem
from stable_data.scene import FloatArray, IntArray

HARD = 3.0
"""Price of a constraint that is to hold, in metres of stiff movement."""

FREE = 1e-4
"""A crowd is parted where no overlap with the clearance added is more than this, metres."""

_NEAR = 0.08  # pairs farther apart than this are left out of a step, metres
_MARGIN = 2e-4  # by which a directional relation is kept, metres
_EASE = 2e-4  # keeps the dual strictly concave: metres of violation per unit of price
_GRADIENT_STEPS, _NEWTON_STEPS, _HALVINGS = 60, 25, 20
_EXACT = 1e-5
_DEAR = 1.0  # relations that cost more decide which way bodies part
_ALONG = 0.35  # cosine between a way out and a directional relation that it serves


@dataclass(slots=True)
class ConstraintForces:
    """What the constraints push with, kept from one step to the next as a start: most of them change little.

    Attributes:
        pairs: Of each pair of slabs, (E,).
        orders: Of both half-planes of each directional relation, (2K,).
        edges: Of the edges of the table on each body, (4B,).
    """

    pairs: FloatArray
    orders: FloatArray
    edges: FloatArray

    @classmethod
    def none(cls, crowd: PackingProblem) -> "ConstraintForces":
        """None on any body of a crowd."""
        return cls(np.zeros(len(crowd.first)), np.zeros(2 * len(crowd.orders)), np.zeros(4 * len(crowd.stiffness)))


def project(
    crowd: PackingProblem,
    shifts: FloatArray,
    aims: FloatArray,
    steps: int,
    order_price: float | FloatArray = HARD,
    forces: ConstraintForces | None = None,
) -> tuple[FloatArray, bool]:
    """Moves bodies apart.

    Args:
        crowd: The bodies.
        shifts: Where they are, (B, 2), metres.
        aims: Where they want to be, (B, 2).
        steps: Steps at most.
        order_price: Price of a metre by which a directional relation is broken, of all or of each, (K,).
        forces: A start, changed to where it ends.

    Returns:
        The shifts, (B, 2), and whether the crowd is parted.
    """
    best, is_parted = shifts, False
    forces = forces or ConstraintForces.none(crowd)
    prices = np.broadcast_to(np.asarray(order_price, float), len(crowd.orders))
    near, beyond = crowd.near(shifts, _NEAR)
    for _ in range(steps):
        moved = _step(crowd, shifts, near, beyond, aims, prices, forces)
        change = float(np.abs(moved - shifts).max(initial=0.0))
        shifts = moved
        near, beyond = crowd.near(shifts, _NEAR)
        overlap = -float(beyond.max(axis=1, initial=-np.inf).min(initial=0.0))
        is_free = overlap <= FREE and float(crowd.outside(shifts).max(initial=0.0)) <= FREE
        if is_free or not is_parted:
            best = shifts
        is_parted = is_parted or is_free
        if change < 2e-4:
            break
    return best, is_parted


def is_free_of_overlap(crowd: PackingProblem, shifts: FloatArray) -> bool:
    """Does nothing of a crowd meet, and is all of it where it is allowed?"""
    return bool(crowd.overlap(shifts).max(initial=0.0) <= FREE and crowd.outside(shifts).max(initial=0.0) <= FREE)


def _step(
    crowd: PackingProblem,
    shifts: FloatArray,
    near: IntArray,
    beyond: FloatArray,
    aims: FloatArray,
    order_prices: FloatArray,
    forces: ConstraintForces,
) -> FloatArray:
    rows, bounds = _planes(crowd, near, beyond, order_prices)
    sides, edge_rows, edge_bounds = _edges(crowd, shifts)
    kept = np.flatnonzero(np.tile(order_prices > 0, 2))
    order_rows, order_bounds = crowd.order_planes()
    of, to = (np.tile(x, 2)[kept] for x in (crowd.subjects, crowd.targets))
    first = np.concatenate([crowd.first_body[near], of, sides % len(crowd.stiffness)])
    second = np.concatenate([crowd.second_body[near], to, np.full(len(sides), -1)])
    rows = np.concatenate([rows, order_rows[kept], edge_rows])
    bounds = np.concatenate([bounds, order_bounds[kept] + _MARGIN, edge_bounds])
    prices = np.concatenate([np.full(len(near), HARD), np.tile(order_prices, 2)[kept], np.full(len(sides), 4 * HARD)])
    start = np.concatenate([forces.pairs[near], forces.orders[kept], forces.edges[sides]])
    moved, force = _solved(crowd, first, second, rows, bounds, prices, aims, start)
    pushes = np.split(force, [len(near), len(near) + len(kept)])
    for all_of_a_kind, where, push in zip(
        (forces.pairs, forces.orders, forces.edges), (near, kept, sides), pushes, strict=True
    ):
        all_of_a_kind[:] = 0.0
        all_of_a_kind[where] = push
    return moved


def _planes(
    crowd: PackingProblem, near: IntArray, beyond: FloatArray, order_prices: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One half-plane for each near pair of slabs: normals (N, 2), bounds (N,)."""
    chosen = beyond.argmax(axis=1)
    overlapping = np.flatnonzero(np.take_along_axis(beyond, chosen[:, None], axis=1)[:, 0] < 0)
    wanted = _wanted_axes(crowd, order_prices)
    groups: dict[tuple[int, int], list[int]] = {}
    for n, i, j in zip(
        overlapping.tolist(), crowd.first[near[overlapping]].tolist(), crowd.second[near[overlapping]].tolist(), strict=True
    ):
        groups.setdefault((i, j), []).append(n)
    for entries in groups.values():
        e = near[entries[0]]
        axis = wanted.get((int(crowd.first_body[e]), int(crowd.second_body[e])))
        if len(entries) > 1 or axis is not None:
            chosen[entries] = _way_out(crowd.normals[near[entries]], -beyond[entries], axis)
    normals = crowd.normals[near, chosen]
    return normals, crowd.offsets[near, chosen] - (normals * crowd.apart[near]).sum(axis=1)


def _way_out(normals: FloatArray, cost: FloatArray, axis: FloatArray | None) -> IntArray:
    """One direction for all slabs of two parts that overlap, along their directional relation where they have one.

    Args:
        normals: Of the half-planes of each pair of slabs, (S, 2M, 2).
        cost: How deep each is in them, (S, 2M), metres.
        axis: The direction, (2,).

    Returns:
        The half-plane by which each leaves, (S,).
    """
    if len(normals) > 1:
        # Along each of the normals: how far the slab that is deepest along it has to go.
        flat = normals.reshape(-1, 2)
        share = (flat @ flat.T).reshape(len(flat), len(normals), -1)
        pick = share.argmax(axis=2)  # each slab leaves by its own half-plane that is nearest in direction
        deep = cost[np.arange(len(normals)), pick]
        total = deep.max(axis=1) + 0.02 * (1 - share.max(axis=2).min(axis=1))
    else:
        flat, pick, total = normals[0], np.arange(normals.shape[1])[:, None], cost[0]
    if axis is not None:
        total = total + np.where(flat @ axis < _ALONG, 1.0, 0.0)
    return np.asarray(pick[int(total.argmin())])


def _wanted_axes(crowd: PackingProblem, order_prices: FloatArray) -> dict[tuple[int, int], FloatArray]:
    """For pairs of bodies with a directional relation that is dear: where the first is, seen from the second."""
    axes: dict[tuple[int, int], FloatArray] = {}
    for k in np.flatnonzero(order_prices > _DEAR).tolist():
        o = crowd.orders[k]
        axes[o.first, o.second] = o.axis
        axes[o.second, o.first] = -o.axis
    return axes


def _edges(crowd: PackingProblem, shifts: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """The edges of the table that bodies are near: numbers of side and body, half-planes, bounds."""
    num = len(crowd.stiffness)
    sides: list[IntArray] = []
    rows, bounds = [], []
    for axis in (0, 1):
        unit = np.zeros(2)
        unit[axis] = 1.0
        for sign, bound in ((1.0, crowd.low[:, axis]), (-1.0, -crowd.high[:, axis])):
            near = np.nonzero(crowd.is_free & (sign * shifts[:, axis] - bound < _NEAR))[0]
            sides.append(near + num * len(sides))
            rows.append(np.repeat(sign * unit[None], len(near), axis=0))
            bounds.append(bound[near])
    return np.concatenate(sides), np.concatenate(rows), np.concatenate(bounds)


def _solved(
    crowd: PackingProblem,
    first: IntArray,
    second: IntArray,
    rows: FloatArray,
    bounds: FloatArray,
    prices: FloatArray,
    aims: FloatArray,
    start: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Least weighted squared distance from the aims with ``row · (first − second) >= bound`` at a price, and the forces."""
    num, index = len(crowd.stiffness), np.arange(len(rows))
    inverse = np.where(crowd.is_free, 1 / np.sqrt(crowd.stiffness), 0.0)  # what cannot move is where it is
    matrix = np.zeros((len(rows), num + 1, 2))  # the last column takes what has no second body
    matrix[index, first] = rows * inverse[first, None]
    matrix[index, second] -= rows * np.append(inverse, 0.0)[second, None]
    free = np.flatnonzero(crowd.is_free)
    flat = matrix[:, free].reshape(len(rows), 2 * len(free))
    wanted = np.append(aims, np.zeros((1, 2)), axis=0)
    needed = bounds - ((wanted[first] - wanted[second]) * rows).sum(axis=1)
    force = box_dual(flat, needed, prices, start)
    moved = aims.copy()
    moved[free] += (force @ flat).reshape(-1, 2) * inverse[free, None]
    return moved, force


def box_dual(matrix: FloatArray, linear: FloatArray, upper: FloatArray, start: FloatArray) -> FloatArray:
    """Minimises ``½ |A'x|² − b'x`` over ``0 <= x <= upper`` by projected Newton steps (Bertsekas 1982).

    Args:
        matrix: A, (M, N).
        linear: b, (M,).
        upper: (M,).
        start: Where to begin, (M,).

    Returns:
        x, (M,).
    """
    x = _descended(matrix, linear, upper, start)
    push = x @ matrix
    gradient = matrix @ push + _EASE * x - linear
    value = 0.5 * float(push @ push + _EASE * (x @ x)) - float(linear @ x)
    for _ in range(_NEWTON_STEPS):
        held = ((x <= 0) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        free = np.flatnonzero(~held)
        if not len(free) or np.abs(gradient[free]).max() < _EXACT:
            break
        step = _newton_step(matrix[free], -gradient[free])
        length, trial = 1.0, x.copy()
        for _ in range(_HALVINGS):
            trial[free] = np.minimum(np.maximum(x[free] + length * step, 0.0), upper[free])
            push = trial @ matrix
            if (new := 0.5 * float(push @ push + _EASE * (trial @ trial)) - float(linear @ trial)) < value - 1e-14:
                break
            length /= 2
        else:
            break
        x, value, gradient = trial, new, matrix @ push + _EASE * trial - linear
    return x


def _newton_step(matrix: FloatArray, residual: FloatArray) -> FloatArray:
    """Solves ``(AA' + ease) x = r`` in the smaller of the two dimensions of A, (M, N)."""
    if len(matrix) <= matrix.shape[1]:
        square = matrix @ matrix.T
        square.flat[:: len(square) + 1] += _EASE
        return np.asarray(dposv(square, residual)[1])
    square = matrix.T @ matrix
    square.flat[:: len(square) + 1] += _EASE
    return np.asarray((residual - matrix @ dposv(square, residual @ matrix)[1]) / _EASE)


def _descended(matrix: FloatArray, linear: FloatArray, upper: FloatArray, start: FloatArray) -> FloatArray:
    """A start for the Newton steps, by accelerated projected gradients (Beck and Teboulle 2009), restarted where they overshoot."""
    size = np.abs(matrix)
    rate = 1 / (size @ size.sum(axis=0) + _EASE)  # the rows' sums bound the quadratic form from above
    x = ahead = np.minimum(start, upper)
    momentum = 1.0
    for _ in range(_GRADIENT_STEPS):
        gradient = matrix @ (ahead @ matrix) + _EASE * ahead - linear
        new = np.minimum(np.maximum(ahead - rate * gradient, 0.0), upper)
        change = new - x
        if np.abs(change).max(initial=0.0) < _EXACT:
            return np.asarray(new)
        if gradient @ change > 0:
            momentum, ahead = 1.0, new
        else:
            grown = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
            ahead, momentum = new + (momentum - 1) / grown * change, grown
        x = new
    return x
