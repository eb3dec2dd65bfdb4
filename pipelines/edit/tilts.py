"""Tilts of long objects that an edit puts into a container, where they lean, or takes out of one, after which they lie."""

from dataclasses import replace

import numpy as np

from models.physics_corrector.certify.static_stability import stands_alone
from models.physics_corrector.certify.support_inference import is_hollow
from models.physics_corrector.stabilization.container_insertion import interior_of, is_long, place_leaning
from models.semantic_reasoner.editing import EditResult
from stable_data.assets.store import AssetStore
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.rotations import stand_on_end
from stable_data.scene import TABLE, UPRIGHT, QuatXyzw, RelationKind, Scene, SceneObject

_ALONG_THE_AXES: tuple[QuatXyzw, ...] = (UPRIGHT, *(stand_on_end(axis) for axis in (0, 1)))


def fit_tilts(scene: Scene, before: Scene, edited: EditResult, store: AssetStore) -> Scene:
    """Gives long objects the tilt of their new place.

    An object that shall be in a container and is longer than it is deep leans there. An object that leaned on another one and
    now is elsewhere lies flat if it cannot stand there; in a container the correction leans it.

    Args:
        scene: The edited scene with its assets, resolved.
        before: The scene before the edit.
        edited: What the edit changes.
        store: The geometry of the assets.
    """
    objects, was = {o.instance: o for o in scene.objects}, {o.instance: o for o in before.objects}
    into = {r.subject: r.target for r in edited.wanted if r.kind is RelationKind.IN and r.target in objects}
    for name in (*edited.added, *edited.changed, *edited.carried):
        o = objects[name]
        container = objects.get(into.get(name, o.support or TABLE))
        if name in into and container is not None:
            objects[name] = _leaning(o, container, store)
        elif _is_elsewhere(o, was.get(name)) and (container is None or not is_hollow(store.shape(container)[0])):
            objects[name] = _lying(o, store)
    return replace(scene, objects=tuple(objects[o.instance] for o in scene.objects))


def standing_on_end(o: SceneObject, store: AssetStore) -> SceneObject:
    """An object with its longest side upright, on the same height."""
    mesh = store.mesh_of(o)
    if mesh is None or o.scale is None:
        return o
    return _tilted(o, mesh, stand_on_end(int(np.argmax(mesh.extents * o.scale))))


def _tilted(o: SceneObject, mesh: Mesh, tilt: QuatXyzw) -> SceneObject:
    """An object at a tilt, on the same height; without a scale it does not change."""
    if o.scale is None:
        return o
    w, d, h = Shape.from_mesh(mesh, o.scale, tilt).size.tolist()
    return replace(o, position=(*o.position[:2], o.bottom + h / 2), tilt_quat_xyzw=tilt, size=(w, d, h))


def _is_elsewhere(o: SceneObject, was: SceneObject | None) -> bool:
    """Whether an object was on another one, or in it, and is not any more."""
    return was is not None and was.support not in (None, TABLE, o.support)


def _leaning(o: SceneObject, container: SceneObject, store: AssetStore) -> SceneObject:
    """A long object at the tilt at which it leans in a container; other objects do not change."""
    interior = interior_of(container, store.shape(container)[0])
    if interior is None or not is_long(o, interior, store):
        return o
    return next(iter(place_leaning([o], interior, store)), o)


def _lying(o: SceneObject, store: AssetStore) -> SceneObject:
    """An object that cannot stand as it is, at the lowest of its tilts at which it can, on the same height."""
    mesh = store.mesh_of(o)
    if mesh is None or o.asset_id is None or o.scale is None or stands_alone(store.shape(o)[0]):
        return o
    shapes = {tilt: store.shape_at(o.asset_id, o.scale, tilt) for tilt in _ALONG_THE_AXES}
    standing = [tilt for tilt, shape in shapes.items() if stands_alone(shape)]
    if not standing:
        return o
    return _tilted(o, mesh, min(standing, key=lambda tilt: float(shapes[tilt].size[2])))
