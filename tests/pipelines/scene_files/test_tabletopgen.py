"""Scenes as TabletopGen writes them become scenes of a dataset: each mesh is where its own assembly puts it, after half a turn."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from pipelines.__main__ import app
from pipelines.sources.layout_files import LayoutFiles
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_reader import load_glb
from stable_data.importers.tabletopgen import scene_folders
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import audit_scene
from stable_data.rotations import rotation_matrix, yaw_quat
from stable_data.scene import FloatArray, Scene

WEDGE = np.array([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1.0]])  # no symmetry
TABLE = {"size": [120, 80, 75], "pose": [4.0, -3.0, 37.5]}
OBJECTS: dict[str, dict[str, Any]] = {
    "table_2": TABLE,
    "coffee mug_0": {"size": [12.0, 9.0, 10.0], "pose": [34.0, 17.0, 80.0]},
    "coffee mug_1": {"size": [8.0, 8.0, 8.0], "pose": [-26.0, 7.0, 79.0]},
    "book_3": {"size": [20.0, 15.0, 3.0], "pose": [14.0, -23.0, 76.5]},
    "stool_4": {"size": [30.0, 30.0, 40.0], "pose": [4.0, 90.0, 20.0]},
}
TURNS = {"table_2": 0.0, "coffee mug_0": 35.0, "book_3": -100.0}
ORDER = {
    "table_2": {"order": 1, "on_top_of": None},
    "book_3": {"order": 2, "on_top_of": "table_2"},
    "coffee mug_0": {"order": 3, "on_top_of": ["table_2"]},
    "coffee mug_1": {"order": 4, "on_top_of": "book_3"},
    "stool_4": {"order": 5, "on_top_of": None},
}


def wedge() -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(WEDGE, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], process=False)
    mesh.apply_translation((0.1, 0.05, -0.2) - mesh.bounds.mean(axis=0))  # its box is hardly ever exactly on the origin
    return mesh


def write_scene_of_tabletopgen(folder: Path, turns: dict[str, float] | None = None) -> None:
    layouts, meshes = folder / "output_assets" / "layout_json", folder / "output_assets" / "centered_mesh"
    layouts.mkdir(parents=True)
    meshes.mkdir()
    document = {"main_object": "table_2", "objects": OBJECTS, "metadata": {"calculation_order": list(OBJECTS)}}
    (layouts / "layout_pose.json").write_text(json.dumps(document))
    (layouts / "layout_rotation.json").write_text(json.dumps(TURNS if turns is None else turns))
    (layouts / "placement_order.json").write_text(json.dumps(ORDER))
    for name in OBJECTS:
        wedge().export(meshes / f"{name}.glb")


@pytest.fixture
def made(tmp_path: Path) -> Path:
    root = tmp_path / "output_scene"
    for number in (1, 2, 10):
        write_scene_of_tabletopgen(root / f"scene_{number}")
    return root


def corners_by_tabletopgen(name: str, turns: dict[str, float]) -> FloatArray:
    """Where its own assembly puts the corners of a mesh, metres."""
    mesh, entry = wedge(), OBJECTS[name]
    scaled = mesh.vertices * (np.array(entry["size"]) / 100 / mesh.extents)
    found: FloatArray = scaled @ rotation_matrix(yaw_quat(math.radians(turns.get(name, 0.0)))).T + np.array(entry["pose"]) / 100
    return found


def corners_here(scene: Scene, dataset: MesaTaskDataset, k: int) -> FloatArray:
    o = scene.objects[k]
    path = dataset.asset_path(o.asset_id or "")
    assert path is not None
    assert o.scale is not None
    mesh, _ = load_glb(path, path.stem)
    found: FloatArray = (mesh.vertices * np.array(o.scale)) @ rotation_matrix(yaw_quat(o.yaw)).T + np.array(o.position)
    return found


def in_order(points: FloatArray) -> FloatArray:
    return points[np.lexsort(np.round(points, 6).T)]


@pytest.mark.parametrize("table_turn", [180.0, 20.0, *(pytest.param(turn, marks=pytest.mark.slow) for turn in (0.0, 90.0))])
def test_meshes_are_where_its_own_assembly_puts_them(table_turn: float, tmp_path: Path) -> None:
    turns = {**TURNS, "table_2": table_turn}
    write_scene_of_tabletopgen(tmp_path / "theirs" / "scene_7", turns)
    done = CliRunner().invoke(app, ["import-tabletopgen", str(tmp_path / "theirs"), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "'stool_4' is not on the table" in done.output
    assert "'coffee mug_1' has no rotation" in done.output
    assert "1 scenes, 2 warnings, 0 failures" in done.output
    dataset = MesaTaskDataset(tmp_path / "out")
    scene, notices = dataset.read("scene_7")
    assert not notices
    assert scene.table.table_type == "table"
    assert scene.table.size_xy == pytest.approx((0.8, 1.2) if table_turn == 90.0 else (1.2, 0.8))
    assert [o.category for o in scene.objects] == ["coffee_mug", "coffee_mug", "book"]
    assert [o.instance for o in scene.objects] == ["0_coffee_mug_0", "1_coffee_mug_1", "2_book_0"]
    store = AssetStore(dataset)
    rest = math.radians(20.0 if table_turn == 20.0 else 0.0)
    for k, name in enumerate(("coffee mug_0", "coffee mug_1", "book_3")):
        theirs = corners_by_tabletopgen(name, turns) - np.array([0.04, -0.03, 0.75])
        turned = theirs @ rotation_matrix(yaw_quat(math.pi - rest)).T + np.array(
            [*(side / 2 for side in scene.table.size_xy), 0.0]
        )
        assert in_order(corners_here(scene, dataset, k)) == pytest.approx(in_order(turned), abs=1e-6)
    _, shapes, _ = store.resolved(scene)
    assert audit_scene(scene, shapes).card().oc is not None


def test_scenes_get_the_ids_of_their_tasks_and_are_found_by_them(made: Path, tmp_path: Path) -> None:
    assert scene_folders(made) == ["scene_1", "scene_2", "scene_10"]
    task = {"instruction": "Set the table.", "table_type": "dining_table", "table_size_cm": [120, 80]}
    rows = [json.dumps({**task, "scene_id": name}) for name in ("first", "second")]
    (tmp_path / "tasks.jsonl").write_text("\n".join(rows))
    command = ["import-tabletopgen", str(made), "--out", str(tmp_path / "out"), "--tasks", str(tmp_path / "tasks.jsonl")]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 1
    assert "'scene_10' has the number of no task" in done.output
    files = LayoutFiles(str(tmp_path / "out"))
    for name in ("first", "second"):
        found, _ = files.of_task(name)
        assert isinstance(found, Scene)
        assert len(found.objects) == 3
    again = CliRunner().invoke(app, command)
    assert again.exit_code == 2
    assert "has content" in again.output


BROKEN: tuple[tuple[str, str | dict[str, Any] | None, str], ...] = (
    ("layout_pose.json", "{", "layout_pose.json"),
    ("layout_pose.json", '{"main_object": "table_2", "objects": {}}', "lacks objects"),
    ("layout_pose.json", None, "does not exist"),
    ("layout_rotation.json", '{"book_3": "left"}', "rotation of 'book_3' is no number"),
    ("layout_pose.json", {"book_3": {"size": [1, 2], "pose": [0, 0, 80]}}, "size of 'book_3' is not known"),
    (
        "layout_pose.json",
        {"book_3": {"size": [1, 2, 0], "pose": [0, 0, 80]}},
        "expected three lengths in centimetres above 0",
    ),
    ("layout_pose.json", {"book_3": {"size": [1, 2, 3], "pose": [0, 0, 1e999]}}, "pose of 'book_3' is not known"),
    ("layout_pose.json", {"book_3": {"size": [1, 2, 1e308], "pose": [0, 0, 80]}}, "above 0, at most 100,000"),
    ("layout_pose.json", {"book_3": {"size": [1, 2, 3], "pose": [-1e308, 0, 80]}}, "in centimetres, at most 100,000"),
    ("layout_pose.json", {f"book_{k}": TABLE for k in range(600)}, "objects, expected at most 500"),
    ("../centered_mesh/book_3.glb", "no mesh", "book_3.glb"),
)


def test_broken_scenes_are_named_and_the_others_are_imported(tmp_path: Path) -> None:
    made = tmp_path / "output_scene"
    names = [f"scene_{number}" for number in range(2, 2 + len(BROKEN))]
    for name in ("scene_1", *names, "scene_20"):
        write_scene_of_tabletopgen(made / name)
    for name, (file, content, _) in zip(names, BROKEN, strict=True):
        path = made / name / "output_assets" / "layout_json" / file
        if content is None:
            path.unlink()
        elif isinstance(content, str):
            path.write_text(content)
        else:
            path.write_text(json.dumps({"main_object": "table_2", "objects": {**OBJECTS, **content}}))
    done = CliRunner().invoke(app, ["import-tabletopgen", str(made), "--out", str(tmp_path / "out")])
    assert done.exit_code == 1, done.output
    lines = [line for line in done.output.splitlines() if "scene_" in line]
    for name, (_, _, what) in zip(names, BROKEN, strict=True):
        assert any(line.startswith(f"not imported: {name}: ") and what in line for line in lines), "\n".join([name, *lines])
    assert "2 scenes" in done.output
    left = {"_".join(path.name.split("_")[:2]) for path in (tmp_path / "out" / "Assets_library").glob("scene_*")}
    assert left == {"scene_1", "scene_20"}
    assert set(MesaTaskDataset(tmp_path / "out").scene_ids) == {"scene_1", "scene_20"}


def test_an_object_without_a_mesh_is_left_out_with_a_warning(made: Path, tmp_path: Path) -> None:
    (made / "scene_1" / "output_assets" / "centered_mesh" / "book_3.glb").unlink()
    done = CliRunner().invoke(app, ["import-tabletopgen", str(made), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0
    assert "'book_3' has no mesh" in done.output
    assert len(MesaTaskDataset(tmp_path / "out").read("scene_1")[0].objects) == 2


def test_a_folder_without_scenes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected the folder output_scene"):
        scene_folders(tmp_path)
