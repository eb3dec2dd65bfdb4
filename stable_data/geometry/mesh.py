"""What a triangle mesh is, and its arithmetic: areas, volumes, edges.

Frame: z up, centred on its box, in the file's own units (``SceneObject.scale`` turns them into metres).
"""

from dataclasses import dataclass

import numpy as np

from stable_data.scene import FloatArray, IntArray


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
        """Makes the arrays contiguous, so that every geometry library takes them without a copy."""
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
    """Unit normals of triangles (F, 3, 3), (F, 3) float64, zero where one has no area; and twice their areas, (F,)."""
    normals = area_vectors(triangles)
    length = np.linalg.norm(normals, axis=1)
    return np.divide(normals, length[:, None], out=np.zeros_like(normals), where=length[:, None] > 0), length


def double_areas(mesh: Mesh) -> FloatArray:
    """Twice the area of every face, (F,) float64, squared mesh units."""
    areas: FloatArray = np.linalg.norm(area_vectors(mesh.triangles), axis=1)
    return areas


def signed_volumes(triangles: FloatArray) -> FloatArray:
    """Volume of the tetrahedra from the origin to triangles (F, 3, 3), (F,) float64, negative where they look inwards."""
    volumes: FloatArray = np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) / 6
    return volumes


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Undirected edges of faces.

    Attributes:
        corners: (E, 2), low corner first.
        count: How many faces use each, (E,).
        balance: How many more run it upwards than downwards, (E,).
        of_faces: The three edges of every face, (F, 3).
    """

    corners: IntArray
    count: IntArray
    balance: IntArray
    of_faces: IntArray

    @classmethod
    def of(cls, faces: IntArray) -> "Edges":
        """The edges of faces (F, 3)."""
        directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        low, high, num = directed.min(axis=1), directed.max(axis=1), faces.max() + 1
        key, index, count = np.unique(low * num + high, return_inverse=True, return_counts=True)
        balance = np.bincount(index, np.where(directed[:, 0] == low, 1, -1)).astype(np.int64)
        return cls(np.stack([key // num, key % num], axis=1), count, balance, index.reshape(-1, 3))

    @property
    def is_watertight(self) -> bool:
        """Whether each joins two faces that run against each other."""
        return bool((self.count == 2).all() and (self.balance == 0).all())

    def boundary(self) -> IntArray:
        """Directed edges that no face runs against, (B, 2): the rims of what is missing, also where three faces meet."""
        forward = np.repeat(self.corners, np.maximum(self.balance, 0), axis=0)
        backward = np.repeat(self.corners[:, ::-1], np.maximum(-self.balance, 0), axis=0)
        return np.concatenate([forward, backward])


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge is run as often one way as the other: then winding numbers are whole."""
    return bool((Edges.of(mesh.faces).balance == 0).all())


def drop_unused_vertices(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Drops vertices that no face refers to."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]


def center_vertices(vertices: FloatArray, faces: IntArray) -> Mesh:
    """A mesh without unused vertices, its box centred on the origin."""
    vertices, faces = drop_unused_vertices(vertices, faces)
    if len(vertices):
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return Mesh(vertices, faces)
