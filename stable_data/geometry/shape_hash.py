"""A hash of a shape that copies of one mesh share, whatever the order of their faces, their size, place and turn."""

import hashlib

import numpy as np

from stable_data.geometry.mesh import Edges, Mesh, double_areas
from stable_data.scene import FloatArray

_SHARES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)  # of the lengths that are compared


def shape_hash(mesh: Mesh) -> str:
    """Returns 32 hexadecimal digits.

    It covers the numbers of vertices, edges and faces, and to three digits the moments of the surface, the lengths of edges, and the
    distances of vertices from the middle, relative to the size. Mirrored meshes have the same hash.

    Args:
        mesh: Welded, any unit; at least one face has an area.
    """
    areas = double_areas(mesh)
    corners, weights = mesh.triangles.mean(axis=1), areas / areas.sum()
    middle = weights @ corners
    size = float(np.sqrt(areas.sum()))
    spread = (corners - middle) / size
    moments = np.sqrt(np.maximum(np.linalg.eigvalsh((spread * weights[:, None]).T @ spread), 0))
    edges = Edges.of(mesh.faces)
    lengths = np.linalg.norm(np.diff(mesh.vertices[edges.corners], axis=1)[:, 0], axis=1) / size
    distances = np.linalg.norm(mesh.vertices - middle, axis=1) / size
    numbers = [*_rounded(moments), *_rounded(np.quantile(lengths, _SHARES)), *_rounded(np.quantile(distances, _SHARES))]
    text = repr((len(mesh.vertices), len(edges.corners), len(mesh.faces), numbers))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _rounded(values: FloatArray) -> list[float]:
    """Numbers to three digits after the point; they are at most a few units."""
    return [round(float(value), 3) + 0.0 for value in values]
