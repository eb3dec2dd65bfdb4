"""Near-duplicate scenes: they share a group, and with it a split."""

import hashlib

from stable_data.scene import Scene


def duplicate_group(scene: Scene) -> str:
    """The group of a scene and its possible near-duplicates: the same table type and the same assets, wherever these stand.

    Returns:
        16 hexadecimal digits.
    """
    content = sorted(f"{o.category}:{o.asset_id}" for o in scene.objects)
    return hashlib.sha256("\n".join([scene.table.table_type, *content]).encode()).hexdigest()[:16]
