"""What a physics engine is given of a scene: convex parts of its objects in their yaw frames. An asset is cut up once."""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

from scipy.spatial.transform import Rotation

from stable_data.assets.store import AssetStore
from stable_data.geometry.convex_decomposition import collider_parts
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene, SceneObject
from stable_data.simulation.settling import RigidBody, hull_volume

DENSITY = 400.0
"""Of an object of which nothing says what it weighs, kg/m³."""

_LIGHTEST = 1e-3  # kilograms

_CUT_UP: WeakKeyDictionary[AssetStore, dict[str, tuple[Mesh, ...]]] = WeakKeyDictionary()
# A store has one shape for an asset at a scale and tilt.
_PARTS: WeakKeyDictionary[Shape, tuple[Mesh, ...]] = WeakKeyDictionary()


def parts_of(o: SceneObject, shape: Shape, store: AssetStore) -> tuple[Mesh, ...]:
    """Convex parts of an object, metres, yaw frame, centred on its box as its shape is.

    Args:
        o: The object, resolved: its scale is the one its mesh has (``AssetStore.resolved``).
        shape: Its geometry.
        store: Where its mesh is; keeps its asset's parts as long as it lives.

    Returns:
        The same meshes each time for the same shape, so that an engine is given them once however many objects have them.

    Raises:
        MeshError: Nothing that has a volume could be made of the mesh.
    """
    if shape not in _PARTS:
        _PARTS[shape] = _parts_of(o, shape, store)
    return _PARTS[shape]


def _parts_of(o: SceneObject, shape: Shape, store: AssetStore) -> tuple[Mesh, ...]:
    mesh = store.mesh_of(o) if shape.is_exact else None
    if mesh is None or o.asset_id is None or o.scale is None:
        return (Mesh(shape.vertices, shape.faces),)
    parts = asset_parts(o.asset_id, mesh, store)
    turn = (Rotation.from_quat(o.tilt_quat_xyzw).as_matrix() * o.scale).T
    centre = mesh.vertices[0] @ turn - shape.vertices[0]
    return tuple(Mesh(part.vertices @ turn - centre, part.faces) for part in parts)


def asset_parts(asset_id: str, mesh: Mesh, store: AssetStore) -> tuple[Mesh, ...]:
    """Convex parts of an asset, in the frame and unit of its mesh.

    Those that a run keeps of it, in its table ``meshes``; else those that came with its file, where they are true to the mesh;
    else the mesh is cut up.

    Args:
        asset_id: The asset.
        mesh: Its repaired mesh.
        store: Where it is; keeps its parts as long as it lives.

    Raises:
        MeshError: Nothing that has a volume could be made of the mesh.
    """
    known = _CUT_UP.setdefault(store, {})
    if asset_id not in known:
        known[asset_id] = store.kept_parts(asset_id) or collider_parts(mesh, given=store.colliders(asset_id))
    return known[asset_id]


def bodies_of(scene: Scene, shapes: Sequence[Shape], store: AssetStore, density: float = DENSITY) -> list[RigidBody]:
    """The objects of a scene as an engine sees them.

    Args:
        scene: The scene, resolved (``AssetStore.resolved``).
        shapes: The geometry of its objects, in its order.
        store: Where their meshes are.
        density: Of every object, kg/m³.

    Raises:
        MeshError: Nothing that has a volume could be made of a mesh.
    """
    bodies = []
    for o, shape in zip(scene.objects, shapes, strict=True):
        parts = parts_of(o, shape, store)
        mass = max(_LIGHTEST, density * sum(map(hull_volume, parts)))
        bodies.append(RigidBody(o.instance, parts, mass, o.position, o.yaw))
    return bodies
