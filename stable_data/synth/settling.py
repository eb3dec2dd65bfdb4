"""A scene at rest: placed things settled by the engine, read back as poses, and taken only where they stay and are clean."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.mesatask.frame import heading, tilt_of
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.physics import Body, EngineOptions, SettleResult, settle
from stable_data.scene import FloatArray, Scene, SceneObject, Tabletop
from stable_data.shape import Shape
from stable_data.synth.assets import Asset
from stable_data.synth.placing import Placed, yaw_frame_parts

MAX_PENETRATION_MM = 0.4
"""Deepest contact of a scene that is kept: a scene counts as clean up to 0.5 mm."""

_SETTLE = EngineOptions(settle_seconds=1.2, watch_seconds=0.02)
_MAX_MOVE_MM = 1.0


def settled_objects(placed: Sequence[Placed], table: Tabletop) -> tuple[SceneObject, ...] | None:
    """Lets placed things settle.

    Returns:
        The objects where they came to lie, in full precision; None where the engine blew up or something fell off.
    """
    names = instance_names([thing.asset.spec.category for thing in placed])
    bodies = [thing.body(name) for thing, name in zip(placed, names, strict=True)]
    result = settle(bodies, table, _SETTLE)
    if not np.isfinite(result.moves).all() or (result.positions[:, 2] < 0).any():
        return None
    return tuple(_object(thing, name, result, k) for k, (thing, name) in enumerate(zip(placed, names, strict=True)))


def instance_names(categories: Sequence[str]) -> list[str]:
    """The format's names, ``<k>_<category>_<n>``: k counts the objects from 1, n those of a category from 0."""
    return [f"{k + 1}_{category}_{list(categories[:k]).count(category)}" for k, category in enumerate(categories)]


def _object(thing: Placed, name: str, result: SettleResult, index: int) -> SceneObject:
    """The object that a body has become: its tilt is the settled rotation without the yaw, its position the new box's centre."""
    item, source = thing.item, thing.asset
    body_rotation = Rotation.from_quat(result.quats_xyzw[index])
    x, y, z, w = (body_rotation * Rotation.from_quat(item.tilt_quat_xyzw)).as_quat().tolist()
    yaw, _ = heading((x, y, z, w))
    tilt = tilt_of((x, y, z, w), yaw)
    # The body's origin is the centre of the box that the thing had when it was placed.
    old_centre = _box_centre(source, item.scale, item.tilt_quat_xyzw)
    mesh_origin = result.positions[index] - body_rotation.apply(old_centre)
    centre = mesh_origin + Rotation.from_euler("z", yaw).apply(_box_centre(source, item.scale, tilt))
    size = Shape.from_mesh(source.mesh, (item.scale,) * 3, tilt).size
    return SceneObject(
        name,
        source.spec.category,
        _triple(centre),
        yaw,
        _triple(size),
        asset_id=source.uid,
        scale=(item.scale * source.spec.unit,) * 3,
        tilt_quat_xyzw=tilt,
        description=source.annotation.description,
    )


def _box_centre(source: Asset, scale: float, tilt_quat_xyzw: Sequence[float]) -> FloatArray:
    """Centre of the box of a tilted mesh, (3,) float64, metres, from the mesh's own centre."""
    tilted = Rotation.from_quat(np.asarray(tilt_quat_xyzw)).apply(source.mesh.vertices * scale)
    return np.asarray((tilted.min(axis=0) + tilted.max(axis=0)) / 2)


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)


def bodies_of(scene: Scene, placed: Sequence[Placed]) -> list[Body]:
    """The engine's view of a settled scene whose objects were made from these things, in order."""
    return [
        Body(o.instance, yaw_frame_parts(thing.asset, thing.item.scale, o.tilt_quat_xyzw), thing.mass, o.position, o.yaw)
        for o, thing in zip(scene.objects, placed, strict=True)
    ]


def is_at_rest(scene: Scene, placed: Sequence[Placed]) -> bool:
    """Whether the engine, started from the scene as written, leaves everything where it is for 4 s."""
    result = settle(bodies_of(scene, placed), scene.table)
    known = result.engine_penetration_mm is not None and result.settle_move_max_mm is not None
    return bool(
        known
        and result.stable
        and (result.engine_penetration_mm or 0.0) <= MAX_PENETRATION_MM
        and (result.settle_move_max_mm or 0.0) <= _MAX_MOVE_MM
    )


def audit(scene: Scene, placed: Sequence[Placed]) -> Audit:
    """The exact audit of a settled scene."""
    shapes = [
        Shape.from_mesh(thing.asset.mesh, (thing.item.scale,) * 3, o.tilt_quat_xyzw)
        for o, thing in zip(scene.objects, placed, strict=True)
    ]
    return audit_scene(scene, shapes)
