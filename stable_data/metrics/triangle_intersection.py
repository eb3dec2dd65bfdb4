"""Tests whether two meshes cross, exactly, on the few triangles that are near the other mesh.

Building a bounding-volume tree for a whole mesh costs far more than a query, and almost no triangle of a pair is near the other
mesh. Both meshes are therefore filtered first on a shared voxel grid. This is exact: a triangle that is dropped shares no voxel
with any triangle of the other mesh. The remaining triangles are grouped into clusters, and a cluster gets its tree at its first
query. A pair that crosses usually shows it in the first cluster or two; a pair that does not is mostly separated by boxes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import fcl
import numpy as np
import numpy.typing as npt

from stable_data.geometry.mesh import unit_normals
from stable_data.scene import FloatArray, IntArray

_MAX_CONTACTS = 256  # contacts of one pair: enough directions to separate it
_EVERY_CONTACT = 1_000_000
_CELLS = 24  # voxels along the longest edge of the shared region, at most
_MAX_ENTRIES = 60_000  # (triangle, voxel) pairs above which the grid becomes coarser
_FEW = 64  # for so few triangles the filter costs more than a tree
_USELESS_MARGIN = 5e-3  # metres; with a larger margin the filter drops too few triangles to pay
_CLUSTER = 256  # triangles of one tree
_ANY_CONTACT = fcl.CollisionRequest()
_CONTACT_WORK = 50  # work of one listed contact, in triangles
_CALL_WORK = 100  # work of one question about two clusters, however small they are
_BOX_PAIRS = 4  # pairs of boxes that cost as much as one triangle
# Bits of a number from 0 to 31, three apart: the Morton code of a cell sorts triangles so that neighbours share a cluster.
_MORTON = np.array([sum((n >> bit & 1) << 3 * bit for bit in range(5)) for n in range(32)], np.uint16)

BoolArray: TypeAlias = npt.NDArray[np.bool_]


def boxes(triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Computes the lowest and highest corner of each triangle's box.

    Args:
        triangles: (F, 3, D) float64.

    Returns:
        Two (D, F) float64: coordinates first, because reductions over a short last axis are slow.
    """
    a, b, c = (np.ascontiguousarray(triangles[:, k].T) for k in range(3))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


class WorkLimitError(Exception):
    """A work limit is reached: the answer to the query stays unknown."""


class WorkBudget:
    """Counts the work of exact tests against a limit. The unit is a triangle that they examine (about 80 ns).

    Work is counted, not timed, so that every machine answers the same queries.
    """

    def __init__(self, limit: float = math.inf) -> None:
        self.limit, self.spent = limit, 0

    @property
    def is_spent(self) -> bool:
        """Whether a query was refused because of the limit."""
        return self.spent > self.limit

    def spend(self, num_triangles: int) -> None:
        """Counts work before it is done.

        Raises:
            WorkLimitError: The work exceeds the rest of the budget.
        """
        self.spent += num_triangles  # even if it is refused: smaller tests after it are refused too
        if self.is_spent:
            raise WorkLimitError


class PosedTriangles:
    """Triangles at a pose, with their boxes computed once.

    Args:
        triangles: (F, 3, 3) float64, metres, world frame.
    """

    def __init__(self, triangles: FloatArray) -> None:
        self.triangles = triangles

    @cached_property
    def boxes(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of each triangle's box, two (3, F) float64."""
        return boxes(self.triangles)

    @cached_property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of all triangles, two (3,) float64."""
        low, high = self.boxes
        return low.min(axis=1, initial=np.inf), high.max(axis=1, initial=-np.inf)


def posed_triangles(triangles: FloatArray | PosedTriangles) -> PosedTriangles:
    """Returns triangles (F, 3, 3), metres, world frame, with their boxes; ``PosedTriangles`` are returned unchanged."""
    return triangles if isinstance(triangles, PosedTriangles) else PosedTriangles(triangles)


class _NearTriangles:
    """Triangles of one mesh near another mesh, with their boxes; they become fewer with each filter."""

    def __init__(self, surface: PosedTriangles, margin: float, low: FloatArray, high: FloatArray) -> None:
        # One axis after the other: a reduction over an axis of length 3 is slow.
        lowest, highest = surface.boxes
        mask = (lowest[0] <= high[0] + margin) & (highest[0] >= low[0] - margin)
        for axis in (1, 2):
            mask &= (lowest[axis] <= high[axis] + margin) & (highest[axis] >= low[axis] - margin)
        self.index = np.nonzero(mask)[0]
        self.triangles = surface.triangles[self.index]
        self.margin = margin
        self.low, self.high = lowest[:, self.index] - margin, highest[:, self.index] + margin

    def keep(self, mask: BoolArray) -> None:
        if not mask.all():
            self.index, self.triangles = self.index[mask], self.triangles[mask]
            self.low, self.high = self.low[:, mask], self.high[:, mask]

    def crop(self, low: FloatArray, high: FloatArray) -> None:
        """Keeps the triangles whose boxes meet a region."""
        mask = (self.low[0] <= high[0]) & (self.high[0] >= low[0])
        for axis in (1, 2):
            mask &= (self.low[axis] <= high[axis]) & (self.high[axis] >= low[axis])
        self.keep(mask)

    def voxels(self, origin: FloatArray, spacing: float, shape: IntArray) -> tuple[IntArray, IntArray] | None:
        """(triangle, voxel) for each voxel that a triangle may reach into, or None if there are too many."""
        # Truncation is monotonic, so boxes that overlap share a cell. Multiplication and 32 bits are used for speed.
        last_cell = shape[:, None] - 1
        first = np.clip((self.low - origin[:, None]) * (1 / spacing), 0, last_cell).astype(np.int32)
        last = np.clip((self.high - origin[:, None]) * (1 / spacing), 0, last_cell).astype(np.int32)
        span = last - first + 1
        count = span[0] * span[1] * span[2]
        total = int(count.sum())
        if total > _MAX_ENTRIES:
            return None
        owner = np.repeat(np.arange(len(self.index)), count)
        step = np.arange(total, dtype=np.int32) - np.repeat((np.cumsum(count) - count).astype(np.int32), count)
        row, z = np.divmod(step, span[2][owner])
        x, y = np.divmod(row, span[1][owner])
        x, y, z = x + first[0][owner], y + first[1][owner], z + first[2][owner]
        reached = self._reach(owner, count, origin, spacing, (x, y, z))
        return owner[reached], ((x * shape[1] + y) * shape[2] + z)[reached]

    def _reach(
        self, owner: IntArray, count: IntArray, origin: FloatArray, spacing: float, cell: tuple[IntArray, IntArray, IntArray]
    ) -> BoolArray:
        """Which voxels the plane of their triangle passes: the box of a large slanted triangle is mostly empty."""
        reached = np.ones(len(owner), bool)  # the boxes of small triangles are exact enough
        large = np.nonzero(count[owner] > 8)[0]
        if len(large):
            of = owner[large]
            normals = unit_normals(self.triangles)[0]
            offset = np.einsum("ij,ij->i", normals, self.triangles[:, 0])
            distance = -offset[of]
            for axis in range(3):
                distance += normals[of, axis] * (origin[axis] + (cell[axis][large] + 0.5) * spacing)
            reach = (spacing / 2 + self.margin) * np.abs(normals).sum(axis=1) + 1e-9
            reached[large] = np.abs(distance) <= reach[of]
        return reached


def near_triangles(a: FloatArray | PosedTriangles, b: FloatArray | PosedTriangles, margin: float) -> tuple[IntArray, IntArray]:
    """Finds the triangles that may come within a distance of the other mesh: no such triangle is dropped, some others remain.

    Args:
        a: Triangles, (F, 3, 3) float64, metres, world frame.
        b: Triangles of the other mesh, (G, 3, 3).
        margin: How far either mesh may be moved along each axis, metres.

    Returns:
        Indices into ``a`` and into ``b``, int64.
    """
    first, second = posed_triangles(a), posed_triangles(b)
    low, high = np.maximum(first.box[0] - margin, second.box[0]), np.minimum(first.box[1] + margin, second.box[1])
    none = np.arange(0)  # int64, as indices are
    if (low > high).any():
        return none, none
    one, other = _NearTriangles(first, margin, low, high), _NearTriangles(second, 0.0, low, high)
    for _ in range(4):  # dropped triangles shrink the shared region, which the next round divides more finely
        before = len(one.index) + len(other.index)
        if not (len(one.index) and len(other.index)) or before <= _FEW or margin > _USELESS_MARGIN:
            break
        low = np.maximum(one.low.min(axis=1), other.low.min(axis=1))
        high = np.minimum(one.high.max(axis=1), other.high.max(axis=1))
        if (low > high).any():
            return none, none
        one.crop(low, high)
        other.crop(low, high)
        if len(one.index) and len(other.index):
            _filter_by_voxels(one, other, low, high)
        if len(one.index) + len(other.index) > 0.8 * before:  # another round would gain little
            break
    return (one.index, other.index) if len(one.index) and len(other.index) else (none, none)


def _filter_by_voxels(one: _NearTriangles, other: _NearTriangles, low: FloatArray, high: FloatArray) -> None:
    """Keeps the triangles of each mesh that share a voxel of a region with a triangle of the other mesh."""
    extent = np.maximum(high - low, 1e-9)
    # Voxels much finer than the smaller triangles gain nothing.
    finest = min(float(np.median((soup.high - soup.low).max(axis=0))) for soup in (one, other))
    spacing = max(extent.max() / _CELLS, finest)
    while True:
        shape = (extent // spacing).astype(np.int64) + 1
        entries = one.voxels(low, spacing, shape)
        others = other.voxels(low, spacing, shape) if entries is not None else None
        if entries is not None and others is not None:
            break
        if shape.max() == 1:
            return  # a single voxel cannot separate any triangles
        spacing *= 2
    reached = [np.zeros(shape.prod(), bool) for _ in range(2)]
    reached[0][entries[1]], reached[1][others[1]] = True, True
    for soup, (owner, cell), shared in ((one, entries, reached[1]), (other, others, reached[0])):
        mask = np.zeros(len(soup.index), bool)
        mask[owner[shared[cell]]] = True
        soup.keep(mask)


@dataclass(frozen=True, eq=False)
class PairContact:
    """The contacts of two meshes that cross.

    Attributes:
        normals: Distinct contact normals, (K, 3) float64, unit, world frame.
        normals_a: Outward normals of the touching triangles of the first mesh, (C, 3).
        normals_b: Outward normals of the touching triangles of the second mesh, (C, 3).
        is_cut_short: Whether there may be more contacts than were requested.
    """

    normals: FloatArray
    normals_a: FloatArray
    normals_b: FloatArray
    is_cut_short: bool


class MeshPair:
    """Two meshes with repeated tests of whether they cross when the first is moved a little.

    Args:
        a: Triangles of the first mesh, (F, 3, 3) float64, metres, world frame.
        b: Triangles of the second mesh, (G, 3, 3).
        margin: The largest distance of a move of the first mesh, metres.
        budget: Counts the work of every test; without a limit by default.

    Raises:
        WorkLimitError: Here and in every test, if the budget is used up.
    """

    def __init__(
        self, a: FloatArray | PosedTriangles, b: FloatArray | PosedTriangles, margin: float, budget: WorkBudget | None = None
    ) -> None:
        first, second = posed_triangles(a), posed_triangles(b)
        self.budget = budget or WorkBudget()
        self.budget.spend(len(first.triangles) + len(second.triangles))
        index_a, index_b = near_triangles(first, second, margin)
        self._a, self._b = _Clusters(first, index_a), _Clusters(second, index_b)
        self._witnesses: dict[int, tuple[int, int]] = {}
        self._latest: tuple[int, int] | None = None

    @property
    def num_triangles(self) -> int:
        """Triangles of both meshes that are near the other mesh; the pair stores only these."""
        return self._a.num_triangles + self._b.num_triangles

    def cross(self, shift: tuple[float, float, float] | FloatArray = (0.0, 0.0, 0.0), direction: int = 0) -> bool:
        """Returns whether the meshes touch when the first is moved.

        Args:
            shift: The move, (3,), metres.
            direction: Any number for the direction of the move. The clusters that crossed last along it are tested first.
        """
        moved, result = np.asarray(shift, np.float64), fcl.CollisionResult()
        # Clusters that crossed at a nearby shift most likely cross again.
        tested = {clusters for clusters in (self._witnesses.get(direction), self._latest) if clusters is not None}
        if any(self._clusters_cross(*clusters, moved, result) for clusters in tested):
            return True
        for clusters in self._meeting_clusters(moved):
            if clusters not in tested and self._clusters_cross(*clusters, moved, result):
                self._witnesses[direction] = self._latest = clusters
                return True
        return False

    def contact(
        self, shift: tuple[float, float, float] | FloatArray = (0.0, 0.0, 0.0), *, every: bool = False
    ) -> PairContact | None:
        """Returns the contacts when the first mesh is moved; None without contact.

        Args:
            shift: The move, (3,), metres.
            every: All contacts instead of a few hundred.
        """
        normals, of_a, of_b = [], [], []
        moved, left = np.asarray(shift, np.float64), _EVERY_CONTACT if every else _MAX_CONTACTS
        for first, second in self._meeting_clusters(moved):
            result = fcl.CollisionResult()
            self.budget.spend(_CALL_WORK + self._a.size(first) + self._b.size(second))
            request = fcl.CollisionRequest(num_max_contacts=left, enable_contact=True)
            if fcl.collide(self._a.body(first, moved), self._b.body(second), request, result) == 0:
                continue
            contacts = result.contacts
            self.budget.spend(_CONTACT_WORK * len(contacts))
            normals += [c.normal for c in contacts]
            of_a.append(self._a.members(first)[[c.b1 for c in contacts]])
            of_b.append(self._b.members(second)[[c.b2 for c in contacts]])
            left -= len(contacts)
            if left <= 0:
                break
        if not normals:
            return None
        found = np.array(normals)
        found = found[np.linalg.norm(found, axis=1) > 0.5]  # FCL gives degenerate contacts a zero normal
        _, distinct = np.unique(np.round(found, 2), axis=0, return_index=True)
        touching_a, touching_b = (unit_normals(np.concatenate(triangles))[0] for triangles in (of_a, of_b))
        return PairContact(found[np.sort(distinct)], touching_a, touching_b, left <= 0)

    def _meeting_clusters(self, shift: FloatArray) -> Iterator[tuple[int, int]]:
        """Pairs of clusters whose boxes meet when the first mesh is moved, those with the largest common volume first."""
        (low, high), (other_low, other_high) = self._a.boxes, self._b.boxes
        self.budget.spend(low.shape[1] * other_low.shape[1] // _BOX_PAIRS)
        shared = np.ones((low.shape[1], other_low.shape[1]))
        for axis in range(3):
            lowest = np.maximum((low[axis] + shift[axis])[:, None], other_low[axis])
            extent = np.minimum((high[axis] + shift[axis])[:, None], other_high[axis]) - lowest
            shared *= np.where(extent < 0, 0.0, extent + 1e-4)  # boxes that only touch count too
        first, second = np.nonzero(shared)
        order = np.argsort(-shared[first, second], kind="stable")
        return zip(first[order].tolist(), second[order].tolist(), strict=True)

    def _clusters_cross(self, first: int, second: int, shift: FloatArray, result: fcl.CollisionResult) -> bool:
        self.budget.spend(_CALL_WORK + self._a.size(first) + self._b.size(second))
        return bool(fcl.collide(self._a.body(first, shift), self._b.body(second), _ANY_CONTACT, result) > 0)


class _Clusters:
    """Neighbouring triangles of a mesh in groups, each with a box and, after its first query, a tree."""

    def __init__(self, surface: PosedTriangles, index: IntArray) -> None:
        low, high = (bound[:, index] for bound in surface.boxes)
        if len(index) > 2 * _CLUSTER:
            centre = low + high
            least = centre.min(axis=1, keepdims=True)
            # Twice the centres, in 32 cells along the longest side.
            cell = ((centre - least) * (31.999 / max(float((centre - least).max()), 1e-12))).astype(np.uint8)
            order = np.argsort(_MORTON[cell[0]] | _MORTON[cell[1]] << 1 | _MORTON[cell[2]] << 2, kind="stable")
            index, low, high = index[order], low[:, order], high[:, order]
        self._triangles = surface.triangles[index]
        starts = np.arange(0, len(index), _CLUSTER)
        self.boxes = tuple(
            f.reduceat(x, starts, axis=1) if len(index) else x for f, x in ((np.minimum, low), (np.maximum, high))
        )
        self._bodies: dict[int, fcl.CollisionObject] = {}

    @property
    def num_triangles(self) -> int:
        return len(self._triangles)

    def size(self, cluster: int) -> int:
        """Number of triangles of a cluster."""
        return min(_CLUSTER, len(self._triangles) - cluster * _CLUSTER)

    def members(self, cluster: int) -> FloatArray:
        return self._triangles[cluster * _CLUSTER : (cluster + 1) * _CLUSTER]

    def body(self, cluster: int, shift: FloatArray | None = None) -> fcl.CollisionObject:
        """A cluster as an FCL object, moved by a vector (3,)."""
        if cluster not in self._bodies:
            self._bodies[cluster] = fcl.CollisionObject(_tree(self.members(cluster)))
        if shift is not None:
            self._bodies[cluster].setTranslation(shift)
        return self._bodies[cluster]


def _tree(triangles: FloatArray) -> fcl.BVHModel:
    model = fcl.BVHModel()
    model.beginModel(3 * len(triangles), len(triangles))
    model.addSubModel(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    model.endModel()
    return model
