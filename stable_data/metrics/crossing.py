"""Do two meshes cross? Exact triangle tests on the few triangles that are near the other mesh.

Building a bounding-volume tree for a whole mesh costs far more than asking it. Almost no triangle of a pair is near the
other mesh, so both meshes are first thinned on a shared voxel grid, which is exact (a triangle that is dropped shares no
voxel with any triangle of the other mesh), and trees are built for what is left.
"""

from dataclasses import dataclass
from typing import TypeAlias

import fcl
import numpy as np
import numpy.typing as npt

from stable_data.scene import FloatArray, IntArray

_MAX_CONTACTS = 256
_CELLS = 24  # voxels along the longest edge of the shared region, at most
_MAX_ENTRIES = 60_000  # (triangle, voxel) pairs before a coarser grid is taken
_FEW = 64  # triangles for which thinning costs more than a tree

BoolArray: TypeAlias = npt.NDArray[np.bool_]


def boxes(triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner of each triangle's box.

    Args:
        triangles: (F, 3, D) float64.

    Returns:
        Two (D, F) float64: coordinates first, because reductions over a short last axis are slow.
    """
    a, b, c = (np.ascontiguousarray(triangles[:, k].T) for k in range(3))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


class _Soup:
    """Triangles of one mesh, with their boxes, that become fewer and fewer."""

    def __init__(self, triangles: FloatArray, margin: float) -> None:
        self.index = np.arange(len(triangles))
        self.triangles = triangles
        self.margin = margin
        self.low, self.high = boxes(triangles)
        if margin:
            self.low, self.high = self.low - margin, self.high + margin

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
        """(triangle, voxel) for each voxel that a triangle may reach into, or None where there are too many."""
        first = np.clip((self.low - origin[:, None]) // spacing, 0, shape[:, None] - 1).astype(np.int64)
        last = np.clip((self.high - origin[:, None]) // spacing, 0, shape[:, None] - 1).astype(np.int64)
        span = last - first + 1
        count = span[0] * span[1] * span[2]
        total = int(count.sum())
        if total > _MAX_ENTRIES:
            return None
        owner = np.repeat(np.arange(len(self.index)), count)
        step = np.arange(total) - np.repeat(np.cumsum(count) - count, count)
        span_z, span_yz = span[2][owner], (span[1] * span[2])[owner]
        x = first[0][owner] + step // span_yz
        y = first[1][owner] + step % span_yz // span_z
        z = first[2][owner] + step % span_z
        reached = self._reach(owner, count, origin, spacing, (x, y, z))
        return owner[reached], ((x * shape[1] + y) * shape[2] + z)[reached]

    def _reach(
        self, owner: IntArray, count: IntArray, origin: FloatArray, spacing: float, cell: tuple[IntArray, IntArray, IntArray]
    ) -> BoolArray:
        """Which voxels the plane of their triangle passes: the box of a large slanted triangle is mostly empty."""
        reached = np.ones(len(owner), bool)
        large = np.nonzero(count[owner] > 8)[0]
        if len(large):
            of = owner[large]
            normals = unit_normals(self.triangles)
            offset = np.einsum("ij,ij->i", normals, self.triangles[:, 0])
            distance = -offset[of]
            for axis in range(3):
                distance += normals[of, axis] * (origin[axis] + (cell[axis][large] + 0.5) * spacing)
            reach = (spacing / 2 + self.margin) * np.abs(normals).sum(axis=1) + 1e-9
            reached[large] = np.abs(distance) <= reach[of]
        return reached


def near_triangles(a: FloatArray, b: FloatArray, margin: float) -> tuple[IntArray, IntArray]:
    """Triangles that may come within a distance of the other mesh: a superset, exact in what it drops.

    Args:
        a: Triangles, (F, 3, 3) float64, metres, world frame.
        b: The other mesh's, (G, 3, 3).
        margin: How far either mesh may be moved along each axis, metres.

    Returns:
        Indices into ``a`` and into ``b``, int64.
    """
    one, other = _Soup(a, margin), _Soup(b, 0.0)
    none = np.arange(0)
    for _ in range(4):
        if not len(one.index) or not len(other.index):
            return none, none
        low = np.maximum(one.low.min(axis=1), other.low.min(axis=1))
        high = np.minimum(one.high.max(axis=1), other.high.max(axis=1))
        if (low > high).any():
            return none, none
        one.crop(low, high)
        other.crop(low, high)
        before = len(one.index) + len(other.index)
        if before <= _FEW or not len(one.index) or not len(other.index):
            break
        _thin(one, other, low, high)
        if len(one.index) + len(other.index) > 0.8 * before:
            break
    return (one.index, other.index) if len(one.index) and len(other.index) else (none, none)


def _thin(one: _Soup, other: _Soup, low: FloatArray, high: FloatArray) -> None:
    """Keeps the triangles of each that share a voxel of a region with a triangle of the other."""
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
            return
        spacing *= 2
    reached = [np.zeros(shape.prod(), bool) for _ in range(2)]
    reached[0][entries[1]], reached[1][others[1]] = True, True
    for soup, (owner, cell), there in ((one, entries, reached[1]), (other, others, reached[0])):
        mask = np.zeros(len(soup.index), bool)
        mask[owner[there[cell]]] = True
        soup.keep(mask)


@dataclass(frozen=True, eq=False)
class PairContact:
    """Where two meshes cross.

    Attributes:
        normals: Distinct contact normals, (K, 3) float64, unit, world frame.
        normals_a: Outward normals of the touching triangles of the first mesh, (C, 3).
        normals_b: Of the second mesh, (C, 3).
    """

    normals: FloatArray
    normals_a: FloatArray
    normals_b: FloatArray


class MeshPair:
    """Two meshes that may be asked, again and again, whether they cross when the first is moved a little.

    Args:
        a: Triangles of the first, (F, 3, 3) float64, metres, world frame.
        b: Triangles of the second, (G, 3, 3).
        margin: The farthest that the first will be moved, metres.
    """

    def __init__(self, a: FloatArray, b: FloatArray, margin: float) -> None:
        index_a, index_b = near_triangles(a, b, margin)
        self._a, self._b = a[index_a], b[index_b]
        self._trees = (_tree(self._a), _tree(self._b)) if len(index_a) and len(index_b) else None

    def cross(self, shift: tuple[float, float, float] | FloatArray = (0.0, 0.0, 0.0)) -> bool:
        """Do they touch when the first is moved by a vector (3,), metres?"""
        if self._trees is None:
            return False
        return bool(fcl.collide(*self._bodies(shift), fcl.CollisionRequest(), fcl.CollisionResult()) > 0)

    def contact(self, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PairContact | None:
        """Where they touch when the first is moved by a vector (3,), metres; None where they do not."""
        if self._trees is None:
            return None
        result = fcl.CollisionResult()
        request = fcl.CollisionRequest(num_max_contacts=_MAX_CONTACTS, enable_contact=True)
        if fcl.collide(*self._bodies(shift), request, result) == 0:
            return None
        contacts = result.contacts
        normals = np.array([c.normal for c in contacts]).reshape(-1, 3)
        normals = normals[np.linalg.norm(normals, axis=1) > 0.5]
        _, first = np.unique(np.round(normals, 2), axis=0, return_index=True)
        return PairContact(
            normals[np.sort(first)], unit_normals(self._a[[c.b1 for c in contacts]]), unit_normals(self._b[[c.b2 for c in contacts]])
        )

    def _bodies(self, shift: tuple[float, float, float] | FloatArray) -> tuple[fcl.CollisionObject, fcl.CollisionObject]:
        assert self._trees is not None
        return fcl.CollisionObject(self._trees[0], fcl.Transform(np.asarray(shift, np.float64))), fcl.CollisionObject(self._trees[1])


def unit_normals(triangles: FloatArray) -> FloatArray:
    """Unit normals of triangles (F, 3, 3), (F, 3) float64; zero where a triangle has no area."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: FloatArray = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return unit


def _tree(triangles: FloatArray) -> fcl.BVHModel:
    model = fcl.BVHModel()
    model.beginModel(3 * len(triangles), len(triangles))
    model.addSubModel(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    model.endModel()
    return model
