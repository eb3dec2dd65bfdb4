"""Builders: a lamp on a desk as the format has it, whole or broken in one way."""

import json
import math
from pathlib import Path
from typing import Any

from stable_data.mesatask import (
    AssetAnnotation,
    read_layout,
    write_annotations,
    write_asset,
)
from stable_data.scene import Scene

UID = "0a46feae77af42c3b37c149b11d35c6a"
LAID_FLAT = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))


def entry(**changes: Any) -> dict[str, Any]:
    """An upright lamp; a value of None leaves its key out."""
    made = {
        "name": f"2_desk_lamp_0_{UID}",
        "instance": "2_desk_lamp_0",
        "retrieved_uid": UID,
        "selected_uid": UID,
        "original_size": [0.18, 0.32, 0.44],
        "scale_factor": [100.1, 100.1, 100.1],
        "rotation": [0.0, 0.0, math.sin(-0.4), math.cos(-0.4)],
        "z_rotation": -0.8,
        "size": [18.0, 32.0, 44.0],
        "position": [60.0, 41.2, 22.0],
    } | changes
    return {key: value for key, value in made.items() if value is not None}


def layout(*objects: dict[str, Any], **changes: Any) -> dict[str, Any]:
    made = {
        "scene_settings": {"units": "centimeters", "up_axis": "Z"},
        "item_placement_zone": [0.0, 120.0, 0.0, 66.0],
        "objects": list(objects) or [entry()],
    } | changes
    return {key: value for key, value in made.items() if value is not None}


def read(document: object, **options: Any) -> tuple[Scene, list[str]]:
    """The scene of a document that went through JSON, and the codes of its notices."""
    scene, notices = read_layout(json.dumps(document).encode(), "scene_0", "office_table", **options)
    assert all(notice.step == "read" and notice.item_id == "scene_0" and notice.code in CODES for notice in notices)
    return scene, [notice.code for notice in notices]


CODES = {
    "duplicate_instance",
    "instance_missing",
    "restricted_zone_empty",
    "rotation_invalid",
    "rotation_missing",
    "rotation_not_unit",
    "rotation_wrong_length",
    "scale_factor_missing",
    "scale_invalid",
    "scale_negative",
    "scale_zero",
    "size_disagrees",
    "size_invalid",
    "size_missing",
    "uid_invalid",
    "uid_missing",
    "z_rotation_disagrees",
    "z_rotation_invalid",
}


def make_dataset(root: Path, *objects: dict[str, Any]) -> Path:
    """A folder with one scene and the lamp's GLB; returns the scene's folder."""
    folder = root / "Layout_info" / "office_table" / "office_table_0001"
    folder.mkdir(parents=True)
    (folder / "layout.json").write_text(json.dumps(layout(*objects)))
    write_annotations(root, {UID: AssetAnnotation(UID, "Desk-Lamp", caption="A lamp.")})
    write_asset(root, UID, b"glTF")
    return folder
