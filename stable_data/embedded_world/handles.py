"""The handles of embedded assets: the parts by which a hand holds a kettle, a mug or a fork."""

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from stable_data.embedded_world.families.catalogue import BY_CATEGORY, NUM_VARIANTS, EmbeddedAsset, asset
from stable_data.geometry.mesh import Mesh
from stable_data.scene import FloatArray, SceneObject

_ON = 1e-4  # how far a face may be outside of the handle's parts, metres


def handle_of(o: SceneObject) -> tuple[FloatArray, ...]:
    """Returns the handle of an object, if its asset is one of the embedded world with a handle.

    Args:
        o: The object, with the scale of its mesh.

    Returns:
        Corners of the convex parts of the handle, (K, 3) float64 each, metres, yaw frame, centred on the box of the object; empty
        without a handle, and if nothing is known of the asset.
    """
    found = _assets(o.category).get(o.asset_id or "")
    if found is None or o.scale is None or not found.handle:
        return ()
    turn = (Rotation.from_quat(o.tilt_quat_xyzw).as_matrix() * o.scale).T
    tilted = found.mesh.vertices @ turn
    low, high = tilted.min(axis=0), tilted.max(axis=0)
    unit = float(np.mean(np.array(o.size) / (high - low)))  # of the mesh to which the scale belongs
    return tuple((part @ turn - (low + high) / 2) * unit for part in found.handle)


def is_of_handle(mesh: Mesh, handle: tuple[FloatArray, ...]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Tells which faces of a mesh belong to its handle, (F,) bool: those whose middle is in one of the handle's parts.

    Args:
        mesh: The mesh of an object, metres, yaw frame, centred on its box.
        handle: The parts, see :func:`handle_of`.
    """
    middles = mesh.triangles.mean(axis=1)
    found = np.zeros(len(middles), np.bool_)
    for part in handle:
        planes = ConvexHull(part).equations
        found |= (middles @ planes[:, :3].T + planes[:, 3] <= _ON).all(axis=1)
    return found


@lru_cache(maxsize=1024)
def _assets(category: str) -> Mapping[str, EmbeddedAsset]:
    """The assets of a category by uid; none if the embedded world does not have it."""
    if category not in BY_CATEGORY:
        return {}
    return {found.uid: found for found in (asset(f"{category}/{n}") for n in range(NUM_VARIANTS))}
