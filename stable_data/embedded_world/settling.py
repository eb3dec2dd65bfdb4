"""A scene at rest: placed things settled by the engine, read back as poses, and taken only where they stay and are clean."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.embedded_world.placing import PlacedObject, yaw_frame_parts
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.simulation.scene_geometry import object_at_rest
from stable_data.simulation.settling import PhysicsOptions, RigidBody, SettleResult, settle

MAX_PENETRATION_MM = 0.4
"""Deepest contact of a scene that is kept: a scene counts as clean up to 0.5 mm."""

_SETTLE = PhysicsOptions(settle_seconds=2.0, watch_seconds=0.02, rest_speed=1e-3)
_REST = PhysicsOptions(settle_seconds=0.4, watch_seconds=0.6)
_MAX_MOVE_MM, _MAX_TURN_DEG = 0.3, 0.3  # of what is at rest, in the second of _REST
_SNAP = 1.5e-4  # a tilt is taken for the planned one where that moves no corner farther, metres
_STRAYED = 0.09  # farther than this from its place nothing may settle, metres
_TOPPLED = 45.0  # nor turned farther than this from its tilt, degrees, where it is no ball
_ROUND = 1.3  # longest side over shortest of what may roll


def settle_objects(placed: Sequence[PlacedObject], table: Tabletop) -> tuple[tuple[SceneObject, ...], frozenset[int]] | None:
    """Lets placed things settle.

    Returns:
        The objects where they came to lie, in full precision, and the numbers of those that fell, toppled or rolled away; None
        where the engine blew up.
    """
    names = instance_names([thing.asset.category for thing in placed])
    bodies = [thing.body(name) for thing, name in zip(placed, names, strict=True)]
    result = settle(bodies, table, _SETTLE)
    if not np.isfinite(result.moves).all():
        return None
    objects = tuple(_object(thing, name, result, k) for k, (thing, name) in enumerate(zip(placed, names, strict=True)))
    return objects, frozenset(k for k, thing in enumerate(placed) if _has_strayed(thing, result, k))


def instance_names(categories: Sequence[str]) -> list[str]:
    """The format's names, ``<k>_<category>_<n>``: k counts the objects from 1, n those of a category from 0."""
    return [f"{k + 1}_{category}_{list(categories[:k]).count(category)}" for k, category in enumerate(categories)]


def _has_strayed(thing: PlacedObject, result: SettleResult, index: int) -> bool:
    move = result.positions[index] - (thing.item.x, thing.item.y, thing.z)
    if np.abs(move).max() > _STRAYED:
        return True
    size = thing.item.size
    turned = Rotation.from_quat(result.quats_xyzw[index]) * Rotation.from_euler("z", thing.item.yaw).inv()
    upright = turned.as_matrix()[2, 2]
    return bool(max(size) > _ROUND * min(size) and upright < np.cos(np.radians(_TOPPLED)))


def _object(thing: PlacedObject, name: str, result: SettleResult, index: int) -> SceneObject:
    """The object that a body has become."""
    item, source = thing.item, thing.asset
    placed = SceneObject(
        name,
        source.category,
        (item.x, item.y, thing.z),
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
    """The engine's view of a settled scene whose objects were made from these things, in order."""
    return [
        RigidBody(o.instance, yaw_frame_parts(thing.asset, thing.item.scale, o.tilt_quat_xyzw), thing.mass, o.position, o.yaw)
        for o, thing in zip(scene.objects, placed, strict=True)
    ]


def unsteady_objects(scene: Scene, placed: Sequence[PlacedObject]) -> frozenset[int]:
    """Numbers of the objects that do not stay where the scene says, by the engine; all of them where it cannot say."""
    everything = frozenset(range(len(placed)))
    result = settle(bodies_of(scene, placed), scene.table, _REST)
    if result.engine_penetration_mm is None or result.settle_move_max_mm is None:
        return everything
    moved = (1e3 * result.moves > _MAX_MOVE_MM) | (result.turns > _MAX_TURN_DEG)
    if not moved.any() and (not result.stable or result.engine_penetration_mm > MAX_PENETRATION_MM):
        return everything
    return frozenset(np.flatnonzero(moved).tolist())


def audit(scene: Scene, placed: Sequence[PlacedObject]) -> Audit:
    """The exact audit of a settled scene."""
    shapes = [
        Shape.from_mesh(thing.asset.mesh, thing.item.scale, o.tilt_quat_xyzw)
        for o, thing in zip(scene.objects, placed, strict=True)
    ]
    return audit_scene(scene, shapes)


def unclean_objects(judged: Audit) -> frozenset[int]:
    """Numbers of the objects that collide, float, sink or leave their area; what could not be judged is not clean."""
    index = {o.instance: k for k, o in enumerate(judged.objects)}
    found = {
        k
        for k, o in enumerate(judged.objects)
        if o.floats is not False or o.leaves_table or o.enters_restricted_zone or 1e3 * o.table_penetration > MAX_PENETRATION_MM
    }
    for pair in judged.pairs:
        if pair.penetration is None or 1e3 * pair.penetration > MAX_PENETRATION_MM:
            found |= {index[pair.first], index[pair.second]}
    return frozenset(found)
