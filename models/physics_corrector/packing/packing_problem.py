"""Bodies on a table that may shift, and what keeps them from where they want to be."""

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
"""Where the subject of a directional relation is, seen from its target. It holds within 45 degrees of that."""

_LOOKS_AT = np.cos(np.pi / NUM_AROUND)


def holds_relation(apart: FloatArray, axis: FloatArray) -> bool:
    """Does a directional relation hold: is what is apart by a vector (2,), metres, within 45 degrees of its axis (2,), unit?"""
    return bool(apart @ axis > abs(apart @ axis[::-1]))


@dataclass(frozen=True, eq=False)
class OrderConstraint:
    """A directional relation between objects of two bodies.

    Attributes:
        first: Body of the subject.
        second: Body of the target.
        axis: The direction, (2,).
        offset: Subject minus target where no body is shifted, (2,), metres.
    """

    first: int
    second: int
    axis: FloatArray
    offset: FloatArray


@dataclass(frozen=True, eq=False)
class BodyArrays:
    """What each body is like.

    Attributes:
        stiffness: How much its movement counts, (B,); infinite where it must not move.
        aims: The shift that it wants, (B, 2), metres.
        low: Its least shift, (B, 2), metres.
        high: Its greatest, (B, 2).
    """

    stiffness: FloatArray
    aims: FloatArray
    low: FloatArray
    high: FloatArray


class PackingProblem:
    """All bodies, what of them must not meet, and where they are allowed.

    Args:
        pairs: The no-fit polygons of their parts.
        body: The body of each part, (P,): parts of one body keep their places to each other.
        bodies: What each is like.
        orders: Directional relations to keep.
        clearance: What parts keep from each other, metres.
        relaxed: What those pairs of parts keep that may be nearer.
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
        kept = np.full(len(rows), clearance)
        for (i, j), clear in (relaxed or {}).items():
            kept[(self.first == i) & (self.second == j)] = clear
        self.offsets = pairs.offsets[rows] + kept[:, None]
        self._reach = self.offsets.max(axis=1, initial=-np.inf)
        self._axes = np.array([o.axis for o in orders]).reshape(-1, 2)
        self._offsets = np.array([o.offset for o in orders]).reshape(-1, 2)
        self.subjects = np.array([o.first for o in orders], np.int64)
        self.targets = np.array([o.second for o in orders], np.int64)

    def shrunk(self, share: float) -> "PackingProblem":
        """The same bodies, all as much smaller about their anchors."""
        smaller = copy.copy(self)
        smaller.offsets = share * self.offsets
        smaller._reach = share * self._reach
        return smaller

    def beyond(self, shifts: FloatArray) -> FloatArray:
        """How far each pair of slabs is beyond each of its half-planes, (E, 2M), metres, for shifts (B, 2)."""
        apart = self.apart + shifts[self.first_body] - shifts[self.second_body]
        return np.asarray((self.normals @ apart[:, :, None])[..., 0] - self.offsets)

    def without(self, gone: Sequence[int]) -> "PackingProblem":
        """The same bodies, of which some are in nobody's way and stay where they are."""
        fewer = copy.copy(self)
        away = np.zeros(len(self.stiffness), bool)
        away[list(gone)] = True
        fewer.is_free = self.is_free & ~away
        rows = np.flatnonzero(~away[self.first_body] & ~away[self.second_body])
        for name in ("first_body", "second_body", "first", "second", "normals", "apart", "offsets", "_reach"):
            setattr(fewer, name, getattr(self, name)[rows])
        kept = np.flatnonzero(~away[self.subjects] & ~away[self.targets])
        for name in ("_axes", "_offsets", "subjects", "targets"):
            setattr(fewer, name, getattr(self, name)[kept])
        fewer.orders = tuple(self.orders[k] for k in kept)
        return fewer

    def near(self, shifts: FloatArray, distance: float) -> tuple[IntArray, FloatArray]:
        """Pairs of slabs that are nearer than a distance, (N,), and how far each is beyond its half-planes, (N, 2M), metres."""
        apart = self.apart + shifts[self.first_body] - shifts[self.second_body]
        # Of half-planes that look evenly around one looks nearly at the other slab.
        rows = np.flatnonzero(_LOOKS_AT * np.sqrt((apart * apart).sum(axis=1)) < self._reach + distance)
        beyond = np.asarray((self.normals[rows] @ apart[rows, :, None])[..., 0] - self.offsets[rows])
        close = beyond.max(axis=1, initial=-np.inf) < distance
        return rows[close], beyond[close]

    def overlap(self, shifts: FloatArray) -> FloatArray:
        """How deep the slabs of each pair are in each other, (E,) metres; 0 where apart."""
        return np.asarray(np.maximum(0.0, -self.beyond(shifts).max(axis=1)))

    def depths(self, shifts: FloatArray) -> FloatArray:
        """How deep bodies are in each other, (B, B), metres."""
        depth = np.zeros((len(shifts), len(shifts)))
        np.maximum.at(depth, (self.first_body, self.second_body), self.overlap(shifts))
        return depth + depth.T

    def outside(self, shifts: FloatArray) -> FloatArray:
        """How far each body is beyond where it is allowed, (B,), metres."""
        out = np.maximum(0.0, np.maximum(self.low - shifts, shifts - self.high)).max(axis=1)
        return np.where(self.is_free, out, 0.0)

    def broken(self, shifts: FloatArray) -> BoolArray:
        """Which directional relations do not hold, (K,)."""
        apart = self._offsets + shifts[self.subjects] - shifts[self.targets]
        return np.asarray((apart * self._axes).sum(axis=1) <= np.abs((apart * self._axes[:, ::-1]).sum(axis=1)))

    def order_planes(self) -> tuple[FloatArray, FloatArray]:
        """The two half-planes of each directional relation: ``row · (first − second) >= bound``, rows (2K, 2), bounds (2K,)."""
        rows = np.concatenate([self._axes + self._axes[:, ::-1], self._axes - self._axes[:, ::-1]]) / np.sqrt(2)
        return rows, -(rows * np.concatenate([self._offsets, self._offsets])).sum(axis=1)
