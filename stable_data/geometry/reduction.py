"""Surfaces of any size as one mesh: welded, and reduced to a number of triangles, with the distance that this moves the surface."""

from collections.abc import Iterator, Sequence

import fast_simplification
import igl
import numpy as np

from stable_data.errors import MeshError
from stable_data.geometry.mesh import WELD, Mesh, double_areas, drop_unused_vertices, weld_vertices
from stable_data.geometry.surface_sampling import sample_surface
from stable_data.scene import FloatArray, IntArray

_CHUNK = 1_000_000  # triangles whose corners are clustered at a time
_MOST_EXACT = 2_000_000  # triangles beyond which vertices are clustered first
_SLACK = 1.2  # a reduced mesh may have this many more faces than asked for
_CLUSTERS = (1024, 768, 512, 384, 256, 192, 128, 64)  # cells along the largest extent, the finest first
_SMALLEST = 1e-30  # squares and cubes of smaller extents, or of extents above its inverse, leave the range of a double
_FLAT = 1e-12  # a face of a smaller area, share of the squared extent, does not count
_NUM_PROBES = 8192
_LEAST_PROBES = 256
_MOST_COMPARED = 3_000_000  # triangles that are compared with points, about a second


def join_triangles(soups: Sequence[FloatArray], asset_id: str) -> tuple[Mesh, float]:
    """Welds triangles to one mesh, in which each is once; more than two million are clustered first.

    Args:
        soups: Triangles of several surfaces, (F, 3, 3) each, any unit.
        asset_id: The asset, for messages.

    Returns:
        The mesh, in the frame of the triangles, without unused vertices; and a bound of the distance by which clustering moved it.

    Raises:
        MeshError: ``mesh_empty``: no triangle has an area; ``mesh_not_finite``: a corner is not finite, or too far away.
    """
    soups = [soup for soup in soups if len(soup)]
    if not soups:
        raise MeshError(f"asset {asset_id}: has no triangle, expected a surface; export it again", "mesh_empty")
    with np.errstate(over="ignore", invalid="ignore"):
        low = np.min([soup.min(axis=(0, 1)) for soup in soups], axis=0)
        extent = float((np.max([soup.max(axis=(0, 1)) for soup in soups], axis=0) - low).max())
    if not np.isfinite(extent) or extent >= 1 / _SMALLEST:  # a NaN anywhere makes the smallest value NaN
        message = f"asset {asset_id}: a vertex is not finite, or too far from the others, expected finite coordinates; export it again"
        raise MeshError(message, "mesh_not_finite")
    moved = 0.0
    if extent <= _SMALLEST:
        vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    elif sum(map(len, soups)) > _MOST_EXACT:
        vertices, faces, moved = _clustered(soups, low, extent)
    else:
        corners = np.concatenate([soup.reshape(-1, 3) for soup in soups])
        vertices, faces = weld_vertices(corners, np.arange(len(corners)).reshape(-1, 3), WELD * extent)
        faces = faces[np.sort(np.unique(_turned(faces), axis=0, return_index=True)[1])]  # each once
    mesh = Mesh(*drop_unused_vertices(vertices, faces))
    if not len(faces) or not (double_areas(mesh) > _FLAT * extent * extent).any():
        num = sum(map(len, soups))
        raise MeshError(
            f"asset {asset_id}: none of {num} triangles has an area, expected a surface; export it again", "mesh_empty"
        )
    return mesh, moved


def _clustered(soups: Sequence[FloatArray], low: FloatArray, extent: float) -> tuple[FloatArray, IntArray, float]:
    """Clusters vertices on the finest grid that leaves few enough faces; and a bound of the distance that this moves them."""
    for cells in _CLUSTERS:
        step = extent / cells
        keys = _faces_of_cells(soups, low, step)
        if len(keys) <= _MOST_EXACT:
            break
    return *_meshed(keys, soups, low, step), float(np.sqrt(3) * step)


def _faces_of_cells(soups: Sequence[FloatArray], low: FloatArray, step: float) -> IntArray:
    """The faces between different grid cells, (F, 3) keys of cells."""
    return np.concatenate([_distinct(_keys(chunk, low, step)) for chunk in _chunks(soups)])


def _meshed(keys: IntArray, soups: Sequence[FloatArray], low: FloatArray, step: float) -> tuple[FloatArray, IntArray]:
    """Vertices at the means of the corners in each cell, and the faces (F, 3) between them."""
    labels, faces = np.unique(keys, return_inverse=True)
    sums, counts = np.zeros((len(labels), 3)), np.zeros(len(labels))
    for chunk in _chunks(soups):
        key = _keys(chunk, low, step).ravel()
        place = np.minimum(np.searchsorted(labels, key), len(labels) - 1)
        is_used = labels[place] == key
        points, place = chunk.reshape(-1, 3)[is_used], place[is_used]
        counts += np.bincount(place, minlength=len(labels))
        sums += np.stack([np.bincount(place, points[:, axis], len(labels)) for axis in range(3)], axis=1)
    return sums / counts[:, None], faces.reshape(-1, 3).astype(np.int64)


def _chunks(soups: Sequence[FloatArray]) -> Iterator[FloatArray]:
    for soup in soups:
        for start in range(0, len(soup), _CHUNK):
            yield soup[start : start + _CHUNK]


def _keys(chunk: FloatArray, low: FloatArray, step: float) -> IntArray:
    """The grid cell of each corner, (F, 3)."""
    grid = ((chunk - low) / step).astype(np.int64)
    return np.asarray((grid[..., 0] << 24) | (grid[..., 1] << 12) | grid[..., 2])


def _distinct(keys: IntArray) -> IntArray:
    """Faces whose corners are in three cells, each set of cells once in each direction."""
    a, b, c = keys.T
    kept = keys[(a != b) & (b != c) & (c != a)]
    return np.unique(_turned(kept), axis=0)


def _turned(faces: IntArray) -> IntArray:
    """Faces (F, 3) with the smallest of their corners first, so that the same face has the same corners."""
    first = faces.argmin(axis=1)[:, None]
    return np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)


def reduce_mesh(mesh: Mesh, max_faces: int) -> tuple[Mesh, float]:
    """Reduces a mesh by quadric collapse.

    Args:
        mesh: Any unit.
        max_faces: Number of triangles, which the result may exceed by a fifth.

    Returns:
        The mesh itself if it is small enough, else the reduced one; and the largest distance between the two, sampled both ways.
    """
    if len(mesh.faces) <= max_faces:
        return mesh, 0.0
    low, extent = mesh.vertices.min(axis=0), float(mesh.extents.max())
    reduced = mesh
    for cells in (0, *_CLUSTERS[1:]):  # a mesh of slivers only collapses after its vertices are clustered
        source = _clustered_mesh(mesh, low, extent / cells) if cells else mesh
        unit = ((source.vertices - low) / extent).astype(np.float32)
        vertices, faces = fast_simplification.simplify(unit, source.faces.astype(np.int32), target_count=max_faces)
        reduced = Mesh(*drop_unused_vertices(vertices.astype(np.float64) * extent + low, faces.astype(np.int64)))
        if len(reduced.faces) <= _SLACK * max_faces:
            break
    return reduced, max(_reach(mesh, reduced), _reach(reduced, mesh))


def _clustered_mesh(mesh: Mesh, low: FloatArray, step: float) -> Mesh:
    soups = [mesh.triangles]
    return Mesh(*_meshed(_faces_of_cells(soups, low, step), soups, low, step))


def _reach(one: Mesh, other: Mesh) -> float:
    """Largest distance of points on one surface from another.

    Where hundreds of layers of triangles lie in each other, it is that of fewer points, and may be found too small.
    """
    most = int(_MOST_COMPARED / (1 + _num_layers(other)))
    points = sample_surface(one, min(_NUM_PROBES, max(_LEAST_PROBES, most)))
    squared = igl.point_mesh_squared_distance(points, other.vertices, other.faces)[0]
    return float(np.sqrt(squared.max()))


def _num_layers(mesh: Mesh) -> float:
    """How many boxes of triangles a straight line through the box of a mesh meets, on average: by the areas of the boxes."""
    triangles = mesh.triangles
    areas = [(x * y + y * z + z * x).sum() for x, y, z in (np.ptp(triangles, axis=1).T, mesh.extents[:, None])]
    return float(areas[0] / areas[1])
