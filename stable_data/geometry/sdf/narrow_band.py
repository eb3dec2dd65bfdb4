"""The nodes of a signed-distance grid, and how far each is from the surface, without sign.

The corners of the cells that hold the surface are asked exactly; every other node measures to the surface point that the
nearest of them found.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stable_data.geometry.mesh import unit_normals
from stable_data.geometry.sdf.exact import BoolArray, SignedDistance
from stable_data.scene import FloatArray, IntArray

_AXES = (0, 1, 2)
_SAMPLE_GAP = 0.5  # spacings between the surface and its nearest sample, at most
_MANY = 3 << 12  # rows or columns of samples of one face, at most
_STEPS_OF_COUNT = np.sort(np.concatenate([1 << np.arange(14), 3 << np.arange(13)]))
_MAX_SAMPLES = 1 << 20  # held at a time
_SEED = 0.72  # spacings from the surface within which a band node passes its surface point on
_REACH = 2.75  # spacings within which a node tries the points of its neighbours and measures to a face

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class GridNodes:
    """Where the nodes of a grid are."""

    origin: FloatArray
    spacing: float
    shape: tuple[int, int, int]

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def lines(self) -> list[FloatArray]:
        """Coordinates along x, y and z."""
        return [self.origin[a] + self.spacing * np.arange(self.shape[a]) for a in _AXES]

    def places(self, nodes: IntArray) -> FloatArray:
        """Coordinates of flat node indices, (K, 3)."""
        return self.origin + self.spacing * np.stack(np.unravel_index(nodes, self.shape), axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class NarrowBand:
    """The nodes beside the surface, B of them, and what is exact about them.

    Attributes:
        nodes: Flat indices, ascending, (B,) int64.
        distance: Without sign, (B,).
        away: Unit vectors from the nearest surface point to the node, (B, 3); 0 on the surface.
        place: Nearest surface points, (B, 3).
        face: The faces that those lie on, (B,) int64.
        is_behind: The node lies straight behind the inner part of its nearest face, (B,) bool.
    """

    nodes: IntArray
    distance: FloatArray
    away: FloatArray
    place: FloatArray
    face: IntArray
    is_behind: BoolArray

    @classmethod
    def around(cls, exact: SignedDistance, lattice: GridNodes) -> "NarrowBand":
        """The nodes of the cells that hold the surface, asked one by one."""
        nodes = _surface_nodes(exact.mesh.triangles, lattice)
        start = lattice.places(nodes)
        distance, face, place = exact.nearest(start)
        away = (start - place) / np.maximum(distance, np.finfo(np.float64).tiny)[:, None]
        # Straight: the foot of a node on an edge or a corner is not opposite to the normal.
        is_behind = _dot(away, unit_normals(exact.mesh.triangles[face])[0]) < -1 + 1e-9
        return cls(nodes, distance, away, place, face, is_behind)


def unsigned_distances(exact: SignedDistance, lattice: GridNodes, band: NarrowBand) -> FloatArray:
    """Distance without sign at every node, exact in the band, the grid's shape.

    Every other node measures to the surface point of the nearest band node that lies close to the surface. Where the node is
    near itself it tries the points of its neighbours too, and measures to the whole face that the best is on. So a distance is
    never too short.
    """
    slot = np.full(lattice.size, -1, np.int32)
    seed = np.flatnonzero(band.distance <= max(_SEED * lattice.spacing, band.distance.min()))
    slot[band.nodes[seed]] = seed
    slot = slot.reshape(lattice.shape)
    x, y, z = ndimage.distance_transform_edt(slot < 0, return_distances=False, return_indices=True)
    source = slot[x, y, z].ravel()
    at = np.stack(np.meshgrid(*lattice.lines(), indexing="ij")).reshape(3, -1).astype(np.float32)
    place = np.ascontiguousarray(band.place.T, np.float32)
    distance = np.sqrt(_squared(at, place, source), dtype=np.float64)
    is_near = distance < _REACH * lattice.spacing
    is_near[band.nodes] = False
    near = np.flatnonzero(is_near)
    chosen = _best_of_neighbours(near, source, at[:, near], place, lattice)
    distance[near] = distance_to_faces(lattice.places(near), exact.mesh.triangles[band.face[chosen]])
    distance[band.nodes] = band.distance
    return distance.reshape(lattice.shape)


def _best_of_neighbours(
    near: IntArray, source: npt.NDArray[np.int32], at: Float32Array, place: Float32Array, lattice: GridNodes
) -> npt.NDArray[np.int32]:
    """Of the surface points that a node and its six neighbours know the nearest to the node, for the nodes given, (K,)."""
    _, ny, nz = lattice.shape
    held = source[near]
    least = _squared(at, place, held)
    for stride in (ny * nz, nz, 1, -1, -nz, -ny * nz):
        # Past an edge of the grid this offers a point from elsewhere, which is no nearer and does no harm.
        offered = source.take(near + stride, mode="clip")
        other = np.flatnonzero(offered != held)
        squared = _squared(at[:, other], place, offered[other])
        is_better = squared < least[other]
        other = other[is_better]
        held[other], least[other] = offered[other], squared[is_better]
    return held


def _squared(at: Float32Array, place: Float32Array, chosen: npt.NDArray[np.int32]) -> Float32Array:
    """Squared distances of places to chosen points, both (3, ...)."""
    dx, dy, dz = (a - p[chosen] for a, p in zip(at, place, strict=True))
    found: Float32Array = dx * dx + dy * dy + dz * dz
    return found


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Row by row, (P,)."""
    found: FloatArray = np.einsum("ij,ij->i", a, b)
    return found


def distance_to_faces(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance of each point to its own triangle.

    Args:
        points: (P, 3) float64.
        triangles: Corners, (P, 3, 3) float64.

    Returns:
        Distances, (P,) float64.
    """
    corner = triangles.transpose(1, 0, 2)
    side = np.roll(corner, -1, axis=0) - corner
    out = points - corner
    normal = np.cross(side[0], side[1])
    area = _dot(normal, normal)
    is_over = area > 0
    squared = np.full(len(points), np.inf)
    for a, e in zip(out, side, strict=True):
        length = _dot(e, e)
        along = np.clip(_dot(a, e) / np.maximum(length, np.finfo(np.float64).tiny), 0, 1)
        gap = a - along[:, None] * e
        squared = np.minimum(squared, _dot(gap, gap))
        is_over &= _dot(np.cross(e, a), normal) >= 0
    height = _dot(out[0], normal)
    straight = height * height / np.maximum(area, np.finfo(np.float64).tiny)
    return np.sqrt(np.where(is_over, straight, squared))


def _surface_nodes(triangles: FloatArray, lattice: GridNodes) -> IntArray:
    """Flat indices, ascending, of the corners of every cell that a sample of the surface lies in."""
    mark = np.zeros(lattice.size, np.bool_)
    _, ny, nz = lattice.shape
    for samples in _samples(((triangles - lattice.origin) / lattice.spacing).astype(np.float32)):
        x, y, z = samples.astype(np.int32)
        mark[(x * ny + y) * nz + z] = True
    nodes = mark.reshape(lattice.shape)
    for axis in _AXES:
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        nodes[tuple(high)] |= nodes[tuple(low)].copy()
    return np.flatnonzero(nodes)


def _samples(triangles: Float32Array) -> Iterator[Float32Array]:
    """Points of the faces, in nodes, none of whose points is farther than `_SAMPLE_GAP` from one, (3, ...) at a time.

    Faces that want about as many rows and columns are done together; rows run from the corner opposite the shortest side to it.
    """
    length = np.linalg.norm(np.roll(triangles, -1, axis=1) - np.roll(triangles, -2, axis=1), axis=2)  # of the side opposite
    order = (length.argmin(axis=1)[:, None] + np.arange(3)) % 3
    apex, b, c = np.take_along_axis(triangles, order[:, :, None], axis=1).transpose(1, 2, 0)  # (3, F) each
    rows, columns = _rounded_up(length.max(axis=1) / _SAMPLE_GAP), _rounded_up(length.min(axis=1) / _SAMPLE_GAP)
    kind = rows * (_MANY + 1) + columns
    for each in np.unique(kind):
        face = np.flatnonzero(kind == each)
        num_rows, num_columns = divmod(int(each), _MANY + 1)
        per_turn = max(1, _MAX_SAMPLES // (num_rows * num_columns))
        s = ((np.arange(num_rows, dtype=np.float32) + np.float32(0.5)) / num_rows)[:, None]
        t = ((np.arange(num_columns, dtype=np.float32) + np.float32(0.5)) / num_columns)[None, :]
        for turn in range(0, len(face), per_turn):
            corner, along, across = (x[:, face[turn : turn + per_turn], None, None] for x in (apex, b - apex, c - b))
            yield corner + s * along + (s * t) * across


def _rounded_up(count: Float32Array) -> IntArray:
    """The next of 1, 2, 3, 4, 6, 8, 12, 16 ... so that few kinds of faces are left, (F,) int64."""
    return _STEPS_OF_COUNT[np.searchsorted(_STEPS_OF_COUNT, np.minimum(count, _MANY))]
