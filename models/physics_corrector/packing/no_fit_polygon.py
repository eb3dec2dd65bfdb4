"""No-fit polygons: the shifts of one part to another at which their slabs meet, for all pairs of parts at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.physics_corrector.packing.slab_outline import NUM_SIDES, SlabOutline
from stable_data.scene import FloatArray, IntArray

_CHUNK = 512  # pairs of slabs that are computed at a time: bounds the memory


@dataclass(frozen=True, eq=False)
class RigidGroup:
    """A part that moves as one: an object on the table with all that it carries, or the restricted zone.

    Attributes:
        slabs: Its slabs around the anchor, heights above the table.
        anchor: Its position, (2,), metres.
    """

    slabs: SlabOutline
    anchor: FloatArray


@dataclass(frozen=True, eq=False)
class NoFitPolygons:
    """No-fit polygons of pairs of slabs: the first slab is clear of the second if it is beyond one of the half-planes.

    Attributes:
        first: Index of the first part, (E,).
        second: Index of the second part, (E,); a pair of parts has one row for each deciding pair of slabs.
        normals: Normals of the half-planes, (E, 2M, 2), unit.
        offsets: Their distances from the origin, (E, 2M), metres.
        apart: First anchor minus second anchor, (E, 2), metres.
    """

    first: IntArray
    second: IntArray
    normals: FloatArray
    offsets: FloatArray
    apart: FloatArray

    def clearances(self) -> dict[tuple[int, int], float]:
        """Returns the distance of each pair of parts, metres, negative if they overlap; without pairs that can never meet."""
        beyond = (np.einsum("emd,ed->em", self.normals, self.apart) - self.offsets).max(axis=1)
        found: dict[tuple[int, int], float] = {}
        for i, j, clear in zip(self.first.tolist(), self.second.tolist(), beyond.tolist(), strict=True):
            found[i, j] = min(clear, found.get((i, j), np.inf))
        return found


def no_fit(parts: Sequence[RigidGroup]) -> NoFitPolygons:
    """Computes the polygons of all pairs of parts, the part with the lower index first."""
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
    # If two slabs are within two others of the same parts, these meet first and decide. Each pair of slabs covers itself, so a
    # count of 1 means that no other pair does.
    covering = within @ meets.astype(np.float32) @ within.T
    one, other = np.nonzero(meets & (covering < 1.5))
    found_normals, found_offsets = np.empty((len(one), 2 * NUM_SIDES, 2)), np.empty((len(one), 2 * NUM_SIDES))
    for start in range(0, len(one), _CHUNK):
        rows = slice(start, start + _CHUNK)
        a, b = one[rows], other[rows]
        # The first slab is clear if it is beyond a half-plane of the second, or the second beyond one of the first.
        found_normals[rows, :NUM_SIDES], found_normals[rows, NUM_SIDES:] = -normals[a], normals[b]
        found_offsets[rows, :NUM_SIDES] = offsets[a] - (normals[a] @ corners[b].transpose(0, 2, 1)).min(axis=2)
        found_offsets[rows, NUM_SIDES:] = offsets[b] - (normals[b] @ corners[a].transpose(0, 2, 1)).min(axis=2)
    anchors = np.array([p.anchor for p in parts]).reshape(-1, 2)
    first, second = owner[one], owner[other]
    return NoFitPolygons(first, second, found_normals, found_offsets, anchors[first] - anchors[second])
