"""Regularised projection: separates bodies with the least movement, each pair across one line.

Each step fixes, for every near pair of slabs, the half-plane of its no-fit polygon that it is beyond or nearest to. It then
solves the remaining convex problem: weighted squared distance from the aims, with a price per metre for every broken half-plane
and every broken directional relation. A half-plane is part of the free region, so a pair that is free stays free in the next step.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from models.physics_corrector.packing.packing_problem import PackingProblem
from stable_data.scene import FloatArray, IntArray

HARD = 3.0
"""Price of a constraint that should hold, in metres of stiff movement."""

FREE = 1e-4
"""Bodies are separated if no overlap, with the clearance added, is more than this, metres."""

_NEAR = 0.08  # pairs farther apart than this are left out of a step, metres
_MARGIN = 2e-4  # margin of a directional relation, metres
_EASE = 2e-4  # keeps the dual strictly concave: metres of violation per unit of price
# Newton steps: on a table that is too full, each step needs 20 and more until it is exact, but the next step of the projection sets
# another problem anyway.
_GRADIENT_STEPS, _NEWTON_STEPS, _HALVINGS = 60, 8, 20
_EXACT = 1e-5  # a gradient or a change below this ends the iterations
_DEAR = 1.0  # a relation of a higher price decides the direction in which its bodies separate
_ALONG = 0.35  # least cosine between that direction and the relation


@dataclass(slots=True)
class ConstraintForces:
    """Forces of the constraints. They change little from step to step, so each step starts from those of the last.

    Attributes:
        pairs: Force of each pair of slabs, (E,).
        orders: Forces of both half-planes of each directional relation, (2K,).
        edges: Forces of the table edges on each body, (4B,).
    """

    pairs: FloatArray
    orders: FloatArray
    edges: FloatArray

    @classmethod
    def none(cls, problem: PackingProblem) -> "ConstraintForces":
        """Returns zero forces."""
        return cls(np.zeros(len(problem.first)), np.zeros(2 * len(problem.orders)), np.zeros(4 * len(problem.stiffness)))


def project(
    problem: PackingProblem,
    shifts: FloatArray,
    aims: FloatArray,
    steps: int,
    order_price: float | FloatArray = HARD,
    forces: ConstraintForces | None = None,
) -> tuple[FloatArray, bool]:
    """Separates bodies.

    Args:
        problem: The bodies.
        shifts: Their shifts, (B, 2), metres.
        aims: Their wanted shifts, (B, 2).
        steps: Largest number of steps.
        order_price: Price of a metre by which a directional relation is broken, one for all or (K,).
        forces: Forces to start from; changed to the final ones.

    Returns:
        The shifts, (B, 2), and whether the bodies are separated.
    """
    best, is_separated = shifts, False
    forces = forces or ConstraintForces.none(problem)
    prices = np.broadcast_to(np.asarray(order_price, float), len(problem.orders))
    near, beyond = problem.near(shifts, _NEAR)
    for _ in range(steps):
        moved = _step(problem, shifts, near, beyond, aims, prices, forces)
        change = float(np.abs(moved - shifts).max(initial=0.0))
        shifts = moved
        near, beyond = problem.near(shifts, _NEAR)
        overlap = -float(beyond.max(axis=1, initial=-np.inf).min(initial=0.0))
        is_free = overlap <= FREE and float(problem.outside(shifts).max(initial=0.0)) <= FREE
        # Later steps move nearer to the aims and may overlap again: the last layout without overlap is the result.
        if is_free or not is_separated:
            best = shifts
        is_separated = is_separated or is_free
        if change < 2e-4:
            break
    return best, is_separated


def is_free_of_overlap(problem: PackingProblem, shifts: FloatArray) -> bool:
    """Whether no bodies overlap and all are within their bounds."""
    return bool(problem.overlap(shifts).max(initial=0.0) <= FREE and problem.outside(shifts).max(initial=0.0) <= FREE)


def _step(
    problem: PackingProblem,
    shifts: FloatArray,
    near: IntArray,
    beyond: FloatArray,
    aims: FloatArray,
    order_prices: FloatArray,
    forces: ConstraintForces,
) -> FloatArray:
    rows, bounds = _planes(problem, near, beyond, order_prices)
    sides, edge_rows, edge_bounds = _edges(problem, shifts)
    priced = np.flatnonzero(np.tile(order_prices > 0, 2))
    order_rows, order_bounds = problem.order_planes()
    of, to = (np.tile(x, 2)[priced] for x in (problem.subjects, problem.targets))
    first = np.concatenate([problem.first_body[near], of, sides % len(problem.stiffness)])
    second = np.concatenate([problem.second_body[near], to, np.full(len(sides), -1)])
    rows = np.concatenate([rows, order_rows[priced], edge_rows])
    bounds = np.concatenate([bounds, order_bounds[priced] + _MARGIN, edge_bounds])
    prices = np.concatenate([np.full(len(near), HARD), np.tile(order_prices, 2)[priced], np.full(len(sides), 4 * HARD)])
    start = np.concatenate([forces.pairs[near], forces.orders[priced], forces.edges[sides]])
    moved, force = _solve_step(problem, first, second, rows, bounds, prices, aims, start)
    pushes = np.split(force, [len(near), len(near) + len(priced)])
    for kind, where, push in zip((forces.pairs, forces.orders, forces.edges), (near, priced, sides), pushes, strict=True):
        kind[:] = 0.0
        kind[where] = push
    return moved


def _planes(
    problem: PackingProblem, near: IntArray, beyond: FloatArray, order_prices: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Chooses one half-plane for each near pair of slabs: normals (N, 2), bounds (N,)."""
    chosen = beyond.argmax(axis=1)
    overlapping = np.flatnonzero(np.take_along_axis(beyond, chosen[:, None], axis=1)[:, 0] < 0)
    wanted = _wanted_axes(problem, order_prices)
    groups: dict[tuple[int, int], list[int]] = {}
    for n, i, j in zip(
        overlapping.tolist(), problem.first[near[overlapping]].tolist(), problem.second[near[overlapping]].tolist(), strict=True
    ):
        groups.setdefault((i, j), []).append(n)
    for entries in groups.values():
        e = near[entries[0]]
        axis = wanted.get((int(problem.first_body[e]), int(problem.second_body[e])))
        if len(entries) > 1 or axis is not None:
            chosen[entries] = _common_direction(problem.normals[near[entries]], -beyond[entries], axis)
    normals = problem.normals[near, chosen]
    return normals, problem.offsets[near, chosen] - (normals * problem.apart[near]).sum(axis=1)


def _common_direction(normals: FloatArray, cost: FloatArray, axis: FloatArray | None) -> IntArray:
    """Chooses one direction for all pairs of slabs of two overlapping parts, along their directional relation if there is one.

    Args:
        normals: Normals of the half-planes of each pair of slabs, (S, 2M, 2).
        cost: Depth of each pair in its half-planes, (S, 2M), metres.
        axis: The direction, (2,).

    Returns:
        The chosen half-plane of each pair, (S,).
    """
    if len(normals) > 1:
        # The cost of each direction is the depth of the slab that is deepest along it.
        flat = normals.reshape(-1, 2)
        share = (flat @ flat.T).reshape(len(flat), len(normals), -1)
        pick = share.argmax(axis=2)  # for each slab its own half-plane nearest to that direction
        deep = cost[np.arange(len(normals)), pick]
        total = deep.max(axis=1) + 0.02 * (1 - share.max(axis=2).min(axis=1))
    else:
        flat, pick, total = normals[0], np.arange(normals.shape[1])[:, None], cost[0]
    if axis is not None:
        total = total + np.where(flat @ axis < _ALONG, 1.0, 0.0)
    return np.asarray(pick[int(total.argmin())])


def _wanted_axes(problem: PackingProblem, order_prices: FloatArray) -> dict[tuple[int, int], FloatArray]:
    """Returns pair of bodies -> direction from the second to the first, for directional relations of a high price."""
    axes: dict[tuple[int, int], FloatArray] = {}
    for k in np.flatnonzero(order_prices > _DEAR).tolist():
        o = problem.orders[k]
        axes[o.first, o.second] = o.axis
        axes[o.second, o.first] = -o.axis
    return axes


def _edges(problem: PackingProblem, shifts: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Returns the table edges near bodies: indices of side and body, half-planes, bounds."""
    num = len(problem.stiffness)
    sides: list[IntArray] = []
    rows, bounds = [], []
    for axis in (0, 1):
        unit = np.zeros(2)
        unit[axis] = 1.0
        for sign, bound in ((1.0, problem.low[:, axis]), (-1.0, -problem.high[:, axis])):
            near = np.nonzero(problem.is_free & (sign * shifts[:, axis] - bound < _NEAR))[0]
            sides.append(near + num * len(sides))
            rows.append(np.repeat(sign * unit[None], len(near), axis=0))
            bounds.append(bound[near])
    return np.concatenate(sides), np.concatenate(rows), np.concatenate(bounds)


def _solve_step(
    problem: PackingProblem,
    first: IntArray,
    second: IntArray,
    rows: FloatArray,
    bounds: FloatArray,
    prices: FloatArray,
    aims: FloatArray,
    start: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Minimises the weighted squared distance from the aims with ``row · (first − second) >= bound`` at a price; returns the forces too."""
    num, index = len(problem.stiffness), np.arange(len(rows))
    inverse = np.where(problem.is_free, 1 / np.sqrt(problem.stiffness), 0.0)  # zero for fixed bodies
    matrix = np.zeros((len(rows), num + 1, 2))  # the last column is for rows without a second body
    matrix[index, first] = rows * inverse[first, None]
    matrix[index, second] -= rows * np.append(inverse, 0.0)[second, None]
    free = np.flatnonzero(problem.is_free)
    flat = matrix[:, free].reshape(len(rows), 2 * len(free))
    wanted = np.append(aims, np.zeros((1, 2)), axis=0)
    needed = bounds - ((wanted[first] - wanted[second]) * rows).sum(axis=1)
    force = box_dual(flat, needed, prices, start)
    moved = aims.copy()
    moved[free] += (force @ flat).reshape(-1, 2) * inverse[free, None]
    return moved, force


def box_dual(
    matrix: FloatArray, linear: FloatArray, upper: FloatArray, start: FloatArray, steps: int = _NEWTON_STEPS
) -> FloatArray:
    """Minimises ``½ |A'x|² − b'x`` over ``0 <= x <= upper`` by projected Newton steps (Bertsekas 1982).

    Args:
        matrix: A, (M, N).
        linear: b, (M,).
        upper: Upper bound of x, (M,).
        start: Start values, (M,).
        steps: Largest number of Newton steps.

    Returns:
        x, (M,).
    """
    x = _gradient_start(matrix, linear, upper, start)
    push = x @ matrix
    gradient = matrix @ push + _EASE * x - linear
    value = 0.5 * float(push @ push + _EASE * (x @ x)) - float(linear @ x)
    for _ in range(steps):
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


def _gradient_start(matrix: FloatArray, linear: FloatArray, upper: FloatArray, start: FloatArray) -> FloatArray:
    """Computes a start for the Newton steps by accelerated projected gradients (Beck and Teboulle 2009), restarted on overshoot."""
    size = np.abs(matrix)
    rate = 1 / (size @ size.sum(axis=0) + _EASE)  # row sums bound the quadratic form from above, so no step overshoots
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
