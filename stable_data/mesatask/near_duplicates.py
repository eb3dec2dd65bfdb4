"""Groups of near-duplicate scenes; the scenes of a group are in the same split."""

import hashlib

from stable_data.scene import Scene


def duplicate_group(scene: Scene) -> str:
    """Returns the group of a scene and its possible near-duplicates, 16 hexadecimal digits.

    Such scenes have the same table type and the same assets, at any poses.
    """
    content = sorted(f"{o.category}:{o.asset_id}" for o in scene.objects)
    return hashlib.sha256("\n".join([scene.table.table_type, *content]).encode()).hexdigest()[:16]
