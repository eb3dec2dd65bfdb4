"""Folders in the format: identities on real scenes, every way in which files are broken."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from stable_data.errors import ConfigError, SceneError
from stable_data.mesatask import (
    MesaTaskDataset,
    has_size,
    read_layout,
    to_box_centre,
    write_annotations,
    write_asset,
    write_layout,
    write_scene,
    write_task_info,
    yaw_frame_box,
)
from stable_data.scene import UPRIGHT, FloatArray, SceneObject
from tests.stable_data.mesatask.layouts import UID, entry, layout, make_dataset


@pytest.fixture(scope="module")
def real(shared_data: Path) -> MesaTaskDataset:
    return MesaTaskDataset(shared_data / "mesa_real")


@pytest.fixture(scope="module")
def meshes(real: MesaTaskDataset) -> Callable[[str], FloatArray]:
    """Vertices of an asset, z up, its box centred."""
    known: dict[str, FloatArray] = {}

    def vertices(asset_id: str) -> FloatArray:
        if asset_id not in known:
            points = np.asarray(trimesh.load_scene(real.asset_path(asset_id)).to_mesh().vertices, np.float64)
            points = points[:, [0, 2, 1]] * (1, -1, 1)
            known[asset_id] = points - (points.min(0) + points.max(0)) / 2
        return known[asset_id]

    return vertices


def test_real_scenes_read_without_a_notice_and_write_back_as_they_stood(real: MesaTaskDataset) -> None:
    assert len(real.scene_ids) == 120
    assert not real.notices
    num_tasks = 0
    for scene_id in real.scene_ids:
        scene, notices = real.read(scene_id)
        assert not notices
        written = write_layout(scene)
        assert written == json.loads(real.layout_path(scene_id).read_bytes())
        again, _ = read_layout(json.dumps(written), scene_id, scene.table.table_type, annotations=real.annotations)
        assert replace(again, task=scene.task) == scene
        if scene.task is not None:
            num_tasks += 1
            assert write_task_info(scene.task, scene.table) == scene.task.source
    assert num_tasks == 72


def test_a_real_dataset_copied_by_the_writers_reads_as_the_same(real: MesaTaskDataset, tmp_path: Path) -> None:
    write_annotations(tmp_path, real.annotations)
    ids = real.scene_ids[::10]
    for scene_id in ids:
        write_scene(tmp_path, real.read(scene_id)[0], front_png=b"png")
    used = sorted({o.asset_id for scene_id in ids for o in real.read(scene_id)[0].objects if o.asset_id})
    for asset_id in used:
        path = real.asset_path(asset_id)
        assert path is not None
        write_asset(tmp_path, asset_id, path.read_bytes())
    copy = MesaTaskDataset(tmp_path)
    assert copy.scene_ids == ids
    assert all(copy.read(scene_id) == real.read(scene_id) for scene_id in ids)
    assert json.loads((tmp_path / "Asset_annotation.json").read_bytes()) == json.loads(
        (real.root / "Asset_annotation.json").read_bytes()
    )


def test_moved_real_objects_read_back_where_they_were_put(real: MesaTaskDataset, rng: np.random.Generator) -> None:
    for scene_id in real.scene_ids[::6]:
        scene = real.read(scene_id)[0]
        moved = replace(scene, objects=tuple(_jittered(o, rng) if k % 2 else o for k, o in enumerate(scene.objects)))
        written = write_layout(moved)
        again, notices = read_layout(json.dumps(written), scene_id, scene.table.table_type, annotations=real.annotations)
        assert not notices
        for k, (was, now) in enumerate(zip(moved.objects, again.objects, strict=True)):
            assert now.position == pytest.approx(was.position, abs=1e-15)
            assert now.yaw == was.yaw
            assert now.tilt_quat_xyzw == pytest.approx(was.tilt_quat_xyzw, abs=1e-12)
            assert (now.size, now.scale, now.asset_id, now.instance) == (was.size, was.scale, was.asset_id, was.instance)
            assert k % 2 or was.source == written["objects"][k]
        assert (
            replace(read_layout(write_layout(again), scene_id, scene.table.table_type, annotations=real.annotations)[0])
            == again
        )


def _jittered(o: SceneObject, rng: np.random.Generator) -> SceneObject:
    x, y, z = (np.array(o.position) + rng.normal(0, 0.03, 3)).tolist()
    return o.moved((x, y, z), math.remainder(o.yaw + rng.normal(0, 1), 2 * math.pi))


def test_sizes_of_real_scenes_fit_their_meshes(real: MesaTaskDataset, meshes: Callable[[str], FloatArray]) -> None:
    objects = [o for scene_id in real.scene_ids for o in real.read(scene_id)[0].objects]
    assert len(objects) == 1462
    for o in objects:
        assert o.scale is not None
        low, high = yaw_frame_box(meshes(o.asset_id or ""), o.scale, o.tilt_quat_xyzw)
        assert np.abs(high - low - o.size).max() <= 1.5e-3
        assert has_size(high - low, o.size)


def test_real_scenes_place_box_centres(real: MesaTaskDataset, meshes: Callable[[str], FloatArray], shared_data: Path) -> None:
    truth = json.loads((shared_data / "mesa_real" / "truth.json").read_bytes())
    for scene_id in real.scene_ids:
        for o in real.read(scene_id)[0].objects:
            settled = truth[scene_id]["objects"][o.instance]
            x, y, z = (np.array(settled["mesh_box_center_cm"]) / 100).tolist()
            converted = to_box_centre(replace(o, position=(x, y, z)), meshes(o.asset_id or ""))
            assert converted.position == pytest.approx(np.array(settled["aabb_center_cm"]) / 100, abs=1e-4)


OTHER_CODE = {"objects_5000": "too_many_objects", "z_rotation_degrees": "z_rotation_disagrees"}


def test_broken_scenes_are_refused_or_kept_as_expected(shared_data: Path) -> None:
    dataset = MesaTaskDataset(shared_data / "mesa_broken")
    expected = json.loads((shared_data / "mesa_broken" / "expected.json").read_bytes())
    assert dataset.scene_ids == tuple(sorted(expected))
    for scene_id, case in expected.items():
        code = OTHER_CODE.get(case["code"], case["code"])
        if case["action"] == "reject":
            with pytest.raises(SceneError, match=f"^{scene_id}: ") as caught:
                dataset.read(scene_id)
            assert caught.value.code == code
            continue
        scene, notices = dataset.read(scene_id)
        of_the_mesh = code.startswith("glb_") and code != "glb_missing"  # the mesh loader's to notice
        assert [notice.code for notice in notices] == ([] if of_the_mesh or code == "control_ok" else [code])
        assert len(scene.objects) == len(json.loads(dataset.layout_path(scene_id).read_bytes())["objects"])


def test_broken_objects_fall_back_to_what_is_left(shared_data: Path) -> None:
    dataset = MesaTaskDataset(shared_data / "mesa_broken")
    objects = {code: dataset.read(scene_id)[0] for scene_id, code in _kept_cases(shared_data)}
    assert objects["scale_zero"]["4_tomato_0"].scale is None
    assert objects["scale_negative"]["4_tomato_0"].scale is None
    assert objects["scale_factor_missing"]["4_tomato_0"].size == pytest.approx(objects["scale_zero"]["4_tomato_0"].size)
    assert objects["rotation_wrong_length"]["4_tomato_0"].tilt_quat_xyzw == UPRIGHT
    assert objects["rotation_not_unit"]["4_tomato_0"].tilt_quat_xyzw == UPRIGHT
    assert objects["unknown_uid"]["4_tomato_0"].asset_id is None
    assert objects["z_rotation_degrees"]["4_tomato_0"].yaw == pytest.approx(1.0)
    assert objects["glb_missing"]["5_tomato_0"].asset_id == "e9017d3f52d3a02b1b91ad1f352b00e0"
    assert objects["duplicate_instance"]["4_tomato_0"].asset_id != objects["duplicate_instance"]["4_tomato_1"].asset_id


def _kept_cases(shared_data: Path) -> list[tuple[str, str]]:
    expected = json.loads((shared_data / "mesa_broken" / "expected.json").read_bytes())
    return [(scene_id, case["code"]) for scene_id, case in expected.items() if case["action"] != "reject"]


def test_folders_that_are_no_dataset_are_told_apart(tmp_path: Path) -> None:
    steps = {"root_missing": "", "not_a_dataset": "set", "dataset_empty": "set/Layout_info/office_table/empty"}
    for code, folder in steps.items():
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        with pytest.raises(ConfigError) as caught:
            MesaTaskDataset(tmp_path / "set")
        assert caught.value.code == code


def test_scenes_of_one_name_are_told_apart(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path)
    other = tmp_path / "Layout_info" / "x_table" / folder.name
    other.mkdir(parents=True)
    (other / "layout.json").write_bytes((folder / "layout.json").read_bytes())
    (other.parent / "no_layout").mkdir()
    dataset = MesaTaskDataset(tmp_path)
    assert dataset.scene_ids == ("office_table_0001", "x_table/office_table_0001")
    assert [(notice.item_id, notice.code) for notice in dataset.notices] == [("no_layout", "layout_missing")]
    scene = dataset.read("x_table/office_table_0001")[0]
    assert scene.table.table_type == "x_table"
    assert write_scene(tmp_path / "copy", scene).relative_to(tmp_path / "copy").parts == ("Layout_info", "x_table", folder.name)
    with pytest.raises(SceneError, match="no such scene"):
        dataset.read("../office_table_0001")


def test_layouts_alone_are_enough(tmp_path: Path) -> None:
    make_dataset(tmp_path)
    (tmp_path / "Asset_annotation.json").unlink()
    (tmp_path / "Assets_library" / f"{UID}.glb").unlink()
    dataset = MesaTaskDataset(tmp_path)
    assert {notice.code for notice in dataset.notices} == {"annotation_missing", "assets_missing"}
    assert [notice.code for notice in dataset.read("office_table_0001")[1]] == ["unknown_uid"]
    assert write_layout(dataset.read("office_table_0001")[0]) == layout()
    (tmp_path / "Asset_annotation.json").write_text("{")
    with pytest.raises(ConfigError, match="fetch"):
        MesaTaskDataset(tmp_path)


def test_a_turned_variant_that_another_file_stands_in_for_is_noticed(tmp_path: Path) -> None:
    variant = f"{UID}_x_90_y_0"
    make_dataset(tmp_path, entry(retrieved_uid=variant, selected_uid=variant))
    scene, (notice,) = MesaTaskDataset(tmp_path).read("office_table_0001")
    assert scene.objects[0].asset_id == variant
    assert notice.code == "asset_variant_served"
    assert f"{UID}.glb stands in" in notice.message
    write_asset(tmp_path, variant, b"glTF")
    assert MesaTaskDataset(tmp_path).read("office_table_0001")[1] == ()


def test_words_come_from_the_annotation(tmp_path: Path) -> None:
    make_dataset(tmp_path)
    (lamp,) = MesaTaskDataset(tmp_path).read("office_table_0001")[0].objects
    assert (lamp.category, lamp.description, lamp.asset_id) == ("desk_lamp", "A lamp.", UID)
