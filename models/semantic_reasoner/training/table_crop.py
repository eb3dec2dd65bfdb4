"""Crops a table to a smaller one, so that a model trained on large tables can lay out a small one."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stable_data.rotations import half_extents_xy
from stable_data.scene import FloatArray, RelationKind, Stage
from stable_data.scene_graph.support_tree import SupportTree
from stable_data.storage.schemas import Row

_MIN_SIDE = 0.35
"""Shortest side of a crop, metres; shorter only if the table is."""


def crop_table(row: Row, rng: np.random.Generator) -> Row | None:
    """Crops the table of a row of ``samples`` to a random window that contains all task objects.

    Args:
        row: The row.
        rng: Draws the window; the same state gives the same window to all stages of a scene.

    Returns:
        A row with the window as its table, of uniform size, and the objects that are entirely inside; None if the instruction
        mentions a part of the whole table, or no object of the stage would remain.
    """
    task: Mapping[str, Any] = row["task"] or {}
    if "corner" in task.get("task", "") or any(r["kind"] == RelationKind.IS_AT for r in task.get("relations") or ()):
        return None
    objects = [*row["objects_in"], *row["objects_out"]]
    outline = _outlines(objects)
    needed = [outline[o["instance"]] for o in objects if o["stage"] == Stage.TASK]
    table = np.array(row["table_size"], np.float64)
    if not needed:
        return None
    low, high = np.min([low for low, _ in needed], 0), np.max([high for _, high in needed], 0)
    low, high = np.clip(low, 0, table), np.clip(high, 0, table)  # objects beyond the edge stay beyond it
    size = rng.uniform(np.minimum(np.maximum(high - low, _MIN_SIDE), table), table)
    start = rng.uniform(np.maximum(0, high - size), np.minimum(low, table - size) + 1e-9)
    inside = {
        name
        for name, (a, b) in outline.items()
        if np.all(np.maximum(a, 0) >= start) and np.all(np.minimum(b, table) <= start + size)
    }
    cropped = {
        key: [_moved(o, start) for o in row[key] if o["instance"] in inside or o["stage"] == Stage.TASK]
        for key in ("objects_in", "objects_out")
    }
    if not cropped["objects_out"] and row["stage"] != Stage.IMPORTANT:
        return None
    return {**row, **cropped, "table_size": tuple(size.tolist()), "restricted_zone": _zone(row["restricted_zone"], start, size)}


def _outlines(objects: Sequence[Mapping[str, Any]]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Bounds (least xy, greatest xy) of each object's stack: of all objects with the same lowest support."""
    tree = SupportTree({o["instance"]: o["support"] for o in objects})
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for o in objects:
        groups.setdefault(tree.root(o["instance"]), []).append(o)
    extents = {name: _extent(group) for name, group in groups.items()}
    return {o["instance"]: extents[tree.root(o["instance"])] for o in objects}


def _extent(group: Sequence[Mapping[str, Any]]) -> tuple[FloatArray, FloatArray]:
    low, high = [], []
    for o in group:
        half = half_extents_xy(o["size"], o["yaw"])
        low.append(np.array(o["position"][:2]) - half)
        high.append(np.array(o["position"][:2]) + half)
    return np.min(low, 0), np.max(high, 0)


def _moved(o: Mapping[str, Any], start: FloatArray) -> dict[str, Any]:
    x, y, z = o["position"]
    return {**o, "position": (x - start[0], y - start[1], z)}


def _zone(zone: Sequence[float] | None, start: FloatArray, size: FloatArray) -> tuple[float, ...] | None:
    """The restricted zone's part in the window, (x_min, x_max, y_min, y_max)."""
    if not zone:
        return None
    ends = np.clip(np.array(zone).reshape(2, 2) - start[:, None], 0, size[:, None])
    return None if np.any(ends[:, 1] - ends[:, 0] <= 1e-3) else tuple(ends.reshape(-1).tolist())
