"""Rigid bodies of a scene for the physics engine: convex parts of its objects, in their yaw frames. An asset is decomposed once."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.assets.user_cache import ArrayFiles, array_key
from stable_data.cache_folder import user_cache
from stable_data.geometry import convex_decomposition
from stable_data.geometry.convex_decomposition import ConvexPart, collider_parts
from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh import Mesh, join_meshes
from stable_data.geometry.shape import Shape
from stable_data.scene import FloatArray, IntArray, Scene, SceneObject
from stable_data.simulation.settling import Inertial, RigidBody, hull_volume

DENSITY = 400.0
"""Density of every object whose mass is not known, kg/m³."""

_LIGHTEST = 1e-3  # kilograms

# Caches, which end with their store or shape. A store has one shape for an asset at a scale and tilt.
_ASSET_PARTS: WeakKeyDictionary[AssetStore, dict[str, tuple[Mesh, ...]]] = WeakKeyDictionary()
_SHAPE_PARTS: WeakKeyDictionary[Shape, tuple[Mesh, ...]] = WeakKeyDictionary()


def parts_of(o: SceneObject, shape: Shape, store: AssetStore) -> tuple[Mesh, ...]:
    """Returns the convex parts of an object, metres, yaw frame, centred on its box as its shape is.

    Args:
        o: The object, resolved: its scale is that of its mesh (``AssetStore.resolved``).
        shape: Its geometry.
        store: The store of its mesh; the parts of the asset are cached as long as it exists.

    Returns:
        The same meshes each time for the same shape, so that a model contains them once for any number of objects.

    Raises:
        MeshError: No part with a volume could be made of the mesh.
    """
    if shape not in _SHAPE_PARTS:
        _SHAPE_PARTS[shape] = _parts_of(o, shape, store)
    return _SHAPE_PARTS[shape]


def _parts_of(o: SceneObject, shape: Shape, store: AssetStore) -> tuple[Mesh, ...]:
    mesh = store.mesh_of(o) if shape.is_exact else None
    if mesh is None or o.asset_id is None or o.scale is None:
        return (Mesh(shape.vertices, shape.faces),)
    parts = asset_parts(o.asset_id, mesh, store)
    turn = (Rotation.from_quat(o.tilt_quat_xyzw).as_matrix() * o.scale).T
    centre = mesh.vertices[0] @ turn - shape.vertices[0]  # the shape is the same mesh, moved to the centre of its box
    return tuple(Mesh(part.vertices @ turn - centre, part.faces) for part in parts)


def asset_parts(asset_id: str, mesh: Mesh, store: AssetStore) -> tuple[Mesh, ...]:
    """Returns the convex parts of an asset, in the frame and unit of its mesh.

    They are the parts that the run stores in its table ``meshes``; else the parts in the asset's file, if they fit the mesh;
    else a decomposition of the mesh, which the user's cache keeps.

    Args:
        asset_id: The asset.
        mesh: Its repaired mesh.
        store: Its store; the parts are cached as long as it exists.

    Raises:
        MeshError: No part with a volume could be made of the mesh.
    """
    known = _ASSET_PARTS.setdefault(store, {})
    if asset_id not in known:
        known[asset_id] = store.stored_parts(asset_id) or _decomposed(mesh, store.colliders(asset_id))
    return known[asset_id]


def _decomposed(mesh: Mesh, given: Sequence[ConvexPart]) -> tuple[Mesh, ...]:
    """The convex parts of a mesh, from the user's cache if they are there."""
    files = ArrayFiles(user_cache("convex_parts"))
    contents = [array.tobytes() for each in (mesh, *given) for array in (each.vertices, each.faces)]
    key = array_key(Path(convex_decomposition.__file__), repr(_versions()).encode(), *contents)
    found = files.read(key)
    if found is not None and {"vertices", "faces", "counts"} <= found.keys():
        return _split(found["vertices"], found["faces"], found["counts"])
    parts = collider_parts(mesh, given=given)
    counts = np.array([(len(part.vertices), len(part.faces)) for part in parts])
    vertices, faces = (np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "faces"))
    files.write(key, {"vertices": vertices, "faces": faces, "counts": counts})
    return parts


@cache
def _versions() -> list[str]:
    """The versions of the libraries that decompose meshes."""
    return [version(name) for name in ("manifold3d", "fast-simplification", "vhacdx")]


def _split(vertices: FloatArray, faces: IntArray, counts: IntArray) -> tuple[Mesh, ...]:
    ends = np.cumsum(counts, axis=0)[:-1]
    return tuple(Mesh(v, f) for v, f in zip(np.split(vertices, ends[:, 0]), np.split(faces, ends[:, 1]), strict=True))


def bodies_of(scene: Scene, shapes: Sequence[Shape], store: AssetStore, density: float = DENSITY) -> list[RigidBody]:
    """Returns the objects of a scene as rigid bodies for the physics engine.

    Mass, centre of mass, inertia and friction are those that the store knows of an asset (``AssetStore.physics``), at the scale and
    tilt of the object. Else the parts have a fixed density. A body has at least 1 g.

    Args:
        scene: The scene, resolved (``AssetStore.resolved``).
        shapes: The geometry of its objects, in its order.
        store: The store of their meshes.
        density: Density of every object whose mass is not known, kg/m³.

    Raises:
        MeshError: No part with a volume could be made of a mesh.
    """
    bodies = [_body(o, shape, store, density) for o, shape in zip(scene.objects, shapes, strict=True)]
    return [replace(body, movable=False) if body.name in scene.fixed else body for body in bodies]


def _body(o: SceneObject, shape: Shape, store: AssetStore, density: float) -> RigidBody:
    parts = parts_of(o, shape, store)
    volume = sum(map(hull_volume, parts))
    mesh = store.mesh_of(o) if shape.is_exact else None
    physics = store.physics(o.asset_id) if o.asset_id is not None and mesh is not None else None
    if mesh is None or o.scale is None or physics is None:
        return RigidBody(o.instance, parts, max(_LIGHTEST, density * volume), o.position, o.yaw)
    here = physics.at(o.scale)
    mass = max(_LIGHTEST, here.mass)
    body = RigidBody(o.instance, parts, mass, o.position, o.yaw, friction=here.friction)
    if not volume > 0 or (here.center_of_mass is None and here.inertia is None):
        return body  # no solid part, which the engine refuses; or homogeneous parts
    turn = Rotation.from_quat(o.tilt_quat_xyzw).as_matrix()
    middle, tensor = here.center_of_mass, here.inertia
    if middle is not None:
        middle = turn @ middle + shape.vertices[0] - turn @ (mesh.vertices[0] * o.scale)  # as the parts
    if tensor is not None:
        tensor = turn @ tensor @ turn.T * (mass / here.mass)
    if middle is None or tensor is None:  # what is missing is that of homogeneous parts
        whole = mass_properties(join_meshes([part for part in parts if hull_volume(part) > 0]), mass=mass)
        middle = whole.center_of_mass if middle is None else middle
        tensor = whole.inertia if tensor is None else tensor
    return replace(body, inertial=Inertial(middle, tensor))
