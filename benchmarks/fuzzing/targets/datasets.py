"""Targets: datasets in the MesaTask-10K format, and their single files."""

import json
from pathlib import Path

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.targets.results import DATA, check_lint, check_notices, check_scene, files_below
from stable_data.json_text import document_of
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.features import read_text_features
from stable_data.mesatask.layout import LAYOUT_FILE, read_layout, read_reply_layout
from stable_data.mesatask.lint import lint_folder
from stable_data.mesatask.task_info import TASK_INFO_FILE, read_task_info
from stable_data.mesatask.writing import write_layout
from stable_data.task_info import task_info_of

_KEYS = (
    *(
        "objects",
        "instance",
        "position",
        "rotation",
        "size",
        "scale_factor",
        "z_rotation",
        "original_size",
        "selected_uid",
        "retrieved_uid",
    ),
    *(
        "description",
        "item_placement_zone",
        "sink_zone",
        "scene_settings",
        "units",
        "up_axis",
        "rotation_convention",
        "bbox",
        "mass",
        "min",
    ),
    *(
        "max",
        "isContainer",
        "mark_deletion",
        "meters",
        "y",
        "category",
        "2a26f3f3-5b13-b670-e575-38878aa2fa39_x_90_y_0",
        "1_mug_0",
        "0.5kg",
    ),
)
_SCENES = ("office_table/office_table_0703", "dressing_table/dressing_table_0976", "kitchen_counter/kitchen_counter_1849")
_REPLY = {
    "item_placement_zone": [0, 100, 0, 60],
    "objects": [
        {"instance": "1_mug_0", "description": "a mug", "position": [20, 20, 5], "size": [8, 8, 10], "z_rotation": 30},
        {"instance": "2_book_0", "description": "a book", "position": [60, 30, 2], "size": [20, 14, 4], "z_rotation": 0},
    ],
}
_TASK = {
    "Environment": "An office.",
    "item_placement_zone": [0, 100, 0, 60],
    "Task": "Put the mug on the book.",
    "Goal": ["The mug is on the book."],
    "Action Sequence": ["pick(mug)", "place(mug, book)"],
    "Objects cluster": ["mug", "book"],
    "task_objects": ["1_mug_0", "2_book_0"],
    "relations": [{"subject": "1_mug_0", "kind": "left of", "target": "2_book_0"}],
    "conditions": [{"subject": "1_mug_0", "kind": "on", "target": "2_book_0", "distance": None, "is_negated": False}],
    "origin": "template",
}


def _layouts() -> list[Base]:
    folder = DATA / "Layout_info"
    found = [Base(scene.replace("/", "_"), {LAYOUT_FILE: (folder / scene / LAYOUT_FILE).read_bytes()}) for scene in _SCENES]
    around = f"Thinking.\n```json\n{json.dumps(_REPLY)}\n```<|im_end|>".encode()
    return [*found, Base("reply", {"reply.json": json.dumps(_REPLY).encode()}), Base("reply_text", {"reply.txt": around})]


def _read_layout(folder: Path, base: str) -> bool:
    if base.startswith("reply"):
        name = "reply.json" if base == "reply" else "reply.txt"
        scene = read_reply_layout((folder / name).read_bytes())
    else:
        scene, notices = read_layout((folder / LAYOUT_FILE).read_bytes(), "scene", "office_table")
        check_notices(notices)
    check_scene(scene)
    again, _ = read_layout(json.dumps(write_layout(scene)), "scene", "office_table")
    check_scene(again)
    return True


def _task_infos() -> list[Base]:
    folder = DATA / "Layout_info" / "office_table" / "office_table_0703"
    known = Base("file", {TASK_INFO_FILE: (folder / TASK_INFO_FILE).read_bytes()})
    return [known, Base("whole", {TASK_INFO_FILE: json.dumps(_TASK).encode()})]


def _read_task(folder: Path, base: str) -> bool:
    content = (folder / TASK_INFO_FILE).read_bytes()
    read_task_info(content, "scene")
    try:
        document = document_of(content)
    except ValueError:
        return True
    task_info_of({**_TASK, **document} if isinstance(document, dict) else {})
    return True


def _annotations() -> list[Base]:
    annotations = json.loads((DATA / "Asset_annotation.json").read_bytes())
    few = dict(list(annotations.items())[:3])
    layout = json.dumps(_REPLY).encode()
    files = {f"Layout_info/office_table/scene_0/{LAYOUT_FILE}": layout, "Asset_annotation.json": json.dumps(few).encode()}
    return [Base("annotations", files, {"Asset_annotation.json": 1})]


def _read_annotations(folder: Path, base: str) -> bool:
    dataset = MesaTaskDataset(folder)
    check_notices(dataset.notices)
    for annotation in dataset.annotations.values():
        assert annotation.mass is None or 0 < annotation.mass < float("inf")
    return True


def _features() -> list[Base]:
    import gzip
    import pickle

    import numpy as np

    rows = np.arange(12, dtype=np.float32).reshape(3, 4) / 100
    found = {}
    for protocol in (2, 4, 5):
        found[f"protocol_{protocol}"] = pickle.dumps({"uids": ["a", "b", "c"], "text_features": rows}, protocol=protocol)
    found["names_as_array"] = pickle.dumps({"uids": np.array(["a", "b", "c"]), "text_features": rows}, protocol=4)
    found["rows_as_list"] = pickle.dumps({"uids": ["a", "b"], "text_features": [[0.1, 0.2], [0.3, 0.4]]}, protocol=4)
    found["packed"] = gzip.compress(found["protocol_4"], mtime=0)
    return [Base(name, {"sbert_text_features.pkl": content}) for name, content in found.items()]


def _read_features(folder: Path, base: str) -> bool:
    uids, features = read_text_features(folder / "sbert_text_features.pkl")
    assert len(uids) == len(features)
    return True


def _datasets() -> list[Base]:
    layout = json.loads((DATA / "Layout_info" / _SCENES[0] / LAYOUT_FILE).read_bytes())
    layout["objects"] = layout["objects"][:4]
    uids = {entry.get("selected_uid") or entry["retrieved_uid"] for entry in layout["objects"]}
    annotations = json.loads((DATA / "Asset_annotation.json").read_bytes())
    files = {
        f"Layout_info/office_table/scene_0/{LAYOUT_FILE}": json.dumps(layout).encode(),
        f"Layout_info/office_table/scene_0/{TASK_INFO_FILE}": json.dumps(_TASK).encode(),
        "Asset_annotation.json": json.dumps({uid: annotations[uid] for uid in sorted(uids & annotations.keys())}).encode(),
    }
    meshes = files_below(DATA, *(f"Assets_library/{uid}.glb" for uid in sorted(uids)))
    meshes = {path: content for path, content in meshes.items() if len(content) < 100_000}
    weights = dict.fromkeys(files, 1.0) | {f"Layout_info/office_table/scene_0/{LAYOUT_FILE}": 6.0} | dict.fromkeys(meshes, 1.0)
    return [Base("office", files | meshes, weights)]


def _audit(folder: Path, base: str) -> bool:
    result = lint_folder(folder)
    check_lint(result)
    str(result)
    return bool(result.rows)


TARGETS = (
    Target("layout", 75, _layouts, _read_layout, _KEYS),
    Target(
        "task_info", 40, _task_infos, _read_task, ("on", "in", "left of", "Goal", "Task", "relations", "conditions", "distance")
    ),
    Target("annotation", 25, _annotations, _read_annotations, _KEYS),
    Target("text_features", 50, _features, _read_features),
    Target("dataset", 5, _datasets, _audit, _KEYS, block=50),
)
"""The targets of this module."""
