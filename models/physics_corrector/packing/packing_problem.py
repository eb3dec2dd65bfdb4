"""The packing problem: bodies on a table that may shift, their wanted shifts and their constraints."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.physics_corrector.packing.no_fit_polygon import NoFitPolygons
from models.physics_corrector.packing.slab_outline import NUM_AROUND, BoolArray
from stable_data.scene import FloatArray, IntArray, RelationKind

AXES = {
    RelationKind.LEFT_OF: (-1.0, 0.0),
    RelationKind.RIGHT_OF: (1.0, 0.0),
    RelationKind.IN_FRONT_OF: (0.0, -1.0),
    RelationKind.BEHIND: (0.0, 1.0),
}
"""Direction from the target of a directional relation to its subject. The relation holds within 45 degrees of it."""

_NEAREST_COSINE = np.cos(np.pi / NUM_AROUND)


def holds_relation(apart: FloatArray, axis: FloatArray) -> bool:
    """Whether a directional relation holds: its vector ``apart`` (2,), metres, is within 45 degrees of its axis (2,), unit."""
    return bool(apart @ axis > abs(apart @ axis[::-1]))


@dataclass(frozen=True, eq=False)
class OrderConstraint:
    """A directional relation between objects of two bodies.

    Attributes:
        first: Body of the subject.
        second: Body of the target.
        axis: The direction, (2,).
        offset: Subject minus target without shifts, (2,), metres.
    """

    first: int
    second: int
    axis: FloatArray
    offset: FloatArray


@dataclass(frozen=True, eq=False)
class BodyArrays:
    """The properties of bodies.

    Attributes:
        stiffness: Weight of the movement, (B,); infinite for a body that must not move.
        aims: Wanted shift, (B, 2), metres.
        low: Least shift, (B, 2), metres.
        high: Greatest shift, (B, 2), metres.
    """

    stiffness: FloatArray
    aims: FloatArray
    low: FloatArray
    high: FloatArray


class PackingProblem:
    """Bodies with the pairs of parts that must not meet and the bounds of their shifts.

    Args:
        pairs: The no-fit polygons of the parts.
        body: Index of the body of each part, (P,); parts of one body move as one.
        bodies: The properties of the bodies.
        orders: Directional relations to preserve.
        clearance: Least distance between parts, metres.
        relaxed: Pair of parts -> a smaller least distance.
    """

    def __init__(
        self,
        pairs: NoFitPolygons,
        body: IntArray,
        bodies: BodyArrays,
        orders: Sequence[OrderConstraint],
        clearance: float,
        relaxed: Mapping[tuple[int, int], float] | None = None,
    ) -> None:
        self.stiffness, self.aims, self.low, self.high = bodies.stiffness, bodies.aims, bodies.low, bodies.high
        self.orders = tuple(orders)
        self.is_free = np.isfinite(bodies.stiffness)
        first, second = body[pairs.first], body[pairs.second]
        rows = np.flatnonzero((first != second) & (self.is_free[first] | self.is_free[second]))
        self.first_body, self.second_body = first[rows], second[rows]
        self.first, self.second = pairs.first[rows], pairs.second[rows]
        self.normals, self.apart = pairs.normals[rows], pairs.apart[rows]
        gap = np.full(len(rows), clearance)
        for (i, j), clear in (relaxed or {}).items():
            gap[(self.first == i) & (self.second == j)] = clear
        self.offsets = pairs.offsets[rows] + gap[:, None]
        self._reach = self.offsets.max(axis=1, initial=-np.inf)
        self._axes = np.array([o.axis for o in orders]).reshape(-1, 2)
        self._offsets = np.array([o.offset for o in orders]).reshape(-1, 2)
        self.subjects = np.array([o.first for o in orders], np.int64)
        self.targets = np.array([o.second for o in orders], np.int64)

    def shrunk(self, share: float) -> "PackingProblem":
        """Returns the problem with all bodies scaled by ``share`` about their anchors."""
        smaller = copy.copy(self)  # shallow: both share the arrays that do not change
        smaller.offsets = share * self.offsets
        smaller._reach = share * self._reach
        return smaller

    def beyond(self, shifts: FloatArray) -> FloatArray:
        """Returns how far each pair of slabs is beyond each of its half-planes, (E, 2M), metres, for shifts (B, 2)."""
        apart = self.apart + shifts[self.first_body] - shifts[self.second_body]
        return np.asarray((self.normals @ apart[:, :, None])[..., 0] - self.offsets)

    def without(self, gone: Sequence[int]) -> "PackingProblem":
        """Returns the problem without the constraints of some bodies; these stay where they are."""
        there = np.ones(len(self.stiffness), bool)
        there[list(gone)] = False
        rows, orders = there[self.first_body] & there[self.second_body], there[self.subjects] & there[self.targets]
        return self._with(self.is_free & there, rows, orders)

    def around(self, k: int, shifts: FloatArray, distance: float, rings: int) -> "PackingProblem":
        """Returns the problem in which only a body and those around it may move.

        Args:
            k: The body.
            shifts: The shifts, (B, 2), metres, of which all but these bodies' stay.
            distance: Slabs nearer than this are neighbours, metres.
            rings: 1: the neighbours may move; 2: their neighbours too, and so on.
        """
        near = self.near(shifts, distance)[0]
        first, second = self.first_body[near], self.second_body[near]
        moves = np.arange(len(self.stiffness)) == k
        for _ in range(rings):
            inner = moves.copy()
            moves[second[inner[first]]] = True
            moves[first[inner[second]]] = True
            moves &= self.is_free
        rows, orders = moves[self.first_body] | moves[self.second_body], moves[self.subjects] | moves[self.targets]
        return self._with(moves, rows, orders)

    def _with(self, is_free: BoolArray, rows: BoolArray, orders: BoolArray) -> "PackingProblem":
        """The problem with other free bodies (B,), and with some of the pairs (E,) and of the relations (K,)."""
        other = copy.copy(self)
        other.is_free = is_free
        for name in ("first_body", "second_body", "first", "second", "normals", "apart", "offsets", "_reach"):
            setattr(other, name, getattr(self, name)[rows])
        for name in ("_axes", "_offsets", "subjects", "targets"):
            setattr(other, name, getattr(self, name)[orders])
        other.orders = tuple(self.orders[k] for k in np.flatnonzero(orders))
        return other

    def near(self, shifts: FloatArray, distance: float) -> tuple[IntArray, FloatArray]:
        """Returns pairs of slabs nearer than a distance, (N,), and how far each is beyond its half-planes, (N, 2M), metres."""
        apart = self.apart + shifts[self.first_body] - shifts[self.second_body]
        # NUM_AROUND normals are evenly spaced, so one of them is within half their spacing of the direction to the other slab.
        rows = np.flatnonzero(_NEAREST_COSINE * np.sqrt((apart * apart).sum(axis=1)) < self._reach + distance)
        beyond = np.asarray((self.normals[rows] @ apart[rows, :, None])[..., 0] - self.offsets[rows])
        close = beyond.max(axis=1, initial=-np.inf) < distance
        return rows[close], beyond[close]

    def overlap(self, shifts: FloatArray) -> FloatArray:
        """Returns the penetration of each pair of slabs, (E,) metres; 0 if apart."""
        return np.asarray(np.maximum(0.0, -self.beyond(shifts).max(axis=1)))

    def outside(self, shifts: FloatArray) -> FloatArray:
        """Returns how far each body is beyond its bounds, (B,), metres."""
        out = np.maximum(0.0, np.maximum(self.low - shifts, shifts - self.high)).max(axis=1)
        return np.where(self.is_free, out, 0.0)

    def broken(self, shifts: FloatArray) -> BoolArray:
        """Returns which directional relations are broken, (K,)."""
        apart = self._offsets + shifts[self.subjects] - shifts[self.targets]
        return np.asarray((apart * self._axes).sum(axis=1) <= np.abs((apart * self._axes[:, ::-1]).sum(axis=1)))

    def order_planes(self) -> tuple[FloatArray, FloatArray]:
        """Returns the two half-planes of each directional relation: ``row · (first − second) >= bound``, (2K, 2) and (2K,)."""
        rows = np.concatenate([self._axes + self._axes[:, ::-1], self._axes - self._axes[:, ::-1]]) / np.sqrt(2)
        return rows, -(rows * np.concatenate([self._offsets, self._offsets])).sum(axis=1)
