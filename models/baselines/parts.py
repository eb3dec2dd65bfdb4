"""Convex parts of a scene's objects, in their yaw frames; an asset is cut up once."""

from weakref import WeakKeyDictionary

from scipy.spatial.transform import Rotation

from stable_data.assets import AssetStore
from stable_data.convex import convex_parts
from stable_data.mesh import Mesh
from stable_data.scene import SceneObject
from stable_data.shape import Shape

_CUT_UP: WeakKeyDictionary[AssetStore, dict[str, tuple[Mesh, ...]]] = WeakKeyDictionary()


def parts_of(o: SceneObject, shape: Shape, store: AssetStore) -> tuple[Mesh, ...]:
    """Convex parts of an object, metres, yaw frame, centred on its box as its shape is.

    Args:
        o: The object, resolved: its scale is the one its mesh has (``AssetStore.resolved``).
        shape: Its geometry.
        store: Where its mesh is; keeps its parts as long as it lives.

    Raises:
        MeshError: Nothing that has a volume could be made of the mesh.
    """
    mesh = store.mesh_of(o) if shape.is_exact else None
    if mesh is None or o.asset_id is None or o.scale is None:
        return (Mesh(shape.vertices, shape.faces),)
    known = _CUT_UP.setdefault(store, {})
    if o.asset_id not in known:
        known[o.asset_id] = convex_parts(mesh, given=store.colliders(o.asset_id)).parts
    turn = (Rotation.from_quat(o.tilt_quat_xyzw).as_matrix() * o.scale).T
    centre = mesh.vertices[0] @ turn - shape.vertices[0]
    return tuple(Mesh(part.vertices @ turn - centre, part.faces) for part in known[o.asset_id])
