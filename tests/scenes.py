"""Scenes and shapes whose truth is known by calculation."""

from collections.abc import Sequence

import manifold3d
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, Rectangle, Scene, SceneObject, Tabletop, Vec3

Pose = tuple[float, float, float, float]
"""x, y, z in metres, yaw in radians."""

Placed = tuple[str, Shape, Pose]
"""Instance, shape, where it stands."""


def box(x: float, y: float, z: float) -> Shape:
    """A closed box, metres."""
    stand_in = Shape.box((x, y, z))
    return Shape(stand_in.vertices, stand_in.faces)


def ball(radius: float, subdivisions: int = 3) -> Shape:
    """A closed sphere with its poles on the z axis, metres."""
    sphere = trimesh.creation.icosphere(subdivisions, radius)
    return Shape(np.array(sphere.vertices), np.array(sphere.faces, np.int64))


def sheet(x: float, y: float) -> Shape:
    """A horizontal rectangle of two triangles, without thickness, metres."""
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) / 2
    return Shape(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def bowl(radius: float, wall: float) -> Shape:
    """A closed hemispherical bowl, open upwards, centred on its box, metres."""
    angles = np.linspace(0, np.pi / 2, 13)
    arc = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    profile = np.concatenate([arc * radius, arc[::-1] * (radius - wall)])
    revolved = trimesh.creation.revolve(profile, sections=32)
    vertices = np.array(revolved.vertices)
    vertices[:, 2] -= (vertices[:, 2].min() + vertices[:, 2].max()) / 2
    faces = np.array(revolved.faces, np.int64)
    return Shape(vertices, faces if revolved.volume > 0 else faces[:, ::-1].copy())


def cup(radius: float, height: float, wall: float) -> Shape:
    """An upright round cup with a floor, as thick as its wall doubled."""
    inside = manifold3d.Manifold.cylinder(height, radius - wall, circular_segments=48).translate((0.0, 0.0, 2 * wall))
    solid = manifold3d.Manifold.cylinder(height, radius, circular_segments=48) - inside
    raw = solid.translate((0.0, 0.0, -height / 2)).to_mesh64()
    return Shape(np.asarray(raw.vert_properties)[:, :3], np.asarray(raw.tri_verts).astype(np.int64))


def hollow(shape: Shape, *extra: Shape) -> Shape:
    """Several shapes as one mesh, each wound as it is."""
    parts = (shape, *extra)
    starts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    return Shape(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=True)]),
    )


def tilted(shape: Shape, degrees: float) -> Shape:
    """A shape turned about the x axis and centred on its box again."""
    quat = Rotation.from_euler("x", degrees, degrees=True).as_quat()
    x, y, z, w = quat.tolist()
    return Shape.from_mesh(Mesh(shape.vertices, shape.faces), (1.0, 1.0, 1.0), (x, y, z, w))


def triangles(shape: Shape, pose: Pose = (0.0, 0.0, 0.0, 0.0)) -> FloatArray:
    """Triangles of a shape where it stands, (F, 3, 3) float64, metres."""
    return shape.posed(pose)[shape.faces]


def scene_of(
    placed: Sequence[Placed], size_xy: tuple[float, float] = (1.0, 1.0), zone: Rectangle | None = None
) -> tuple[Scene, list[Shape]]:
    """A scene of placed shapes."""
    objects = []
    for name, shape, (x, y, z, yaw) in placed:
        size: Vec3 = tuple(shape.size.tolist())
        objects.append(SceneObject(name, name, (x, y, z), yaw, size))
    return Scene("built", Tabletop("office_table", size_xy, zone), tuple(objects)), [shape for _, shape, _ in placed]


def box_on_table(above: float = 0.0) -> tuple[Scene, list[Shape]]:
    """A box of 10 x 10 x 10 cm whose lowest face is so far above the table."""
    return scene_of([("box", box(0.1, 0.1, 0.1), (0.5, 0.5, 0.05 + above, 0.3))])


def overlapping_balls(depth: float, radius: float = 0.05) -> tuple[Scene, list[Shape]]:
    """Two balls side by side on the table that are so deep in each other, metres."""
    at = 0.5 + 2 * radius - depth
    return scene_of([("left", ball(radius), (0.5, 0.5, radius, 0.0)), ("right", ball(radius), (at, 0.5, radius, 0.0))])


def ball_in_bowl() -> tuple[Scene, list[Shape]]:
    """A ball of 3 cm radius that lies 0.2 mm above the bottom of a bowl of 8 cm radius and 5 mm wall."""
    bowl_shape = bowl(0.08, 0.005)
    return scene_of([("bowl", bowl_shape, (0.5, 0.5, 0.04, 0.0)), ("ball", ball(0.03), (0.5, 0.5, 0.005 + 0.0002 + 0.03, 0.0))])


def leaning_plate() -> tuple[Scene, list[Shape]]:
    """A plate that stands on the table on its edge, leans at 60 degrees, and touches the upper edge of a block."""
    plate = tilted(box(0.2, 0.2, 0.004), 60.0)
    low = float(plate.size[2]) / 2
    # Its lower face passes the block's edge (y = 0.55, z = 0.08) at a distance of 0.1 mm.
    normal = np.array([np.sin(np.radians(60)), -np.cos(np.radians(60))])  # of the lower face, in (y, z)
    edge = np.array([0.55, 0.08])
    y = float(edge[0] - (0.002 + 0.0001 - (edge[1] - low) * normal[1]) / normal[0])
    return scene_of([("plate", plate, (0.5, y, low, 0.0)), ("block", box(0.2, 0.1, 0.08), (0.5, 0.6, 0.04, 0.0))])
