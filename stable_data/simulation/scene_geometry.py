"""A scene with the geometry of its objects: what an exporter or an engine is given of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.errors import Notice, SceneError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint
from stable_data.geometry.shape import Shape
from stable_data.rotations import heading, quat_of, tilt_of, yaw_frame_box
from stable_data.scene import FloatArray, QuatXyzw, Scene, SceneObject, Vec3
from stable_data.simulation.collision_bodies import asset_parts, bodies_of
from stable_data.simulation.render import object_colour
from stable_data.simulation.settling import RigidBody

RestPose: TypeAlias = tuple[Vec3, QuatXyzw]
"""Where an engine left an object: the centre of the box that it had, metres, and the rotation from its frame at yaw 0."""


@dataclass(frozen=True, eq=False)
class SceneGeometry:
    """A scene and its geometry.

    Attributes:
        scene: Resolved: its scales are those that its meshes have (``AssetStore.resolved``).
        shapes: The geometry of its objects, in its order.
        meshes: Their meshes, mesh units; None where a box stands in.
        store: Where the meshes are.
        notices: What was odd, with the scene as ``item_id``.
    """

    scene: Scene
    shapes: tuple[Shape, ...]
    meshes: tuple[Mesh | None, ...]
    store: AssetStore
    notices: tuple[Notice, ...] = ()

    @classmethod
    def of(cls, scene: Scene, store: AssetStore, rest: Mapping[str, RestPose] | None = None) -> "SceneGeometry":
        """A scene of a run.

        Args:
            scene: As its row has it.
            store: Where its meshes are.
            rest: Where an engine left each object, to put it there: the table ``settled``. None: as the scene has them.

        Raises:
            SceneError: ``rest`` has no pose for an object (``not_settled``).
        """
        scene, shapes, notices = store.resolved(scene)
        if rest is not None:
            missing = [o.instance for o in scene.objects if o.instance not in rest]
            if missing:
                raise SceneError(f"{scene.scene_id}: no settled pose of {missing}, expected one per object", "not_settled")
            scene = replace(scene, objects=tuple(object_at_rest(o, store.mesh_of(o), rest[o.instance]) for o in scene.objects))
            shapes = [_shape(o, shape, store) for o, shape in zip(scene.objects, shapes, strict=True)]
        meshes = (store.mesh_of(o) if s.is_exact and o.scale else None for o, s in zip(scene.objects, shapes, strict=True))
        return cls(scene, tuple(shapes), tuple(meshes), store, notices)

    @cached_property
    def bodies(self) -> tuple[RigidBody, ...]:
        """The objects as an engine sees them, the same that the stability verdict is given.

        Raises:
            MeshError: Nothing that has a volume could be made of a mesh.
        """
        return tuple(bodies_of(self.scene, self.shapes, self.store))

    def offset(self, index: int) -> FloatArray:
        """Where the centre of an object's own mesh lies in its yaw frame, (3,) float64, metres; the box's centre is the origin."""
        o, mesh = self.scene.objects[index], self.meshes[index]
        assert mesh is not None
        assert o.scale is not None
        return -_box_centre(mesh, o.scale, o.tilt_quat_xyzw)

    def paint(self, index: int) -> Paint:
        """The colours of an object's mesh; its category's where nothing is known of them."""
        o, mesh = self.scene.objects[index], self.meshes[index]
        assert mesh is not None
        return self.store.paint_of(o) or ((object_colour(o), np.arange(len(mesh.faces))),)

    def parts(self, index: int) -> Sequence[Mesh]:
        """Convex parts of an object's asset, in the frame and unit of its mesh."""
        asset_id, mesh = self.scene.objects[index].asset_id, self.meshes[index]
        assert asset_id is not None
        assert mesh is not None
        return asset_parts(asset_id, mesh, self.store)


def object_at_rest(o: SceneObject, mesh: Mesh | None, rest: RestPose, snap: float = 0.0) -> SceneObject:
    """The object that a simulated body has become: its position, yaw, tilt and size are those of the body.

    Args:
        o: The object as the body was made from it.
        mesh: Its mesh, mesh units, or None. Without a mesh the object is a box, which gets no tilt.
        rest: The pose of the body.
        snap: The tilt stays as it was where the body moved no corner of the object's box farther by tilting, metres.
    """
    position, quat_xyzw = rest
    yaw, _ = heading(quat_xyzw)
    if mesh is None or o.scale is None:
        return o.moved(position, yaw)
    turned, tilted = Rotation.from_quat(quat_xyzw), Rotation.from_quat(o.tilt_quat_xyzw)
    rotation = quat_of(turned * tilted)
    yaw, _ = heading(rotation)
    tilt = tilt_of(rotation, yaw)
    if (Rotation.from_quat(tilt) * tilted.inv()).magnitude() * math.hypot(*o.size) / 2 < snap:
        tilt = o.tilt_quat_xyzw
    was, now = _box_centre(mesh, o.scale, o.tilt_quat_xyzw), _box_centre(mesh, o.scale, tilt)
    centre = np.asarray(position) - turned.apply(was) + Rotation.from_euler("z", yaw).apply(now)
    a, b, c = Shape.from_mesh(mesh, o.scale, tilt).size.tolist()
    i, j, k = centre.tolist()
    return replace(o, position=(i, j, k), yaw=yaw, tilt_quat_xyzw=tilt, size=(a, b, c))


def _box_centre(mesh: Mesh, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> FloatArray:
    """Centre of the box of a scaled and tilted mesh, (3,) float64, metres, yaw frame, from the centre of the mesh's own box."""
    low, high = yaw_frame_box(mesh.vertices, scale, tilt_quat_xyzw)
    return np.asarray((low + high) / 2)


def _shape(o: SceneObject, shape: Shape, store: AssetStore) -> Shape:
    """The geometry of an object at the tilt that it has now."""
    mesh = store.mesh_of(o) if shape.is_exact else None
    if mesh is None or o.scale is None:
        return shape
    return Shape.from_mesh(mesh, o.scale, o.tilt_quat_xyzw)
