"""Regularised projection: the least movement that parts a crowd, where each pair goes apart across one line.

Each step fixes, for every pair of slabs that is near, the half-plane of its no-fit polygon that it is beyond or nearest to, and
solves the convex problem that remains: weighted squared distance from the aims, every broken half-plane and every directional
relation at a price per metre. A half-plane is part of the free region, so what a step finds free stays free in the next.
"""

import numpy as np

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


def project(
    crowd: Crowd, shifts: FloatArray, aims: FloatArray, steps: int, order_price: float = HARD
) -> tuple[FloatArray, bool]:
    """Moves bodies apart.

    Args:
        crowd: The bodies.
        shifts: Where they are, (B, 2), metres.
        aims: Where they want to be, (B, 2).
        steps: Steps at most.
        order_price: Price of a metre by which a directional relation is broken.

    Returns:
        The shifts, (B, 2), and whether the crowd is parted.
    """
    best, is_parted = shifts, False
    for _ in range(steps):
        moved = _step(crowd, shifts, aims, order_price)
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


def _step(crowd: Crowd, shifts: FloatArray, aims: FloatArray, order_price: float) -> FloatArray:
    first, second, rows, bounds = _pairs(crowd, shifts, order_price)
    prices = [np.full(len(first), HARD)]
    if len(crowd.orders) and order_price > 0:
        of, to = (np.concatenate([x, x]) for x in (crowd.subjects, crowd.targets))
        order_rows, order_bounds = crowd.order_planes()
        order_bounds = order_bounds + _MARGIN
        first, second = np.concatenate([first, of]), np.concatenate([second, to])
        rows, bounds = np.concatenate([rows, order_rows]), np.concatenate([bounds, order_bounds])
        prices.append(np.full(len(of), order_price))
    edge_first, edge_rows, edge_bounds = _edges(crowd, shifts)
    first = np.concatenate([first, edge_first])
    second = np.concatenate([second, np.full(len(edge_first), -1)])
    rows, bounds = np.concatenate([rows, edge_rows]), np.concatenate([bounds, edge_bounds])
    prices.append(np.full(len(edge_first), 4 * HARD))
    return _solved(crowd, first, second, rows, bounds, np.concatenate(prices), aims)


def _pairs(crowd: Crowd, shifts: FloatArray, order_price: float) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
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
    return crowd.first_body[near], crowd.second_body[near], normals, bounds


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
    """The edges of the table that bodies are near."""
    owners, rows, bounds = [], [], []
    for axis in (0, 1):
        unit = np.zeros(2)
        unit[axis] = 1.0
        for sign, bound in ((1.0, crowd.low[:, axis]), (-1.0, -crowd.high[:, axis])):
            near = np.nonzero(crowd.is_free & (sign * shifts[:, axis] - bound < _NEAR))[0]
            owners.append(near)
            rows.append(np.repeat(sign * unit[None], len(near), axis=0))
            bounds.append(bound[near])
    return np.concatenate(owners), np.concatenate(rows), np.concatenate(bounds)


def _solved(
    crowd: Crowd,
    first: IntArray,
    second: IntArray,
    rows: FloatArray,
    bounds: FloatArray,
    prices: FloatArray,
    aims: FloatArray,
) -> FloatArray:
    """Least weighted squared distance from the aims with ``row · (first − second) >= bound`` at a price."""
    num = len(crowd.stiffness)
    inverse = np.where(crowd.is_free, 1 / np.where(crowd.is_free, crowd.stiffness, 1.0), 0.0)
    matrix = np.zeros((len(rows), num, 2))
    index = np.arange(len(rows))
    matrix[index, first] += rows
    has_second = second >= 0
    matrix[index[has_second], second[has_second]] -= rows[has_second]
    matrix *= np.sqrt(inverse)[None, :, None]
    flat = matrix.reshape(len(rows), 2 * num)
    aim = (aims * np.sqrt(np.where(crowd.is_free, crowd.stiffness, 1.0))[:, None]).reshape(-1)
    needed = bounds - flat @ aim
    fixed = ~crowd.is_free
    if fixed.any():  # what cannot move is where it is
        needed -= np.where(fixed[first], np.einsum("nd,nd->n", rows, aims[first]), 0.0)
        needed += np.where(has_second & fixed[second], np.einsum("nd,nd->n", rows, aims[second]), 0.0)
    force = box_dual(flat @ flat.T, needed, prices)
    moved = (aim + flat.T @ force).reshape(num, 2) * np.sqrt(inverse)[:, None]
    return np.where(crowd.is_free[:, None], moved, aims)


def box_dual(quadratic: FloatArray, linear: FloatArray, upper: FloatArray) -> FloatArray:
    """Minimises ``½ x'Qx − b'x`` over ``0 <= x <= upper`` by projected Newton steps (Bertsekas 1982).

    Args:
        quadratic: Q, (M, M), positive semidefinite.
        linear: b, (M,).
        upper: (M,).

    Returns:
        x, (M,).
    """
    matrix = quadratic + _EASE * np.eye(len(linear))
    x = _descended(matrix, linear, upper)
    gradient = matrix @ x - linear
    value = 0.5 * float(x @ (gradient - linear))
    for _ in range(_NEWTON_STEPS):
        held = ((x <= 0) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        free = np.nonzero(~held)[0]
        if not len(free) or np.abs(gradient[free]).max() < _EXACT:
            break
        step = np.linalg.solve(matrix[np.ix_(free, free)], -gradient[free])
        length, trial = 1.0, x.copy()
        for _ in range(_HALVINGS):
            trial[free] = np.clip(x[free] + length * step, 0.0, upper[free])
            product = matrix @ trial
            if (new := float(0.5 * trial @ product - linear @ trial)) < value - 1e-14:
                break
            length /= 2
        else:
            break
        x, value, gradient = trial, new, product - linear
    return x


def _descended(matrix: FloatArray, linear: FloatArray, upper: FloatArray) -> FloatArray:
    """A start for the Newton steps, by accelerated projected gradients (Beck and Teboulle 2009), restarted where they overshoot."""
    rate = 1 / max(float(np.abs(matrix).sum(axis=1).max(initial=0.0)), 1e-9)
    x = ahead = np.zeros(len(linear))
    momentum = 1.0
    for _ in range(_GRADIENT_STEPS):
        gradient = matrix @ ahead - linear
        new = np.clip(ahead - rate * gradient, 0.0, upper)
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
