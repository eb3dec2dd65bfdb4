"""The triangle mesh, and its arithmetic: areas, volumes, edges.

Frame: z up, centred on its box, in the file's own units (``SceneObject.scale`` converts them to metres).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stable_data.scene import FloatArray, IntArray

WELD = 1e-6
"""Vertices nearer than this share of the largest extent are merged."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) float64, C-contiguous.
        faces: Corner indices, (F, 3) int64, C-contiguous, counter-clockwise seen from outside.
    """

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        """Makes the arrays contiguous, so that every geometry library accepts them without a copy."""
        object.__setattr__(self, "vertices", np.ascontiguousarray(self.vertices, np.float64))
        object.__setattr__(self, "faces", np.ascontiguousarray(self.faces, np.int64))

    @property
    def extents(self) -> FloatArray:
        """Size of the box, (3,) float64."""
        extents: FloatArray = np.ptp(self.vertices, axis=0)
        return extents

    @property
    def triangles(self) -> FloatArray:
        """Corners of every face, (F, 3, 3) float64."""
        return self.vertices[self.faces]


def area_vectors(triangles: FloatArray) -> FloatArray:
    """Normals of triangles (F, 3, 3), each as long as twice its triangle's area, (F, 3) float64."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def unit_normals(triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit normals (F, 3) float64 of triangles (F, 3, 3), zero for a triangle without area; and twice the areas, (F,)."""
    normals = area_vectors(triangles)
    length = np.linalg.norm(normals, axis=1)
    return np.divide(normals, length[:, None], out=np.zeros_like(normals), where=length[:, None] > 0), length


def double_areas(mesh: Mesh) -> FloatArray:
    """Twice the area of every face, (F,) float64, squared mesh units."""
    areas: FloatArray = np.linalg.norm(area_vectors(mesh.triangles), axis=1)
    return areas


def signed_volumes(triangles: FloatArray) -> FloatArray:
    """Volumes of the tetrahedra from the origin to triangles (F, 3, 3), (F,) float64, negative for triangles that face inward."""
    volumes: FloatArray = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
    return volumes


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Undirected edges of faces.

    Attributes:
        corners: (E, 2), lower index first.
        count: Number of faces that use each edge, (E,).
        balance: Number of faces that use it from the lower to the higher index, less those in the other direction, (E,).
        of_faces: The three edges of every face, (F, 3).
    """

    corners: IntArray
    count: IntArray
    balance: IntArray
    of_faces: IntArray

    @classmethod
    def of(cls, faces: IntArray) -> "Edges":
        """Computes the edges of faces (F, 3)."""
        directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        low, high, num = directed.min(axis=1), directed.max(axis=1), faces.max() + 1
        # One integer per undirected edge: sorting integers is much faster than sorting rows.
        key, index, count = np.unique(low * num + high, return_inverse=True, return_counts=True)
        balance = np.bincount(index, np.where(directed[:, 0] == low, 1, -1)).astype(np.int64)
        return cls(np.stack([key // num, key % num], axis=1), count, balance, index.reshape(-1, 3))

    @property
    def is_watertight(self) -> bool:
        """Whether each edge joins two faces with opposite directions along it."""
        return bool((self.count == 2).all() and (self.balance == 0).all())

    def boundary(self) -> IntArray:
        """Directed edges without a face in the opposite direction, (B, 2): the rims of holes, also where three faces meet."""
        forward = np.repeat(self.corners, np.maximum(self.balance, 0), axis=0)
        backward = np.repeat(self.corners[:, ::-1], np.maximum(-self.balance, 0), axis=0)
        return np.concatenate([forward, backward])


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge is used as often in one direction as in the other: then winding numbers are whole."""
    return bool((Edges.of(mesh.faces).balance == 0).all())


def drop_unused_vertices(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Drops vertices that no face refers to."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def weld_vertices(vertices: FloatArray, faces: IntArray, cell: float) -> tuple[FloatArray, IntArray]:
    """Merges the vertices (V, 3) of each grid cell and drops faces (F, 3) that collapse.

    A cell border may separate two near vertices. Along each axis this happens on one of four staggered grids at most, so one of
    the four merges them.
    """
    for shift in (0.0, 0.25, 0.5, 0.75):
        grid = np.floor((vertices - vertices.min(axis=0)) / cell + shift).astype(np.int64)
        # 21 bits per axis, because an axis has at most 1 / WELD cells.
        key = (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]
        _, first, index = np.unique(key, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], index[faces]
    a, b, c = faces.T
    return vertices, faces[(a != b) & (b != c) & (c != a)]


def center_vertices(vertices: FloatArray, faces: IntArray) -> Mesh:
    """Returns a mesh without unused vertices, its box centred on the origin."""
    vertices, faces = drop_unused_vertices(vertices, faces)
    if len(vertices):
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return Mesh(vertices, faces)


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Joins meshes into one, their vertices and faces in order; nothing is merged."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def joined_corners(triangles: FloatArray) -> Mesh:
    """Returns triangles (F, 3, 3) as a mesh whose corners at the very same place are one vertex; nothing else is merged."""
    vertices, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(vertices, corners.reshape(-1, 3))
