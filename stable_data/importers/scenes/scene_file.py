"""What a scene file holds, whatever its format: rigid bodies at their poses, in the frame of the file."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from stable_data.errors import MeshError, Notice
from stable_data.geometry.mesh import Mesh
from stable_data.limits import LIMITS, at_most
from stable_data.rotations import rotation_matrix
from stable_data.scene import FloatArray, QuatXyzw, Vec3

BodyPose: TypeAlias = tuple[Vec3, QuatXyzw]
"""Origin of a body, metres, and its rotation, in the frame of the file."""


def check_shapes(path: str, *, faces: int, corners: int = 0) -> None:
    """Refuses a scene whose shapes are together too large: a few bytes can show one shape as often as they like.

    Args:
        path: The scene, for the message.
        faces: Triangles of the shapes so far, counted as often as they are shown.
        corners: Their vertices, likewise.

    Raises:
        MeshError: ``mesh_too_large``.
    """
    for what, found in (("triangles", faces), ("vertices", corners)):
        if found > LIMITS.model.max_faces:
            message = (
                f"{path}: its shapes have together {found:,} {what} or more, expected {at_most(LIMITS.model, 'max_faces')}"
            )
            raise MeshError(f"{message}; simplify it", "mesh_too_large")


@dataclass(frozen=True, slots=True, eq=False)
class SceneBody:
    """A rigid body of a scene file.

    Attributes:
        name: Its name, unique in the file.
        position: Its origin, metres.
        quat_xyzw: Its rotation, unit.
        parts: The convex shapes with which it collides, metres, in its own frame.
        is_free: Whether it can move freely; else it belongs to the surroundings.
        mass: Kilograms; None if unknown.
        center_of_mass: Metres, in its own frame; None if unknown.
        inertia: Inertia tensor about the centre of mass along its own axes, (3, 3), kg m²; None if unknown.
        friction: Sliding, torsional and rolling friction; None if unknown.
        known_quats: Rotations that the file states for it elsewhere, such as in other keyframes.
    """

    name: str
    position: Vec3
    quat_xyzw: QuatXyzw
    parts: tuple[Mesh, ...]
    is_free: bool
    mass: float | None = None
    center_of_mass: Vec3 | None = None
    inertia: FloatArray | None = None
    friction: Vec3 | None = None
    known_quats: tuple[QuatXyzw, ...] = ()

    def placed(self, part: Mesh) -> FloatArray:
        """Vertices of a part, (V, 3) metres, in the frame of the file."""
        placed: FloatArray = part.vertices @ rotation_matrix(self.quat_xyzw).T + np.asarray(self.position)
        return placed

    @property
    def center(self) -> FloatArray:
        """The centre of mass in the frame of the file, (3,) metres; without one, the centre of the box."""
        if self.center_of_mass is not None:
            return np.asarray(rotation_matrix(self.quat_xyzw) @ np.asarray(self.center_of_mass) + np.asarray(self.position))
        points = np.concatenate([self.placed(part) for part in self.parts])
        return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


@dataclass(frozen=True, slots=True)
class Ground:
    """An unlimited level plane.

    Attributes:
        owner: Name of the body that has it.
        height: Metres, in the frame of the file.
    """

    owner: str
    height: float


@dataclass(frozen=True, slots=True, eq=False)
class SceneFile:
    """A scene file that was read.

    Attributes:
        path: The file, relative to its source folder.
        sha256: Hash of its content and of the files that it includes.
        pose_of: Where the poses stand: ``initial``, or the name of a keyframe.
        bodies: Its bodies.
        grounds: Its level planes.
        notices: Remarks.
    """

    path: str
    sha256: str
    pose_of: str
    bodies: tuple[SceneBody, ...]
    grounds: tuple[Ground, ...] = ()
    notices: tuple[Notice, ...] = ()
