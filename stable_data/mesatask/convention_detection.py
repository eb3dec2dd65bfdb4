"""Which point of a tilted object a dataset calls its position: judged by what the scenes look like under either reading."""

import math
from collections import Counter

from stable_data.assets.store import AssetStore
from stable_data.mesatask import MesaTaskDataset, PositionConvention, reveals_convention
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Scene

_TOLERANCE = 3e-3  # layouts are written to 1 mm, and settled as hulls, metres
_NUM_JUDGED = 16  # scenes that are audited under both readings


def position_convention(dataset: MesaTaskDataset, store: AssetStore, num_scenes: int = 64) -> PositionConvention:
    """The convention of a dataset, judged on an even choice of its scenes.

    Only tilted objects tell whose two centres are apart. Under the wrong reading they float above what carries them, or sink
    into it; so the reading is taken under which more of them stand or lie on something, and in nothing.

    Args:
        dataset: The dataset.
        store: Geometry of its assets.
        num_scenes: Scenes that are looked at, at most; sixteen of those that tell something are judged.

    Returns:
        The convention; ``box_centre`` where the scenes do not tell.
    """
    telling: list[tuple[Scene, frozenset[str]]] = []
    for scene_id in dataset.scene_ids[:: max(1, math.ceil(len(dataset.scene_ids) / num_scenes))]:
        try:
            scene, _ = dataset.read(scene_id)
            pairs = [(o, store.mesh_of(o)) for o in scene.objects]
            names = frozenset(o.instance for o, mesh in pairs if mesh is not None and reveals_convention(o, mesh.vertices))
        except Exception:  # noqa: BLE001, S112 - says nothing about positions; its own step reports it
            continue
        if names:
            telling.append((scene, names))
    sound: Counter[PositionConvention] = Counter()
    for scene, names in telling[:: max(1, math.ceil(len(telling) / _NUM_JUDGED))]:
        try:
            sound.update({convention: _num_sound(scene, names, store, convention) for convention in PositionConvention})
        except Exception:  # noqa: BLE001, S112 - likewise
            continue
    box, mesh_centre = sound[PositionConvention.BOX_CENTRE], sound[PositionConvention.MESH_CENTRE]
    return PositionConvention.MESH_CENTRE if mesh_centre > box else PositionConvention.BOX_CENTRE


def _num_sound(scene: Scene, names: frozenset[str], store: AssetStore, convention: PositionConvention) -> int:
    """How many of some objects are carried by something and in nothing, under a reading."""
    read, shapes, _ = store.resolved(scene, convention)
    audit = audit_scene(read, shapes, _TOLERANCE)
    deep = {name for p in audit.pairs if p.penetration is None or p.penetration > _TOLERANCE for name in (p.first, p.second)}
    return sum(
        o.instance in names and o.floats is False and o.table_penetration <= _TOLERANCE and o.instance not in deep
        for o in audit.objects
    )
