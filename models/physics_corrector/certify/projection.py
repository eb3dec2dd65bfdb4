"""Regularised projection: the least movement that parts a crowd, where each pair goes apart across one line.

Each step fixes, for every pair of slabs that is near, the half-plane of its no-fit polygon that it is beyond or nearest to, and
solves the convex problem that remains: weighted squared distance from the aims, every broken half-plane and every directional
relation at a price per metre. A half-plane is part of the free region, so what a step finds free stays free in the next.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from models.physics_corrector.certify.crowd import Crowd
from stable_data.scene import FloatArray, IntArray

HARD = 3.0
"""Price of a constraint that is to hold, in metres of stiff movement."""

FREE = 1e-4
"""A crowd is parted where no overlap with the clearance added is more than this, metres."""

_NEAR = 0.08  # pairs farther apart than this are left out of a step, metres
_MARGIN = 2e-4  # by which a directional relation is kept, metres
_EASE = 2e-4  # keeps the dual strictly concave: metres of violation per unit of price
_GRADIENT_STEPS, _NEWTON_STEPS, _HALVINGS = 60, 25, 20
_EXACT = 1e-7
_ALONG = 0.35  # cosine between a way out and a directional relation that it serves


@dataclass(slots=True)
class Forces:
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
    def none(cls, crowd: Crowd) -> "Forces":
        """None on any body of a crowd."""
        return cls(np.zeros(len(crowd.first)), np.zeros(2 * len(crowd.orders)), np.zeros(4 * len(crowd.stiffness)))


def project(
    crowd: Crowd,
    shifts: FloatArray,
    aims: FloatArray,
    steps: int,
    order_price: float = HARD,
    forces: Forces | None = None,
) -> tuple[FloatArray, bool]:
    """Moves bodies apart.

    Args:
        crowd: The bodies.
        shifts: Where they are, (B, 2), metres.
        aims: Where they want to be, (B, 2).
        steps: Steps at most.
        order_price: Price of a metre by which a directional relation is broken.
        forces: A start, changed to where it ends.

    Returns:
        The shifts, (B, 2), and whether the crowd is parted.
    """
    best, is_parted = shifts, False
    forces = forces or Forces.none(crowd)
    for _ in range(steps):
        moved = _step(crowd, shifts, aims, order_price, forces)
        change = float(np.abs(moved - shifts).max(initial=0.0))
        shifts = moved
        is_free = is_free_of_overlap(crowd, shifts)
        if is_free or not is_parted:
            best = shifts
        is_parted = is_parted or is_free
        if change < 2e-4:
            break
    return best, is_parted


def is_free_of_overlap(crowd: Crowd, shifts: FloatArray) -> bool:
    """Does nothing of a crowd meet, and is all of it where it is allowed?"""
    return bool(crowd.overlap(shifts).max(initial=0.0) <= FREE and crowd.outside(shifts).max(initial=0.0) <= FREE)


def _step(crowd: Crowd, shifts: FloatArray, aims: FloatArray, order_price: float, forces: Forces) -> FloatArray:
    near, rows, bounds = _pairs(crowd, shifts, order_price)
    sides, edge_rows, edge_bounds = _edges(crowd, shifts)
    num_orders = 2 * len(crowd.orders) if order_price > 0 else 0
    order_rows, order_bounds = crowd.order_planes()
    of, to = (np.concatenate([x, x])[:num_orders] for x in (crowd.subjects, crowd.targets))
    first = np.concatenate([crowd.first_body[near], of, sides % len(crowd.stiffness)])
    second = np.concatenate([crowd.second_body[near], to, np.full(len(sides), -1)])
    rows = np.concatenate([rows, order_rows[:num_orders], edge_rows])
    bounds = np.concatenate([bounds, order_bounds[:num_orders] + _MARGIN, edge_bounds])
    counts = np.array([len(near), num_orders, len(sides)])
    prices = np.repeat([HARD, order_price, 4 * HARD], counts)
    start = np.concatenate([forces.pairs[near], forces.orders[:num_orders], forces.edges[sides]])
    moved, force = _solved(crowd, first, second, rows, bounds, prices, aims, start)
    for kept, where, pushes in zip(
        (forces.pairs, forces.orders, forces.edges), (near, slice(num_orders), sides), np.split(force, counts.cumsum()[:2]), strict=True
    ):
        kept[:] = 0.0
        kept[where] = pushes
    return moved


def _pairs(crowd: Crowd, shifts: FloatArray, order_price: float) -> tuple[IntArray, FloatArray, FloatArray]:
    """One half-plane for each near pair of slabs."""
    beyond = crowd.beyond(shifts)
    clear = beyond.max(axis=1)
    near = np.nonzero(clear < _NEAR)[0]
    chosen = beyond[near].argmax(axis=1)
    overlapping = near[clear[near] < 0]
    wanted = _wanted_axes(crowd) if order_price > 1 else {}
    groups: dict[tuple[int, int], list[int]] = {}
    for e in overlapping.tolist():
        groups.setdefault((int(crowd.first[e]), int(crowd.second[e])), []).append(e)
    position = {int(e): n for n, e in enumerate(near)}
    for entries in groups.values():
        axis = wanted.get((int(crowd.first_body[entries[0]]), int(crowd.second_body[entries[0]])))
        if len(entries) == 1 and axis is None:
            continue
        _choose_way_out(crowd, entries, beyond, axis, position, chosen)
    normals = crowd.normals[near, chosen]
    bounds = crowd.offsets[near, chosen] - np.einsum("nd,nd->n", normals, crowd.apart[near])
    return near, normals, bounds


def _choose_way_out(
    crowd: Crowd,
    entries: list[int],
    beyond: FloatArray,
    axis: FloatArray | None,
    position: dict[int, int],
    chosen: IntArray,
) -> None:
    """One direction for all slabs of two parts that overlap, along their directional relation where they have one."""
    normals = crowd.normals[entries]
    cost = -beyond[entries]
    if len(entries) > 1:
        # Along each of the normals: how far the slab that is deepest along it has to go.
        flat = normals.reshape(-1, 2)
        closeness = flat @ normals.reshape(-1, 2).T
        share = closeness.reshape(len(flat), len(entries), -1)
        pick = share.argmax(axis=2)  # each slab leaves by its own half-plane that is nearest in direction
        deep = np.take_along_axis(np.broadcast_to(cost, (len(flat), *cost.shape)), pick[..., None], axis=2)[..., 0]
        total = deep.max(axis=1) + 0.02 * (1 - share.max(axis=2).min(axis=1))
    else:
        flat, pick, total = normals[0], np.arange(normals.shape[1])[:, None], cost[0]
    if axis is not None:
        total = total + np.where(flat @ axis < _ALONG, 1.0, 0.0)
    best = int(total.argmin())
    for n, e in enumerate(entries):
        chosen[position[e]] = pick[best, n]


def _wanted_axes(crowd: Crowd) -> dict[tuple[int, int], FloatArray]:
    """For pairs of bodies with one directional relation: where the first is, seen from the second."""
    axes: dict[tuple[int, int], FloatArray] = {}
    for o in crowd.orders:
        axes[o.first, o.second] = o.axis
        axes[o.second, o.first] = -o.axis
    return axes


def _edges(crowd: Crowd, shifts: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """The edges of the table that bodies are near: numbers of side and body, half-planes, bounds."""
    num = len(crowd.stiffness)
    sides, rows, bounds = [], [], []
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
    crowd: Crowd,
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
    flat = np.ascontiguousarray(matrix[:, :num][:, crowd.is_free]).reshape(len(rows), -1)
    wanted = np.append(aims, np.zeros((1, 2)), axis=0)
    needed = bounds - ((wanted[first] - wanted[second]) * rows).sum(axis=1)
    force = box_dual(flat, needed, prices, start)
    moved = aims.copy()
    moved[crowd.is_free] += (force @ flat).reshape(-1, 2) * inverse[crowd.is_free, None]
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
            return new
        if gradient @ change > 0:
            momentum, ahead = 1.0, new
        else:
            grown = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
            ahead, momentum = new + (momentum - 1) / grown * change, grown
        x = new
    return x
