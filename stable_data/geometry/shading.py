"""Normals of surfaces as they are seen: smooth but for sharp edges."""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from stable_data.geometry.mesh import Edges, area_vectors, unit_normals
from stable_data.scene import FloatArray, IntArray

CREASE = float(np.cos(np.radians(35)))
"""An edge is sharp if the normals of its two faces have a smaller cosine."""

_WELD = 1e-6  # share of the largest extent; nearer corners are one


def corner_normals(triangles: FloatArray) -> FloatArray:
    """Computes the normals of the corners of triangles (F, 3, 3), in their shape, with length 1.

    A normal is the mean of the faces around the corner up to the next sharp edges, by area; that of the face without area is up.
    """
    vertices, faces = welded_corners(triangles)
    faces = split_at_creases(vertices, faces)[1]
    sums = np.zeros((int(faces.max()) + 1, 3))
    np.add.at(sums, faces.ravel(), area_vectors(triangles).repeat(3, axis=0))
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    normals = np.divide(sums, length, out=np.tile([0.0, 0.0, 1.0], (len(sums), 1)), where=length > 0)
    return np.asarray(normals[faces])


def welded_corners(triangles: FloatArray) -> tuple[FloatArray, IntArray]:
    """Joins equal corners of triangles (F, 3, 3): vertices (V, 3), and faces (F, 3), in the order of the triangles."""
    corners = triangles.reshape(-1, 3)
    extent = float(np.ptp(corners, axis=0).max())
    grid = np.rint((corners - corners.min(axis=0)) / max(_WELD * extent, 1e-300)).astype(np.int64)
    _, first, vertex = np.unique((grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2], return_index=True, return_inverse=True)
    return corners[first], vertex.reshape(-1, 3)


def split_at_creases(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Gives the faces on both sides of a sharp edge vertices of their own, for programs whose normals are smooth at a vertex."""
    edges, normals = Edges.of(faces), unit_normals(vertices[faces])[0]
    half = np.argsort(edges.of_faces.ravel(), kind="stable")  # half-edge 3 f + k goes from corner k of face f to the next one
    half = half[(edges.count == 2)[edges.of_faces.ravel()[half]]].reshape(-1, 2)
    half = half[(normals[half[:, 0] // 3] * normals[half[:, 1] // 3]).sum(axis=1) > CREASE]
    start, end = half, half // 3 * 3 + (half + 1) % 3
    corner = faces.ravel()
    is_opposite = corner[start[:, 0]] != corner[start[:, 1]]
    other_start = np.where(is_opposite, end[:, 1], start[:, 1])
    other_end = np.where(is_opposite, start[:, 1], end[:, 1])
    joined = np.r_[start[:, 0], end[:, 0]], np.r_[other_start, other_end]
    graph = sp.coo_array((np.ones(len(joined[0]), bool), joined), (len(corner), len(corner)))
    group = connected_components(graph, directed=False)[1]
    _, first, vertex = np.unique(group, return_index=True, return_inverse=True)
    return vertices[corner[first]], vertex.reshape(-1, 3)
