"""Settling: simulates placed objects until they rest, reads their poses, and checks that they stay at rest and are clean."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.embedded_world.placing import PlacedObject, yaw_frame_parts
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.simulation.scene_geometry import object_at_rest
from stable_data.simulation.settling import PhysicsOptions, RigidBody, SettleResult, settle

MAX_PENETRATION_MM = 0.4
"""Deepest contact of an accepted scene, below the 0.5 mm up to which the audit counts a scene as clean."""

_SETTLE = PhysicsOptions(settle_seconds=2.0, watch_seconds=0.02, rest_speed=1e-3, rest_move=0.0)
_REST = PhysicsOptions(settle_seconds=0.4, watch_seconds=0.6, rest_move=0.0)
_MAX_MOVE_MM, _MAX_TURN_DEG = 0.3, 0.3  # largest movement of an object at rest during the simulation _REST
_SNAP = 1.5e-4  # a settled tilt becomes the planned one if no corner of the box moves farther, metres
_MAX_STRAY = 0.09  # largest movement along an axis while settling, metres
_MAX_TOPPLE_DEG = 45.0  # largest rotation of the vertical axis while settling, degrees; balls may roll
_ROUND_ASPECT = 1.3  # longest over shortest side up to which an object counts as a ball


def settle_objects(placed: Sequence[PlacedObject], table: Tabletop) -> tuple[tuple[SceneObject, ...], frozenset[int]] | None:
    """Settles placed objects in the physics engine.

    Returns:
        The objects at their settled poses in full precision, and the indices of those that fell, toppled or rolled away; None if the
        simulation diverged.
    """
    names = instance_names([obj.asset.category for obj in placed])
    bodies = [obj.body(name) for obj, name in zip(placed, names, strict=True)]
    result = settle(bodies, table, _SETTLE)
    if not np.isfinite(result.moves).all():
        return None
    objects = tuple(_object(obj, name, result, k) for k, (obj, name) in enumerate(zip(placed, names, strict=True)))
    return objects, frozenset(k for k, obj in enumerate(placed) if _has_strayed(obj, result, k))


def instance_names(categories: Sequence[str]) -> list[str]:
    """Instance names of the format, ``<k>_<category>_<n>``: k counts the objects from 1, n those of a category from 0."""
    return [f"{k + 1}_{category}_{list(categories[:k]).count(category)}" for k, category in enumerate(categories)]


def _has_strayed(obj: PlacedObject, result: SettleResult, index: int) -> bool:
    move = result.positions[index] - (obj.item.x, obj.item.y, obj.z)
    if np.abs(move).max() > _MAX_STRAY:
        return True
    size = obj.item.size
    turned = Rotation.from_quat(result.quats_xyzw[index]) * Rotation.from_euler("z", obj.item.yaw).inv()
    # The cosine of the angle between the vertical axis before and after settling.
    upright = turned.as_matrix()[2, 2]
    return bool(max(size) > _ROUND_ASPECT * min(size) and upright < np.cos(np.radians(_MAX_TOPPLE_DEG)))


def _object(obj: PlacedObject, name: str, result: SettleResult, index: int) -> SceneObject:
    """The scene object of a settled body."""
    item, source = obj.item, obj.asset
    placed = SceneObject(
        name,
        source.category,
        (item.x, item.y, obj.z),
        item.yaw,
        item.size,
        asset_id=source.uid,
        scale=item.scale,
        tilt_quat_xyzw=item.tilt_quat_xyzw,
        description=source.captions[0],
    )
    settled = object_at_rest(placed, source.mesh, result.pose(index), snap=_SNAP)
    x, y, z = np.multiply(item.scale, source.unit).tolist()
    return replace(settled, scale=(x, y, z))


def bodies_of(scene: Scene, placed: Sequence[PlacedObject]) -> list[RigidBody]:
    """The rigid bodies of a settled scene; ``placed`` holds its placed objects in the same order."""
    return [
        RigidBody(o.instance, yaw_frame_parts(obj.asset, obj.item.scale, o.tilt_quat_xyzw), obj.mass, o.position, o.yaw)
        for o, obj in zip(scene.objects, placed, strict=True)
    ]


def unsteady_objects(scene: Scene, placed: Sequence[PlacedObject]) -> frozenset[int]:
    """Indices of the objects that do not stay at their poses in the physics engine; all indices if it cannot tell."""
    all_objects = frozenset(range(len(placed)))
    result = settle(bodies_of(scene, placed), scene.table, _REST)
    if result.engine_penetration_mm is None or result.settle_move_max_mm is None:
        return all_objects
    moved = (1e3 * result.moves > _MAX_MOVE_MM) | (result.turns > _MAX_TURN_DEG)
    # No object moved, but the scene as a whole is unstable or has a deep contact: all objects are suspect.
    if not moved.any() and (not result.stable or result.engine_penetration_mm > MAX_PENETRATION_MM):
        return all_objects
    return frozenset(np.flatnonzero(moved).tolist())


def audit(scene: Scene, placed: Sequence[PlacedObject]) -> Audit:
    """Audits a settled scene exactly."""
    shapes = [
        Shape.from_mesh(obj.asset.mesh, obj.item.scale, o.tilt_quat_xyzw) for o, obj in zip(scene.objects, placed, strict=True)
    ]
    return audit_scene(scene, shapes)


def unclean_objects(scene_audit: Audit) -> frozenset[int]:
    """Indices of the objects that collide, float, sink or leave their area; an object that could not be judged counts as unclean."""
    index = {o.instance: k for k, o in enumerate(scene_audit.objects)}
    found = {
        k
        for k, o in enumerate(scene_audit.objects)
        if o.floats is not False or o.leaves_table or o.enters_restricted_zone or 1e3 * o.table_penetration > MAX_PENETRATION_MM
    }
    for pair in scene_audit.pairs:
        if pair.penetration is None or 1e3 * pair.penetration > MAX_PENETRATION_MM:
            found |= {index[pair.first], index[pair.second]}
    return frozenset(found)
