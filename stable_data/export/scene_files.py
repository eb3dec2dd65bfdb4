"""What is known of a scene, as JSON: for formats whose files have no place for a scene, or none for its task."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stable_data.atomic_files import write_file_atomically
from stable_data.condition import condition_document
from stable_data.export.props import PlacedProp, placed_props
from stable_data.scene import QuatXyzw, Vec3
from stable_data.simulation.mujoco_model import CAMERAS
from stable_data.simulation.render import FIELD_OF_VIEW, camera_pose
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import GRAVITY, TABLE_DEPTH, PhysicsOptions

PICTURE = (640, 480)
"""Width and height of the pictures of the cameras, pixels; only the ratio matters."""

FRAME = (
    "World frame: the table top is z = 0, its near left corner the origin, +x right, +y away from the viewer, z up. The pose of an "
    "object is that of the frame of its file, whose origin is the centre of the base of the object in its usual resting tilt."
)

_UNITS = {"length": "metre", "mass": "kilogram", "time": "second", "angle": "radian", "quaternion": "x y z w"}


def scene_facts(geometry: SceneGeometry) -> dict[str, Any]:
    """Returns task, relations, verdicts and cameras of a scene, as values of JSON; an unknown verdict is None."""
    scene, task = geometry.scene, geometry.scene.task
    facts: dict[str, Any] = {
        "scene_id": scene.scene_id,
        "table_type": scene.table.table_type,
        "task": None,
        "relations": [{"subject": r.subject, "kind": str(r.kind), "target": r.target} for r in scene.relations],
        "verdicts": {name: _known(value) for name, value in geometry.verdicts.items()},
        "cameras": [],
    }
    if task is not None:
        facts["task"] = {
            "instruction": task.task,
            "environment": task.environment,
            "goal": list(task.goal),
            "action_sequence": list(task.action_sequence),
            "task_objects": list(task.task_objects),
            "conditions": [condition_document(c) for c in task.conditions],
        }
    for view, position, quat_xyzw in camera_poses(geometry):
        facts["cameras"].append(
            {
                "name": view,
                "position": position,
                "quat_xyzw": quat_xyzw,
                "looks_along": "-z, +y is up",
                "vertical_field_of_view": math.radians(FIELD_OF_VIEW),
            }
        )
    return facts


def camera_poses(geometry: SceneGeometry) -> list[tuple[str, Vec3, QuatXyzw]]:
    """Returns name, position and rotation of the cameras; they look along their -z, +y is up."""
    low, high = geometry.seen_bounds
    return [(view, *camera_pose(low, high, view, PICTURE, geometry.scene.table)) for view in CAMERAS]


def object_facts(placed: PlacedProp) -> dict[str, Any]:
    """Returns what is known of an object, as values of JSON."""
    o = placed.object
    return {
        "instance": o.instance,
        "category": o.category,
        "description": o.description,
        "asset_id": o.asset_id,
        "stage": None if o.stage is None else str(o.stage),
        "support": o.support,
    }


def sliding_friction(placed: PlacedProp | None) -> float:
    """The coefficient of sliding friction of an object, or of the table."""
    own = None if placed is None else placed.friction
    return (PhysicsOptions().friction if own is None else own)[0]


def table_box(geometry: SceneGeometry) -> tuple[Vec3, Vec3]:
    """Centre and size of the box that is the collider of the table, metres, world frame."""
    x, y = geometry.scene.table.size_xy
    return (x / 2, y / 2, -TABLE_DEPTH / 2), (x, y, TABLE_DEPTH)


def put_layout(
    geometry: SceneGeometry,
    path: Path,
    out: Path,
    key: str,
    put_object: Callable[[PlacedProp, SceneGeometry, Path], str],
    put_table: Callable[[SceneGeometry, Path], str],
) -> None:
    """Writes a scene in a format that has a file for each object: the objects, the table, and last the file of the scene.

    Args:
        geometry: The scene.
        path: The file of the scene, one folder below ``out``.
        out: The folder of the export; objects are in its folder ``objects``, the table in ``tables``.
        key: Name of the format of the files, which is their key.
        put_object: Writes the file of an object, if it does not exist, and returns its path in the folder.
        put_table: The same for the table.

    Raises:
        MeshError: An object has no solid part.
        OSError: A file cannot be written.
    """
    placed = placed_props(geometry)
    files = [f"../objects/{put_object(p, geometry, out / 'objects')}" for p in placed]
    table = f"../tables/{put_table(geometry, out / 'tables')}"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file_atomically(path, _layout_file(geometry, placed, key, files, table))


def _layout_file(geometry: SceneGeometry, placed: Sequence[PlacedProp], key: str, files: Sequence[str], table: str) -> bytes:
    """Returns the content of the file of a scene for a format that has a file for each object and none for a scene.

    Args:
        geometry: The scene.
        placed: Its objects.
        key: Name of the format of the files, which is their key.
        files: The file of each object, relative to the folder of the scene's file.
        table: The file of the table.
    """
    _, size = table_box(geometry)
    objects = [
        {
            "name": p.name,
            key: file,
            "position": p.position,
            "quat_xyzw": p.quat_xyzw,
            "fixed": p.is_fixed,
            "mass": p.mass.mass,
            "friction": sliding_friction(p),
            "size": [p.factor * side for side in p.prop.size],
            **object_facts(p),
        }
        for p, file in zip(placed, files, strict=True)
    ]
    content = {
        "format": f"stable-data scene of {key} files, version 1",
        "units": _UNITS,
        "frame": FRAME,
        "paths": "relative to this file",
        "gravity": [0.0, 0.0, -GRAVITY],
        "table": {
            "name": "table",
            key: table,
            "position": [0.0, 0.0, 0.0],
            "quat_xyzw": [0.0, 0.0, 0.0, 1.0],
            "fixed": True,
            "size": size,
            "friction": sliding_friction(None),
        },
        "objects": objects,
        **scene_facts(geometry),
    }
    return json_file(content)


def json_file(content: Any, indent: int | None = 1) -> bytes:
    """Returns the content of a JSON file."""
    return (json.dumps(content, ensure_ascii=False, allow_nan=False, indent=indent) + "\n").encode()


def _known(value: float | bool | None) -> float | bool | None:
    if value is None or isinstance(value, bool | int):
        return value
    return float(value) if math.isfinite(value) else None
