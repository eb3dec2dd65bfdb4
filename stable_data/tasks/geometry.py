"""The geometry that goals need: the scene at its start, the shapes of its objects, and which of them are containers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
import shapely

from stable_data.assets.annotation import AssetAnnotation
from stable_data.geometry.shape import Shape
from stable_data.rotations import heading, quat_product, rotate_xy, rotation_matrix, yaw_quat
from stable_data.scene import FloatArray, QuatXyzw, Scene, SceneObject

if TYPE_CHECKING:
    from stable_data.simulation.scene_geometry import SceneGeometry


_MOST_VERTICES = 400


@lru_cache(maxsize=1)
def _directions() -> FloatArray:
    """Directions all around, the axes among them, (D, 3) float64, unit."""
    k = np.arange(600) + 0.5
    z, turn = 1 - k / 300, np.pi * (1 + math.sqrt(5)) * k
    around = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
    flat = np.linspace(0, 2 * np.pi, 48, endpoint=False)  # outlines matter most
    return np.concatenate([np.eye(3), -np.eye(3), np.stack([np.cos(flat), np.sin(flat), 0 * flat], axis=1), around])


@dataclass(frozen=True, slots=True, eq=False)
class PosedObject:
    """An object in a state.

    Attributes:
        item: The object with the box that it has there.
        points: Its hull seen from above, (P, 2) float64, metres, world frame; not in order.
    """

    item: SceneObject
    points: FloatArray


@dataclass(frozen=True, eq=False)
class TaskGeometry:
    """A scene at the start of its task, with its geometry.

    Attributes:
        scene: The scene at the start; the supports of its objects are known.
        shapes: The geometry of its objects, in its order.
        containers: Whether objects can be put into an object; None or missing if it is not known.
    """

    scene: Scene
    shapes: Sequence[Shape]
    containers: Mapping[str, bool | None]
    _hulls: dict[int, FloatArray] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, geometry: "SceneGeometry") -> "TaskGeometry":
        """The geometry of a scene of a run, with the annotations of its assets."""
        return cls(geometry.scene, geometry.shapes, known_containers(geometry.scene, geometry.annotations))

    @cached_property
    def rows(self) -> Mapping[str, int]:
        """The number of each instance in the scene."""
        return {o.instance: k for k, o in enumerate(self.scene.objects)}

    def hull(self, row: int) -> FloatArray:
        """Vertices on an object's convex hull, (V, 3) float64, metres, yaw frame at the start, centred on its box.

        Of many, those that are farthest in some direction remain: a ball loses 0.3 % of its radius between two of them.
        """
        if row not in self._hulls:
            vertices = self.shapes[row].vertices
            if len(vertices) > _MOST_VERTICES:
                vertices = vertices[np.unique((vertices @ _directions().T).argmax(axis=0))]
            self._hulls[row] = vertices
        return self._hulls[row]

    def posed(self, row: int, position: FloatArray, quat_xyzw: Sequence[float]) -> PosedObject:
        """Returns an object in a state.

        Args:
            row: Its number.
            position: The centre of its box at the start, as a point of the body, (3,) metres, world frame.
            quat_xyzw: Rotation of the body from its yaw frame at yaw 0.
        """
        x, y, z, w = quat_xyzw
        points = self.hull(row) @ rotation_matrix((x, y, z, w)).T
        yaw, _ = heading((x, y, z, w))
        flat = rotate_xy(points[:, :2], -yaw)
        low = np.array((*flat.min(axis=0), points[:, 2].min()))
        high = np.array((*flat.max(axis=0), points[:, 2].max()))
        centre = (low + high) / 2
        centre[:2] = rotate_xy(centre[:2], yaw)
        i, j, k = (centre + position).tolist()
        a, b, c = (high - low).tolist()
        item = replace(self.scene.objects[row], position=(i, j, k), yaw=yaw, size=(a, b, c))
        return PosedObject(item, points[:, :2] + position[:2])

    def up(self, row: int, quat_xyzw: QuatXyzw) -> FloatArray:
        """The direction of an object's own up axis in a state, (3,) float64, unit, world frame."""
        turn = quat_product(quat_xyzw, self.scene.objects[row].tilt_quat_xyzw)
        return rotation_matrix(turn)[:, 2]

    def upright_quat(self, row: int, yaw: float) -> QuatXyzw:
        """The rotation of the body that stands an object on its base, with a yaw in radians."""
        x, y, z, w = self.scene.objects[row].tilt_quat_xyzw
        return quat_product(yaw_quat(yaw), (-x, -y, -z, w))


def outline_of(points: FloatArray) -> shapely.Geometry:
    """The convex outline of points (P, 2), metres."""
    return shapely.convex_hull(shapely.linestrings(points))  # a line is built ten times faster than points


def known_containers(scene: Scene, annotations: Mapping[str, AssetAnnotation]) -> dict[str, bool | None]:
    """Which objects of a scene are containers, by the annotations of their assets; None if that is not known."""
    found = {o.instance: annotations.get(o.asset_id or "") for o in scene.objects}
    return {name: None if annotation is None else annotation.is_container for name, annotation in found.items()}
