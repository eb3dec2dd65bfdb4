"""Detects which centre of a tilted object a dataset uses as its position, by auditing scenes under both conventions."""

import math
from collections import Counter

from stable_data.assets.store import AssetStore
from stable_data.mesatask import MesaTaskDataset, PositionConvention, reveals_convention
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Scene

_TOLERANCE = 3e-3  # layouts are rounded to 1 mm, and were settled with convex hulls, metres
_NUM_JUDGED = 16  # scenes that are audited under both conventions


def position_convention(dataset: MesaTaskDataset, store: AssetStore, num_scenes: int = 64) -> PositionConvention:
    """Detects the convention of a dataset on an even choice of its scenes.

    Only tilted objects whose two centres differ show the convention. Under the wrong convention they float above their support or
    penetrate it. So the convention is chosen under which more of them rest on a support and penetrate nothing.

    Args:
        dataset: The dataset.
        store: Geometry of its assets.
        num_scenes: Largest number of scenes to read; at most sixteen of those that show the convention are audited.

    Returns:
        The convention; ``box_centre`` if the scenes do not show it.
    """
    revealing: list[tuple[Scene, frozenset[str]]] = []
    for scene_id in dataset.scene_ids[:: max(1, math.ceil(len(dataset.scene_ids) / num_scenes))]:
        try:
            scene, _ = dataset.read(scene_id)
            pairs = [(o, store.mesh_of(o)) for o in scene.objects]
            names = frozenset(o.instance for o, mesh in pairs if mesh is not None and reveals_convention(o, mesh.vertices))
        except MemoryError:
            raise
        except Exception:  # noqa: BLE001, S112 - the scene shows nothing about positions; the step that uses it reports the error
            continue
        if names:
            revealing.append((scene, names))
    num_resting: Counter[PositionConvention] = Counter()
    for scene, names in revealing[:: max(1, math.ceil(len(revealing) / _NUM_JUDGED))]:
        try:
            num_resting.update({c: _count_resting(scene, names, store, c) for c in PositionConvention})
        except MemoryError:
            raise
        except Exception:  # noqa: BLE001, S112 - likewise
            continue
    box, mesh_centre = num_resting[PositionConvention.BOX_CENTRE], num_resting[PositionConvention.MESH_CENTRE]
    return PositionConvention.MESH_CENTRE if mesh_centre > box else PositionConvention.BOX_CENTRE


def _count_resting(scene: Scene, names: frozenset[str], store: AssetStore, convention: PositionConvention) -> int:
    """Counts the named objects that rest on a support and penetrate nothing, under a convention."""
    read, shapes, _ = store.resolved(scene, convention)
    audit = audit_scene(read, shapes, _TOLERANCE)
    deep = {name for p in audit.pairs if p.penetration is None or p.penetration > _TOLERANCE for name in (p.first, p.second)}
    return sum(
        o.instance in names and o.floats is False and o.table_penetration <= _TOLERANCE and o.instance not in deep
        for o in audit.objects
    )
