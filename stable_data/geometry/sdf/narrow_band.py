"""The nodes of a signed-distance grid, and their unsigned distances to the surface.

The corners of the cells that contain the surface get exact distances. Every other node uses the surface point that the nearest of
these corners found.
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
_SAMPLE_GAP = 0.5  # largest distance from the surface to its nearest sample, spacings
_MAX_COUNT = 3 << 12  # largest number of rows or columns of samples of one face
_ALLOWED_COUNTS = np.sort(np.concatenate([1 << np.arange(14), 3 << np.arange(13)]))
_MAX_SAMPLES = 1 << 20  # in memory at a time
_SEED_DISTANCE = 0.72  # spacings from the surface within which a band node passes on its surface point
_NEIGHBOUR_DISTANCE = 2.75  # spacings within which a node also tries the points of its neighbours and measures to a face

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class GridNodes:
    """The positions of the nodes of a grid."""

    origin: FloatArray
    spacing: float
    shape: tuple[int, int, int]

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def lines(self) -> list[FloatArray]:
        """Coordinates of the grid lines along x, y and z."""
        return [self.origin[a] + self.spacing * np.arange(self.shape[a]) for a in _AXES]

    def places(self, nodes: IntArray) -> FloatArray:
        """Coordinates of flat node indices, (K, 3)."""
        return self.origin + self.spacing * np.stack(np.unravel_index(nodes, self.shape), axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class NarrowBand:
    """The B nodes beside the surface, with exact values.

    Attributes:
        nodes: Flat indices, ascending, (B,) int64.
        distance: Without sign, (B,).
        away: Unit vectors from the nearest surface point to the node, (B, 3); 0 on the surface.
        place: Nearest surface points, (B, 3).
        face: The faces of those points, (B,) int64.
        is_behind: The node is straight behind the inner part of its nearest face, (B,) bool.
    """

    nodes: IntArray
    distance: FloatArray
    away: FloatArray
    place: FloatArray
    face: IntArray
    is_behind: BoolArray

    @classmethod
    def around(cls, exact: SignedDistance, lattice: GridNodes) -> "NarrowBand":
        """Computes the band: the corners of all cells that contain the surface, each with its exact distance."""
        nodes = _surface_nodes(exact.mesh.triangles, lattice)
        start = lattice.places(nodes)
        distance, face, place = exact.nearest(start)
        away = (start - place) / np.maximum(distance, np.finfo(np.float64).tiny)[:, None]
        # A node whose nearest point is on an edge or a corner is not exactly opposite to the normal.
        is_behind = _dot(away, unit_normals(exact.mesh.triangles[face])[0]) < -1 + 1e-9
        return cls(nodes, distance, away, place, face, is_behind)


def unsigned_distances(exact: SignedDistance, lattice: GridNodes, band: NarrowBand) -> FloatArray:
    """Computes the unsigned distance at every node, exact in the band, in the grid's shape.

    Every other node uses the surface point of the nearest band node that is close to the surface. A node near the surface also tries
    the points of its neighbours, and measures to the whole face of the best one. So a distance is never too short.
    """
    slot = np.full(lattice.size, -1, np.int32)
    seed = np.flatnonzero(band.distance <= max(_SEED_DISTANCE * lattice.spacing, band.distance.min()))
    slot[band.nodes[seed]] = seed
    slot = slot.reshape(lattice.shape)
    x, y, z = ndimage.distance_transform_edt(slot < 0, return_distances=False, return_indices=True)
    source = slot[x, y, z].ravel()
    at = np.stack(np.meshgrid(*lattice.lines(), indexing="ij")).reshape(3, -1).astype(np.float32)
    place = np.ascontiguousarray(band.place.T, np.float32)
    distance = np.sqrt(_squared(at, place, source), dtype=np.float64)
    is_near = distance < _NEIGHBOUR_DISTANCE * lattice.spacing
    is_near[band.nodes] = False
    near = np.flatnonzero(is_near)
    chosen = _best_of_neighbours(near, source, at[:, near], place, lattice)
    distance[near] = distance_to_faces(lattice.places(near), exact.mesh.triangles[band.face[chosen]])
    distance[band.nodes] = band.distance
    return distance.reshape(lattice.shape)


def _best_of_neighbours(
    near: IntArray, source: npt.NDArray[np.int32], at: Float32Array, place: Float32Array, lattice: GridNodes
) -> npt.NDArray[np.int32]:
    """Returns the nearest of the surface points that a node and its six neighbours use, for the given nodes, (K,)."""
    _, ny, nz = lattice.shape
    held = source[near]
    least = _squared(at, place, held)
    for stride in (ny * nz, nz, 1, -1, -nz, -ny * nz):
        # Past an edge of the grid this offers a point from elsewhere; it is no nearer and does no harm.
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
    """Dot products of rows, (P,)."""
    found: FloatArray = np.einsum("ij,ij->i", a, b)
    return found


def distance_to_faces(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distances (P,) float64 of points (P, 3), each to its own triangle, corners (P, 3, 3)."""
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
    # The distance to the plane counts if the point projects into the triangle, else the nearest side.
    height = _dot(out[0], normal)
    straight = height * height / np.maximum(area, np.finfo(np.float64).tiny)
    return np.sqrt(np.where(is_over, straight, squared))


def _surface_nodes(triangles: FloatArray, lattice: GridNodes) -> IntArray:
    """Flat indices, ascending, of the corners of every cell that contains a sample of the surface."""
    mark = np.zeros(lattice.size, np.bool_)
    _, ny, nz = lattice.shape
    for samples in _samples(((triangles - lattice.origin) / lattice.spacing).astype(np.float32)):
        x, y, z = samples.astype(np.int32)
        mark[(x * ny + y) * nz + z] = True
    nodes = mark.reshape(lattice.shape)
    for axis in _AXES:  # from a cell to all its corners, axis by axis
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        nodes[tuple(high)] |= nodes[tuple(low)].copy()
    return np.flatnonzero(nodes)


def _samples(triangles: Float32Array) -> Iterator[Float32Array]:
    """Yields samples of the faces, in nodes, (3, ...) each, so dense that every point of a face is within `_SAMPLE_GAP` of one.

    Faces with similar numbers of rows and columns are sampled together. Rows run from the corner opposite the shortest side to it.
    """
    length = np.linalg.norm(np.roll(triangles, -1, axis=1) - np.roll(triangles, -2, axis=1), axis=2)  # of the opposite side
    order = (length.argmin(axis=1)[:, None] + np.arange(3)) % 3
    apex, b, c = np.take_along_axis(triangles, order[:, :, None], axis=1).transpose(1, 2, 0)  # (3, F) each
    rows, columns = _round_up_count(length.max(axis=1) / _SAMPLE_GAP), _round_up_count(length.min(axis=1) / _SAMPLE_GAP)
    kind = rows * (_MAX_COUNT + 1) + columns
    for each in np.unique(kind):
        face = np.flatnonzero(kind == each)
        num_rows, num_columns = divmod(int(each), _MAX_COUNT + 1)
        per_turn = max(1, _MAX_SAMPLES // (num_rows * num_columns))
        s = ((np.arange(num_rows, dtype=np.float32) + np.float32(0.5)) / num_rows)[:, None]
        t = ((np.arange(num_columns, dtype=np.float32) + np.float32(0.5)) / num_columns)[None, :]
        for turn in range(0, len(face), per_turn):
            corner, along, across = (x[:, face[turn : turn + per_turn], None, None] for x in (apex, b - apex, c - b))
            yield corner + s * along + (s * t) * across


def _round_up_count(count: Float32Array) -> IntArray:
    """Rounds up to one of 1, 2, 3, 4, 6, 8, 12, 16 ... so that few groups of faces remain, (F,) int64."""
    return _ALLOWED_COUNTS[np.searchsorted(_ALLOWED_COUNTS, np.minimum(count, _MAX_COUNT))]
