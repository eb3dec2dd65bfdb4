"""Furniture made of boxes, whose surfaces are known."""

import numpy as np
import trimesh

from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.geometry.shape import Shape
from stable_data.scene import Vec3


def box(low: Vec3, high: Vec3) -> Mesh:
    shape = Shape.box((high[0] - low[0], high[1] - low[1], high[2] - low[2]))
    return Mesh(shape.vertices + (np.array(low) + high) / 2, shape.faces)


def moved(made: trimesh.Trimesh, x: float, y: float, z: float) -> Mesh:
    return Mesh(np.add(made.vertices, (x, y, z)), np.asarray(made.faces))


def turned(mesh: Mesh, degrees: float, axis: Vec3) -> Mesh:
    matrix = trimesh.transformations.rotation_matrix(np.radians(degrees), axis)
    return Mesh(trimesh.transform_points(mesh.vertices, matrix), mesh.faces)


def desk(width: float = 1.2, depth: float = 0.6, height: float = 0.75) -> Mesh:
    legs = [box((x, y, 0.0), (x + 0.05, y + 0.05, height - 0.03)) for x in (0.0, width - 0.05) for y in (0.0, depth - 0.05)]
    return join_meshes([box((0.0, 0.0, height - 0.03), (width, depth, height)), *legs])


def shelf() -> Mesh:
    """Three boards at 0.12, 0.52 and 0.82 m between side walls and a back; its top is at 1.22 m."""
    sides = [box((x, 0.0, 0.0), (x + 0.02, 0.3, 1.2)) for x in (0.0, 0.78)]
    boards = [box((0.02, 0.0, z), (0.78, 0.29, z + 0.02)) for z in (0.1, 0.5, 0.8)]
    return join_meshes([*sides, *boards, box((0.0, 0.29, 0.0), (0.8, 0.3, 1.2)), box((0.0, 0.0, 1.2), (0.8, 0.3, 1.22))])


def tray() -> Mesh:
    """A box without a lid: ground at 0.02 m, walls 1 cm thick up to 0.2 m."""
    walls = [((0.0, 0.0, 0.02), (0.01, 0.4, 0.2)), ((0.59, 0.0, 0.02), (0.6, 0.4, 0.2)),
             ((0.01, 0.0, 0.02), (0.59, 0.01, 0.2)), ((0.01, 0.39, 0.02), (0.59, 0.4, 0.2))]  # fmt: skip
    return join_meshes([box((0.0, 0.0, 0.0), (0.6, 0.4, 0.02)), *(box(low, high) for low, high in walls)])


def counter_with_sink() -> Mesh:
    """A counter at 0.9 m around a basin of sheets without thickness, 0.5 m × 0.4 m, whose ground is at 0.72 m."""
    around = [((0.0, 0.0), (0.3, 0.6)), ((0.8, 0.0), (1.4, 0.6)), ((0.3, 0.0), (0.8, 0.1)), ((0.3, 0.5), (0.8, 0.6))]
    slabs = [box((*low, 0.86), (*high, 0.9)) for low, high in around]
    a, b, c, d = (0.3, 0.1), (0.8, 0.1), (0.8, 0.5), (0.3, 0.5)
    sheets = [np.array([(*a, 0.72), (*b, 0.72), (*c, 0.72), (*d, 0.72)])]
    sheets += [np.array([(*p, 0.72), (*q, 0.72), (*q, 0.9), (*p, 0.9)]) for p, q in ((a, b), (b, c), (c, d), (d, a))]
    return join_meshes([*slabs, *(Mesh(sheet, np.array([[0, 1, 2], [0, 2, 3]])) for sheet in sheets)])


def lamp() -> Mesh:
    """A lamp for the desk at (0.9, 0.4): its foot has a radius of 8 cm, its shade of 10 cm."""
    foot, pole, shade = (
        moved(trimesh.creation.cylinder(0.08, 0.02, sections=32), 0.9, 0.4, 0.76),
        moved(trimesh.creation.cylinder(0.01, 0.4, sections=12), 0.9, 0.4, 0.97),
        moved(trimesh.creation.cone(0.1, 0.12), 0.9, 0.4, 1.15),
    )
    return join_meshes([foot, pole, shade])
