"""Rows of a run that no job has written: nulls, lists of other lengths, numbers that are none, versions that are no text."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stable_data.assets.run_assets import RunAssets
from stable_data.errors import ConfigError, MeshError, SceneError
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.metrics.card import MetricCard
from stable_data.scene import Scene, SceneObject, Tabletop, TaskInfo
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SceneArrays, scenes_from_table
from stable_data.storage.schema_checks import check_schema
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import card_row, scene_from_row, scene_row, task_row
from tests.bounds import limit, soon
from tests.scenes import box

OBJECT = SceneObject("0_mug_0", "mug", (0.2, 0.3, 0.05), 0.1, (0.1, 0.1, 0.1), "mug", (1.0, 1.0, 1.0))
SCENE = Scene(
    "scene",
    Tabletop("desk", (1.2, 0.6), (0.9, 1.1, 0.4, 0.5)),
    (OBJECT, replace(OBJECT, instance="1_mug_0")),
    TaskInfo("A desk.", "Take the mug."),
)
CARD = MetricCard(2, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, True)

HALF = '{"x":"\\ud800"}'
"""ASCII in the file; read, it is half of a surrogate pair, with which no file can be written."""


def good_row() -> Row:
    blank = dict.fromkeys(SCHEMAS["scenes"].names) | {"source": "test", "split": "train", "pairs": [], "verdicts": []}
    return blank | card_row(CARD) | scene_row(SCENE)


def changed(path: str, value: Any) -> Row:
    """The row with another value at a path such as ``objects.0.position``."""
    row = good_row()
    *above, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    owner: Any = row
    for part in above:
        owner = owner[part]
    owner[last] = value
    return row


HOSTILE: list[tuple[str, Any]] = [
    ("scene_id", None),
    ("table_type", None),
    ("table_size", None),
    ("table_size", [1.2]),
    ("table_size", [0.0, 0.6]),
    ("table_size", [float("nan"), 0.6]),
    ("restricted_zone", [0.9, 1.1, 0.4]),
    ("objects", None),
    ("objects.0.instance", None),
    ("objects.0.category", None),
    ("objects.0.description", None),
    ("objects.0.position", None),
    ("objects.0.position", [0.2, 0.3]),
    ("objects.0.position", [0.2, None, 0.05]),
    ("objects.0.position", [float("inf"), 0.3, 0.05]),
    ("objects.0.yaw", None),
    ("objects.0.yaw", float("nan")),
    ("objects.0.size", [0.1]),
    ("objects.0.scale", [1.0]),
    ("objects.0.tilt_quat_xyzw", None),
    ("objects.0.stage", "later"),
    ("objects.0.source_json", "nan"),
    ("objects.0.source_json", "[" * 100_000),
    ("source_json", "{"),
    ("source_json", "3"),
    ("objects.0.source_json", "[]"),
    ("source_json", HALF),
    ("objects.0.source_json", HALF),
    ("task", {**dict(task_row(SCENE.task) or {}), "source_json": HALF}),
    ("relations", None),
    ("relations", [{"subject": "a", "kind": "eats", "target": "b"}]),
    ("task.task", None),
    ("task.goal", None),
    ("task.conditions", [{"subject": "a", "kind": "eats", "target": "b", "distance": None, "is_negated": False}]),
    ("surface", {"support": "s", "surface": None, "origin": [0.0], "yaw": None, "asset_id": None, "clearance": None}),
]


@pytest.mark.parametrize(("path", "value"), HOSTILE)
def test_a_scene_of_a_hostile_row_is_an_error_of_this_scene(path: str, value: Any) -> None:
    with pytest.raises(SceneError, match="the row of its scene cannot be used") as caught:
        scene_from_row(changed(path, value))
    assert caught.value.code == "row_invalid"
    assert len(str(caught.value)) < 500


def test_a_scene_of_very_many_objects_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """They may all have one name, or share a text: a file of some kilobytes has a million of them."""
    row = good_row()
    with soon(5.0), pytest.raises(SceneError, match="1,000,000 objects, expected at most 10,000"):
        scene_from_row(row | {"objects": row["objects"][:1] * 1_000_000})
    many = row["objects"][0] | {"source_json": json.dumps({"x": [[]] * 250_000})}
    with soon(5.0), pytest.raises(SceneError, match="source_json of 100,000,700 characters, expected at most"):
        scene_from_row(row | {"objects": [many] * 100})
    limit(monkeypatch, "table", max_objects=100_000)
    with soon(10.0), pytest.raises(SceneError, match=r"instances \['0_mug_0'\] are not unique"):
        scene_from_row(row | {"objects": row["objects"][:1] * 100_000})


def test_a_row_that_a_job_wrote_is_read() -> None:
    assert scene_from_row(good_row()) == SCENE


def test_an_instruction_is_as_long_as_it_was_allowed_to_be_when_it_was_stored() -> None:
    text = "x" * 100_000
    task = scene_from_row(changed("task.task", text)).task
    assert task is not None
    assert task.task == text


_IN_ARRAYS = (
    "scene_id",
    "table_size",
    "objects",
    "objects.0.instance",
    "objects.0.position",
    "objects.0.yaw",
    "objects.0.size",
)


@pytest.mark.parametrize(
    ("path", "value"), [one for one in HOSTILE if "source_json" not in str(one) and one != ("relations", None)]
)
def test_rows_that_are_read_together_are_checked_too(path: str, value: Any) -> None:
    """A null in the middle would give the numbers of one scene to the next."""
    table = pa.Table.from_pylist([good_row(), changed(path, value), good_row()], schema=SCHEMAS["scenes"])
    for read in (scenes_from_table, SceneArrays.from_table):
        if read is not scenes_from_table and path not in _IN_ARRAYS:
            continue
        with pytest.raises(ConfigError, match="table scenes: rows cannot be used") as caught:
            read(table)
        assert caught.value.code == "rows_invalid"


def test_of_good_rows_arrays_and_scenes_agree() -> None:
    table = pa.Table.from_pylist([good_row()] * 2, schema=SCHEMAS["scenes"])
    assert scenes_from_table(table) == [SCENE] * 2
    assert len(SceneArrays.from_table(table).table_size) == 2


def test_whatever_a_row_causes_is_said_of_the_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    table = pa.Table.from_pylist([good_row()], schema=SCHEMAS["scenes"])
    for error in (RecursionError, AttributeError, ZeroDivisionError):
        monkeypatch.setattr("stable_data.storage.scene_arrays.task_from_row", Mock(side_effect=error))
        with pytest.raises(ConfigError, match="table scenes: rows cannot be used"):
            scenes_from_table(table)


def test_lists_whose_lengths_make_up_for_each_other_are_no_poses() -> None:
    """The numbers of one object would be those of the next."""
    row = changed("objects.0.position", [0.2, 0.3])
    row["objects"][1]["position"] = [0.1, 0.2, 0.3, 0.4]
    table = pa.Table.from_pylist([row], schema=SCHEMAS["scenes"])
    for read in (scenes_from_table, SceneArrays.from_table):
        with pytest.raises(ConfigError, match="another length"):
            read(table)


@pytest.mark.parametrize("version", [b"\xff", b"9" * 5000, "²".encode(), "١".encode(), b"3\x1b[31m", b""])
def test_a_version_may_be_any_bytes(version: bytes) -> None:
    schema = SCHEMAS["scenes"].with_metadata({b"stable_data.version": version})
    with pytest.raises(ConfigError, match="written as table version") as caught:
        check_schema(schema, "scenes", "here")
    assert caught.value.code == "table_version"
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


def mesh_row(**columns: Any) -> Row:
    shape = box(0.1, 0.1, 0.1)
    part = {"vertices": shape.vertices.ravel().tolist(), "faces": shape.faces.ravel().tolist()}
    glb = write_glb(Mesh(shape.vertices, shape.faces))
    return (
        dict.fromkeys(SCHEMAS["meshes"].names) | {"asset_id": "mug", "glb": glb, "sha256": "0" * 64, "parts": [part]} | columns
    )


def write_meshes(root: Path, row: Row) -> RunFolder:
    (root / "meshes").mkdir(parents=True)
    table = pa.Table.from_pylist([row], schema=SCHEMAS["meshes"])
    pq.write_table(table, root / "meshes" / f"part-{'0' * 16}.parquet")
    return RunFolder(str(root))


@pytest.mark.parametrize("columns", [{"sha256": None}, {"sha256": "f" * 63}, {"sha256": "٣" * 64}, {"asset_id": None}])
def test_a_mesh_without_a_name_or_a_hash_is_refused(columns: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected a name and 64 hex digits") as caught:
        RunAssets(write_meshes(tmp_path / "run", mesh_row(**columns)), tmp_path / "files")
    assert caught.value.code == "table_invalid"


@pytest.mark.parametrize(
    "part",
    [
        None,
        {"vertices": None, "faces": [0, 1, 2]},
        {"vertices": [0.0] * 9, "faces": None},
        {"vertices": [0.0] * 9, "faces": []},
        {"vertices": [0.0] * 9, "faces": [0, 1]},
        {"vertices": [0.0] * 8, "faces": [0, 1, 2]},
        {"vertices": [0.0] * 9, "faces": [0, 1, 3]},
        {"vertices": [0.0] * 9, "faces": [0, 1, 2**31 - 1]},
        {"vertices": [0.0] * 9, "faces": [0, 1, -1]},
        {"vertices": [*[0.0] * 8, float("nan")], "faces": [0, 1, 2]},
        {"vertices": [*[0.0] * 8, None], "faces": [0, 1, 2]},
    ],
)
def test_a_convex_part_whose_indices_leave_its_vertices_is_refused(part: Row | None, tmp_path: Path) -> None:
    """The programs that use it read memory of others."""
    assets = RunAssets(write_meshes(tmp_path / "run", mesh_row(parts=[part])), tmp_path / "files")
    with pytest.raises(MeshError, match="a convex part in table meshes cannot be used") as caught:
        assets.parts("mug")
    assert caught.value.code == "parts_invalid"


def test_a_sound_part_is_read(tmp_path: Path) -> None:
    (part,) = RunAssets(write_meshes(tmp_path / "run", mesh_row()), tmp_path / "files").parts("mug")
    assert np.array_equal(part.faces, box(0.1, 0.1, 0.1).faces)
