"""Plain things to lay tables with."""

import numpy as np
import trimesh

from stable_data.geometry.shape import Shape
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Stage, Tabletop


def mesh_shape(mesh: trimesh.Trimesh) -> Shape:
    vertices = np.asarray(mesh.vertices, np.float64)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return Shape(vertices - middle, np.asarray(mesh.faces, np.int64))


def box(x: float, y: float, z: float) -> Shape:
    return mesh_shape(trimesh.creation.box((x, y, z)))


def cylinder(radius: float, height: float) -> Shape:
    return mesh_shape(trimesh.creation.cylinder(radius, height, sections=24))


def ball(radius: float) -> Shape:
    return mesh_shape(trimesh.creation.icosphere(3, radius))


def bowl(radius: float = 0.08, height: float = 0.05, wall: float = 0.004) -> Shape:
    """A cup with a flat floor."""
    profile = [(0, 0), (radius, 0), (radius, height), (radius - wall, height), (radius - wall, wall), (0, wall)]
    return mesh_shape(trimesh.creation.revolve(np.array(profile), sections=32))


def laid(
    *things: tuple[str, Shape, float, float, float],
    size: tuple[float, float] = (0.8, 0.6),
    yaws: dict[str, float] | None = None,
    stages: dict[str, Stage] | None = None,
    relations: tuple[tuple[str, RelationKind, str], ...] = (),
    zone: tuple[float, float, float, float] | None = None,
) -> tuple[Scene, list[Shape]]:
    """A scene of (name, shape, x, y, height of its bottom)."""
    objects = tuple(
        SceneObject(
            name,
            name.split("_")[0],
            (x, y, bottom + float(shape.size[2]) / 2),
            (yaws or {}).get(name, 0.0),
            tuple(shape.size.tolist()),
            stage=(stages or {}).get(name),
        )
        for name, shape, x, y, bottom in things
    )
    asked = tuple(Relation(*r) for r in relations)
    return Scene("a_table", Tabletop("table", size, zone), objects, relations=asked), [t[1] for t in things]
