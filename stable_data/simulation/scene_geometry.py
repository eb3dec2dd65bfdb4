"""A scene with the geometry of its objects: the input of exporters and of the physics engine."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.store import AssetStore
from stable_data.errors import SceneError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.mesh_colors import Paint, to_linear
from stable_data.geometry.shape import Shape
from stable_data.geometry.surface import Surface
from stable_data.rotations import heading, quat_of, tilt_of, yaw_frame_box
from stable_data.scene import FloatArray, QuatXyzw, Scene, SceneObject, Vec3
from stable_data.simulation.collision_bodies import asset_parts, bodies_of
from stable_data.simulation.look_meshes import ObjectLook
from stable_data.simulation.render import object_colour, rgba, scene_bounds
from stable_data.simulation.settling import RigidBody

_WOOD = "#b08a62"  # of a support without colours

RestPose: TypeAlias = tuple[Vec3, QuatXyzw]
"""Pose of a simulated object: the centre of its box, metres, and its rotation from its yaw frame at yaw 0."""


@dataclass(frozen=True, eq=False)
class SceneGeometry:
    """A scene and its geometry.

    Attributes:
        scene: The scene, resolved: its scales are those of its meshes (``AssetStore.resolved``).
        shapes: The geometry of its objects, in its order.
        meshes: Their meshes, mesh units; None if a box replaces the mesh.
        store: The store of the meshes.
        annotations: What is known of its assets, by id; an asset may be missing.
        verdicts: Columns of the metric card in the row of the scene; empty if they are not known.
    """

    scene: Scene
    shapes: tuple[Shape, ...]
    meshes: tuple[Mesh | None, ...]
    store: AssetStore
    annotations: Mapping[str, AssetAnnotation] = field(default_factory=dict)
    verdicts: Mapping[str, float | bool | None] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, store: AssetStore, rest: Mapping[str, RestPose] | None = None) -> "SceneGeometry":
        """Builds the geometry of a scene of a run.

        Args:
            scene: The scene as its row gives it.
            store: The store of its meshes.
            rest: Pose of each object after settling, from the table ``settled``; None: poses are those of the scene.

        Raises:
            SceneError: ``rest`` has no pose for an object (``not_settled``).
        """
        scene, shapes, _ = store.resolved(scene)
        if rest is not None:
            missing = [o.instance for o in scene.objects if o.instance not in rest]
            if missing:
                raise SceneError(f"{scene.scene_id}: no settled pose of {missing}, expected one per object", "not_settled")
            scene = replace(scene, objects=tuple(object_at_rest(o, store.mesh_of(o), rest[o.instance]) for o in scene.objects))
            shapes = [_tilted_shape(o, shape, store) for o, shape in zip(scene.objects, shapes, strict=True)]
        meshes = (store.mesh_of(o) if s.is_exact and o.scale else None for o, s in zip(scene.objects, shapes, strict=True))
        return cls(scene, tuple(shapes), tuple(meshes), store)

    @cached_property
    def bodies(self) -> tuple[RigidBody, ...]:
        """The objects as rigid bodies, the same as for the stability verdict.

        Raises:
            MeshError: No part with a volume could be made of a mesh.
        """
        return tuple(bodies_of(self.scene, self.shapes, self.store))

    def offset(self, index: int) -> FloatArray:
        """The centre of an object's own mesh in its yaw frame, (3,) float64, metres; the origin is the centre of its box."""
        o, mesh = self.scene.objects[index], self.meshes[index]
        assert mesh is not None
        assert o.scale is not None
        return -_box_centre(mesh, o.scale, o.tilt_quat_xyzw)

    def paint(self, index: int) -> Paint:
        """The colours of an object's mesh; the colour of its category if they are not known."""
        o, mesh = self.scene.objects[index], self.meshes[index]
        assert mesh is not None
        return self.store.paint_of(o) or ((object_colour(o), np.arange(len(mesh.faces))),)

    def look(self, index: int) -> ObjectLook | None:
        """What is seen of an object with a mesh; None if the colours of its faces (:meth:`paint`) are its look."""
        o = self.scene.objects[index]
        surfaces = self.store.look_of(o)
        if surfaces is None or o.scale is None:
            return None
        x, y, z = self.offset(index).tolist()
        return ObjectLook(surfaces, o.scale, o.tilt_quat_xyzw, (x, y, z))

    @cached_property
    def support(self) -> ObjectLook | None:
        """What is seen of the support on which the table lies, in the scene's frame; None if the table is a piece of its own.

        It shows what is in the way there, so that the fixed objects need not be drawn.
        """
        frame = self.scene.frame
        if frame is None or frame.asset_id is None or self.store.fault_of(frame.asset_id) is not None:
            return None
        surfaces = self.store.look(frame.asset_id)[0] or self._painted(frame.asset_id)
        turn = Rotation.from_euler("z", -frame.yaw)
        x, y, z = (-turn.apply(frame.origin)).tolist()
        return ObjectLook(surfaces, (1.0, 1.0, 1.0), quat_of(turn), (x, y, z))

    def _painted(self, asset_id: str) -> tuple[Surface, ...]:
        """The mesh of an asset in the colours of its faces."""
        mesh = self.store.asset(asset_id).mesh
        paint = self.store.paint(asset_id)[0] or ((_WOOD, np.arange(len(mesh.faces))),)
        found = []
        for colour, rows in paint:
            red, green, blue = to_linear(np.array(rgba(colour)[:3])).tolist()
            found.append(Surface(mesh.triangles[rows], (red, green, blue)))
        return tuple(found)

    def is_seen(self, index: int) -> bool:
        """Whether an object is drawn: all but the fixed ones that the support shows."""
        return self.support is None or self.scene.objects[index].instance not in self.scene.fixed

    @property
    def seen_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of the objects that are drawn and of the table, (3,) each, metres."""
        seen = [k for k in range(len(self.shapes)) if self.is_seen(k)]
        shown = replace(self.scene, objects=tuple(self.scene.objects[k] for k in seen))
        return scene_bounds(shown, [Mesh(self.shapes[k].vertices, self.shapes[k].faces) for k in seen])

    def parts(self, index: int) -> Sequence[Mesh]:
        """Convex parts of an object's asset, in the frame and unit of its mesh."""
        asset_id, mesh = self.scene.objects[index].asset_id, self.meshes[index]
        assert asset_id is not None
        assert mesh is not None
        return asset_parts(asset_id, mesh, self.store)


def object_at_rest(o: SceneObject, mesh: Mesh | None, rest: RestPose, snap: float = 0.0) -> SceneObject:
    """Converts the pose of a simulated body to an object: position, yaw, tilt and size.

    Args:
        o: The object from which the body was made.
        mesh: Its mesh, mesh units, or None. Without a mesh the object is a box, which gets no tilt.
        rest: The pose of the body.
        snap: The tilt is unchanged if the tilting moved no corner of the object's box farther than this, metres.
    """
    position, quat_xyzw = rest
    yaw, _ = heading(quat_xyzw)
    if mesh is None or o.scale is None:
        return o.moved(position, yaw)
    turned, tilted = Rotation.from_quat(quat_xyzw), Rotation.from_quat(o.tilt_quat_xyzw)
    rotation = quat_of(turned * tilted)
    yaw, _ = heading(rotation)
    tilt = tilt_of(rotation, yaw)
    # The angle between the tilts times half the diagonal of the box bounds the movement of a corner.
    if (Rotation.from_quat(tilt) * tilted.inv()).magnitude() * math.hypot(*o.size) / 2 < snap:
        tilt = o.tilt_quat_xyzw
    # Another tilt has another box. The body's pose gives the old centre; the mesh's own centre connects the two.
    was, now = _box_centre(mesh, o.scale, o.tilt_quat_xyzw), _box_centre(mesh, o.scale, tilt)
    centre = np.asarray(position) - turned.apply(was) + Rotation.from_euler("z", yaw).apply(now)
    a, b, c = Shape.from_mesh(mesh, o.scale, tilt).size.tolist()
    i, j, k = centre.tolist()
    return replace(o, position=(i, j, k), yaw=yaw, tilt_quat_xyzw=tilt, size=(a, b, c))


def _box_centre(mesh: Mesh, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> FloatArray:
    """Box centre of a scaled and tilted mesh, (3,) float64, metres, yaw frame, relative to the centre of the mesh's own box."""
    low, high = yaw_frame_box(mesh.vertices, scale, tilt_quat_xyzw)
    return np.asarray((low + high) / 2)


def _tilted_shape(o: SceneObject, shape: Shape, store: AssetStore) -> Shape:
    if store.mesh_of(o) is None or not shape.is_exact or o.asset_id is None or o.scale is None:
        return shape
    return store.shape_at(o.asset_id, o.scale, o.tilt_quat_xyzw)
