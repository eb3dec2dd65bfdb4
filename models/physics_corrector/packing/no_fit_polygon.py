"""No-fit polygons: the shifts of one part to another at which their slabs meet, for all pairs of parts at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.physics_corrector.packing.slab_outline import NUM_SIDES, SlabOutline
from stable_data.scene import FloatArray, IntArray

_CHUNK = 512  # pairs of slabs whose polygons are made at a time


@dataclass(frozen=True, eq=False)
class RigidGroup:
    """What moves as one: a thing that stands on the table with all that it carries, or a region that is kept free.

    Attributes:
        slabs: Around its anchor, heights from the table.
        anchor: Where it is, (2,), metres.
    """

    slabs: SlabOutline
    anchor: FloatArray


@dataclass(frozen=True, eq=False)
class NoFitPolygons:
    """The polygons: the first part of each pair is clear of the second where it is beyond one of their half-planes.

    Attributes:
        first: Part, (E,).
        second: Part, (E,); a pair of parts has one row for each pair of slabs that decides.
        normals: Of the half-planes, (E, 2M, 2), unit.
        offsets: Their distances, (E, 2M), metres.
        apart: First anchor minus second, (E, 2), metres.
    """

    first: IntArray
    second: IntArray
    normals: FloatArray
    offsets: FloatArray
    apart: FloatArray

    def clearances(self) -> dict[tuple[int, int], float]:
        """How far the slabs of each pair of parts are apart, metres; negative where they meet. Pairs that never meet are missing."""
        beyond = (np.einsum("emd,ed->em", self.normals, self.apart) - self.offsets).max(axis=1)
        found: dict[tuple[int, int], float] = {}
        for i, j, clear in zip(self.first.tolist(), self.second.tolist(), beyond.tolist(), strict=True):
            found[i, j] = min(clear, found.get((i, j), np.inf))
        return found


def no_fit(parts: Sequence[RigidGroup]) -> NoFitPolygons:
    """The polygons of all pairs of parts, the part with the lower number first."""
    stacks = [p.slabs for p in parts]
    owner = np.repeat(np.arange(len(parts)), [len(s.tops) for s in stacks])
    normals = np.concatenate([np.zeros((0, NUM_SIDES, 2)), *(s.normals for s in stacks)])
    corners = np.concatenate([np.zeros((0, NUM_SIDES, 2)), *(s.corners for s in stacks)])
    offsets = np.concatenate([np.zeros((0, NUM_SIDES)), *(s.offsets for s in stacks)])
    bottoms, tops = (np.concatenate([np.zeros(0), *(getattr(s, name) for s in stacks)]) for name in ("bottoms", "tops"))
    meets = (bottoms[:, None] < tops[None] - 1e-9) & (tops[:, None] > bottoms[None] + 1e-9) & (owner[:, None] < owner[None])
    within = np.zeros((len(owner), len(owner)), np.float32)
    for k, stack in enumerate(stacks):
        mine = np.flatnonzero(owner == k)
        within[np.ix_(mine, mine)] = stack.is_within
    # Two slabs cannot meet before two others of the same parts do that they are within: those decide.
    covering = within @ meets.astype(np.float32) @ within.T
    one, other = np.nonzero(meets & (covering < 1.5))
    found_normals, found_offsets = np.empty((len(one), 2 * NUM_SIDES, 2)), np.empty((len(one), 2 * NUM_SIDES))
    for start in range(0, len(one), _CHUNK):
        rows = slice(start, start + _CHUNK)
        a, b = one[rows], other[rows]
        # The first is clear where it is beyond a half-plane of the other, or the other beyond one of its own.
        found_normals[rows, :NUM_SIDES], found_normals[rows, NUM_SIDES:] = -normals[a], normals[b]
        found_offsets[rows, :NUM_SIDES] = offsets[a] - (normals[a] @ corners[b].transpose(0, 2, 1)).min(axis=2)
        found_offsets[rows, NUM_SIDES:] = offsets[b] - (normals[b] @ corners[a].transpose(0, 2, 1)).min(axis=2)
    anchors = np.array([p.anchor for p in parts]).reshape(-1, 2)
    first, second = owner[one], owner[other]
    return NoFitPolygons(first, second, found_normals, found_offsets, anchors[first] - anchors[second])
