"""Bodies on a table that may shift, and what keeps them from where they want to be."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from models.physics_corrector.certify.outline import NUM_SIDES, Slabs
from stable_data.scene import FloatArray, IntArray, RelationKind

BoolArray: TypeAlias = npt.NDArray[np.bool_]

AXES = {
    RelationKind.LEFT_OF: (-1.0, 0.0),
    RelationKind.RIGHT_OF: (1.0, 0.0),
    RelationKind.IN_FRONT_OF: (0.0, -1.0),
    RelationKind.BEHIND: (0.0, 1.0),
}
"""Where the subject of a directional relation is, seen from its target. It holds within 45 degrees of that."""

_CHUNK = 512  # pairs of slabs whose no-fit polygons are made at a time


@dataclass(frozen=True, eq=False)
class Part:
    """What moves as one: a thing that stands on the table with all that it carries, or something fixed.

    Attributes:
        slabs: Around its anchor, heights from the table.
        anchor: Where it was, (2,), metres.
        body: The body that it belongs to: parts of one body keep their places to each other.
        members: Numbers of its objects.
    """

    slabs: Slabs
    anchor: FloatArray
    body: int
    members: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Order:
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


@dataclass(eq=False)
class Crowd:
    """All bodies, what of them must not meet, and where they are allowed.

    Attributes:
        parts: All parts.
        stiffness: How much a body's movement counts, (B,); infinite where it must not move.
        aims: The shifts that the bodies want, (B, 2), metres.
        orders: Directional relations to keep.
        low: Least shift of each body, (B, 2), metres.
        high: Greatest, (B, 2).
        relaxed: For pairs of parts that may be so near: the clearance of their outlines that they may have, metres.
        clearance: What all others keep, metres.
    """

    parts: Sequence[Part]
    stiffness: FloatArray
    aims: FloatArray
    orders: Sequence[Order]
    low: FloatArray
    high: FloatArray
    relaxed: dict[tuple[int, int], float]
    clearance: float
    first: IntArray = field(init=False)
    second: IntArray = field(init=False)
    normals: FloatArray = field(init=False)
    offsets: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Makes the no-fit polygons of all pairs of slabs that share a height: normals (E, 2M, 2), offsets (E, 2M)."""
        self.body = np.array([p.body for p in self.parts], np.int64)
        self.is_free = np.isfinite(self.stiffness)
        self.anchors = np.array([p.anchor for p in self.parts]).reshape(-1, 2)
        owner = np.repeat(np.arange(len(self.parts)), [len(p.slabs.tops) for p in self.parts])
        self._owner = owner
        self._normals = np.concatenate([p.slabs.normals for p in self.parts])
        self._offsets = np.concatenate([p.slabs.offsets for p in self.parts])
        self._corners = np.concatenate([p.slabs.corners for p in self.parts])
        bottoms = np.concatenate([p.slabs.bottoms for p in self.parts])
        tops = np.concatenate([p.slabs.tops for p in self.parts])
        body = self.body[owner]
        meets = (bottoms[:, None] < tops[None] - 1e-9) & (tops[:, None] > bottoms[None] + 1e-9)
        meets &= (body[:, None] != body[None]) & (self.is_free[body][:, None] | self.is_free[body][None])
        one, other = np.nonzero(np.triu(meets))
        one, other = self._without_covered(one, other)
        self.first, self.second = owner[one], owner[other]
        self.normals, self.offsets = self._no_fit(one, other)
        relaxed = [self.relaxed.get((int(i), int(j)), self.clearance) for i, j in zip(self.first, self.second, strict=True)]
        self.offsets += np.array(relaxed)[:, None]
        self.lifted = self.anchors[self.first] - self.anchors[self.second]
        self.first_body, self.second_body = self.body[self.first], self.body[self.second]

    def _without_covered(self, one: IntArray, other: IntArray) -> tuple[IntArray, IntArray]:
        """Drops pairs of slabs that cannot meet before another pair of the same parts does, since both are within those."""
        size = len(self._owner)
        inside = np.zeros((size, size), bool)
        for k in range(len(self.parts)):
            mine = np.nonzero(self._owner == k)[0]
            for a in mine:
                along = np.einsum("md,knd->kmn", self._normals[a], self._corners[mine]).max(axis=2)
                inside[mine, a] = (along <= self._offsets[a] + 1e-6).all(axis=1)
        np.fill_diagonal(inside, val=False)
        keep = np.ones(len(one), bool)
        pairs: dict[tuple[int, int], list[int]] = {}
        for n, (i, j) in enumerate(zip(self._owner[one].tolist(), self._owner[other].tolist(), strict=True)):
            pairs.setdefault((i, j), []).append(n)
        same = np.eye(size, dtype=bool)
        within = inside | same
        for group in pairs.values():
            if len(group) > 1:
                a, b = one[group], other[group]
                covered = within[np.ix_(a, a)] & within[np.ix_(b, b)]
                np.fill_diagonal(covered, val=False)
                mutual = covered & covered.T
                covered &= ~mutual | (np.arange(len(group))[:, None] > np.arange(len(group))[None])
                keep[group] = ~covered.any(axis=1)
        return one[keep], other[keep]

    def _no_fit(self, one: IntArray, other: IntArray) -> tuple[FloatArray, FloatArray]:
        normals = np.empty((len(one), 2 * NUM_SIDES, 2))
        offsets = np.empty((len(one), 2 * NUM_SIDES))
        for start in range(0, len(one), _CHUNK):
            part = slice(start, start + _CHUNK)
            a, b = one[part], other[part]
            # The first is apart along -n of its own half-planes and along n of the other's.
            normals[part, :NUM_SIDES], normals[part, NUM_SIDES:] = -self._normals[a], self._normals[b]
            offsets[part, :NUM_SIDES] = self._offsets[a] - (self._normals[a] @ self._corners[b].transpose(0, 2, 1)).min(axis=2)
            offsets[part, NUM_SIDES:] = self._offsets[b] - (self._normals[b] @ self._corners[a].transpose(0, 2, 1)).min(axis=2)
        return normals, offsets

    def beyond(self, shifts: FloatArray) -> FloatArray:
        """How far each pair of slabs is beyond each of its half-planes, (E, 2M), metres, for shifts (B, 2)."""
        apart = self.lifted + shifts[self.first_body] - shifts[self.second_body]
        return np.asarray(np.einsum("emd,ed->em", self.normals, apart) - self.offsets)

    def overlap(self, shifts: FloatArray) -> FloatArray:
        """How deep the slabs of each pair of parts are in each other, by the deepest pair, (E,) metres; 0 where apart."""
        return np.asarray(np.maximum(0.0, -self.beyond(shifts).max(axis=1)))

    def num_broken(self, shifts: FloatArray) -> int:
        """Directional relations that do not hold."""
        return int(self.broken(shifts).sum())

    def broken(self, shifts: FloatArray) -> BoolArray:
        """Which directional relations do not hold, (K,)."""
        apart = [o.offset + shifts[o.first] - shifts[o.second] for o in self.orders]
        return np.array([a @ o.axis <= abs(a @ o.axis[::-1]) for a, o in zip(apart, self.orders, strict=True)], bool)

    def outside(self, shifts: FloatArray) -> FloatArray:
        """How far each body is beyond where it is allowed, (B,), metres."""
        out = np.maximum(0.0, np.maximum(self.low - shifts, shifts - self.high)).max(axis=1)
        return np.where(self.is_free, out, 0.0)
