"""Folders in the format: identities on real scenes, every way in which files are broken."""

import json
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from tests.broken_inputs import BROKEN_INPUTS, TOMATO, BrokenInput
from tests.stable_data.mesatask.layouts import UID, entry, layout, make_dataset


@pytest.fixture(scope="module")
def real(real_data: Path) -> MesaTaskDataset:
    return MesaTaskDataset(real_data)


@pytest.fixture(scope="module")
def truth(real: MesaTaskDataset) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((real.root / "truth.json").read_bytes())
    return found


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


def test_a_layout_outside_of_the_folder_is_not_read(tmp_path: Path) -> None:
    """A link to the whole folder, or to its layouts, is what the user made."""
    root, layout_file = tmp_path / "data", make_dataset(tmp_path / "data") / "layout.json"
    content = layout_file.read_bytes()
    (tmp_path / "link").symlink_to(root)
    assert len(MesaTaskDataset(tmp_path / "link").read(layout_file.parent.name)[0].objects) == 1
    (tmp_path / "secret.json").write_bytes(content)
    layout_file.unlink()
    layout_file.symlink_to(tmp_path / "secret.json")
    with pytest.raises(SceneError, match="leads out of Layout_info") as caught:
        MesaTaskDataset(root).read(layout_file.parent.name)
    assert caught.value.code == "path_outside"
    layout_file.unlink()
    layout_file.write_bytes(content)
    layout_file.with_name("task_info.json").symlink_to(tmp_path / "secret.json")
    scene, notices = MesaTaskDataset(root).read(layout_file.parent.name)
    assert scene.task is None
    assert "leads out of Layout_info" in notices[-1].message


def test_real_scenes_read_without_a_notice_and_write_back_as_they_stood(real: MesaTaskDataset, truth: dict[str, Any]) -> None:
    assert real.scene_ids == tuple(sorted(truth))
    assert not real.notices
    for scene_id in real.scene_ids:
        scene, notices = real.read(scene_id)
        assert not notices
        written = write_layout(scene)
        assert written == json.loads(real.layout_path(scene_id).read_bytes())
        again, _ = read_layout(json.dumps(written), scene_id, scene.table.table_type, annotations=real.annotations)
        assert replace(again, task=scene.task) == scene
        assert (scene.task is None) == (truth[scene_id]["task"] is None)
        if scene.task is not None:
            assert write_task_info(scene.task, scene.table) == scene.task.source


def test_a_real_dataset_copied_by_the_writers_reads_as_the_same(real: MesaTaskDataset, tmp_path: Path) -> None:
    write_annotations(tmp_path, real.annotations)
    ids = real.scene_ids
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
    for scene_id in real.scene_ids:
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


def test_sizes_of_real_scenes_fit_their_meshes(
    real: MesaTaskDataset, meshes: Callable[[str], FloatArray], truth: dict[str, Any]
) -> None:
    objects = [o for scene_id in real.scene_ids for o in real.read(scene_id)[0].objects]
    assert len(objects) == sum(len(scene["objects"]) for scene in truth.values())
    for o in objects:
        assert o.scale is not None
        low, high = yaw_frame_box(meshes(o.asset_id or ""), o.scale, o.tilt_quat_xyzw)
        assert np.abs(high - low - o.size).max() <= 1.5e-3
        assert has_size(high - low, o.size)


def test_real_scenes_place_box_centres(
    real: MesaTaskDataset, meshes: Callable[[str], FloatArray], truth: dict[str, Any]
) -> None:
    for scene_id in real.scene_ids:
        for o in real.read(scene_id)[0].objects:
            settled = truth[scene_id]["objects"][o.instance]
            x, y, z = (np.array(settled["mesh_box_center_cm"]) / 100).tolist()
            converted = to_box_centre(replace(o, position=(x, y, z)), meshes(o.asset_id or ""))
            assert converted.position == pytest.approx(np.array(settled["aabb_center_cm"]) / 100, abs=1e-4)


@pytest.fixture(scope="module")
def broken(broken_data: Path) -> MesaTaskDataset:
    dataset = MesaTaskDataset(broken_data)
    assert dataset.scene_ids == tuple(sorted(case.name for case in BROKEN_INPUTS))
    return dataset


@pytest.mark.parametrize("case", BROKEN_INPUTS, ids=lambda case: case.name)
def test_broken_scenes_are_refused_or_kept_as_expected(broken: MesaTaskDataset, case: BrokenInput) -> None:
    if case.action == "reject":
        with pytest.raises(SceneError, match=f"^{case.name}: ") as caught:
            broken.read(case.name)
        assert caught.value.code == case.layout_code
        return
    scene, notices = broken.read(case.name)
    assert [notice.code for notice in notices] == ([] if case.layout_code is None else [case.layout_code])
    assert len(scene.objects) == len(json.loads(broken.layout_path(case.name).read_bytes())["objects"])


def test_broken_objects_fall_back_to_what_is_left(broken: MesaTaskDataset) -> None:
    scenes = {case.name: broken.read(case.name)[0] for case in BROKEN_INPUTS if case.action != "reject"}
    tomatoes = {name: scene[TOMATO] for name, scene in scenes.items()}
    whole = tomatoes["nothing_broken"]
    for name in ("scale_zero", "scale_negative", "scale_factor_missing"):
        assert tomatoes[name].scale is None
        assert tomatoes[name].size == pytest.approx(whole.size)
    for name in ("rotation_wrong_length", "rotation_not_unit"):
        assert tomatoes[name].tilt_quat_xyzw == UPRIGHT
        assert tomatoes[name].yaw == pytest.approx(whole.yaw)
    assert tomatoes["unknown_uid"].asset_id is None
    assert tomatoes["z_rotation_degrees"].yaw == pytest.approx(whole.yaw)
    assert scenes["glb_missing"].objects[-1].asset_id is not None
    first, *_, last = scenes["duplicate_instance"].objects
    assert first.instance != last.instance
    assert first.asset_id != last.asset_id


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


def test_a_scene_whose_folder_has_a_name_that_is_not_utf8_is_one_like_others(tmp_path: Path) -> None:
    folder = make_dataset(tmp_path)
    layout = (folder / "layout.json").read_bytes()
    for name in (b"s\xff", b"s%FF", b"office_table", b"\xff"):
        other = Path(os.fsdecode(os.fsencode(folder.parent) + b"/" + name))
        other.mkdir()
        if name != b"\xff":
            (other / "layout.json").write_bytes(layout)
    dataset = MesaTaskDataset(tmp_path)
    ids = ("office_table", "office_table_0001", "s%FF", "s%FF_")
    assert dataset.scene_ids == ids
    assert {dataset.layout_path(name).parent.name for name in ids} == {
        "office_table",
        "s%FF",
        "office_table_0001",
        "s\udcff",
    }
    assert [dataset.read(name)[0].scene_id for name in ids] == [*ids]
    (lost,) = dataset.notices
    assert (lost.item_id, lost.code) == ("%FF", "layout_missing")
    assert lost.message.encode()


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
    assert f"{UID}.glb is used instead" in notice.message
    write_asset(tmp_path, variant, b"glTF")
    assert MesaTaskDataset(tmp_path).read("office_table_0001")[1] == ()


def test_words_come_from_the_annotation(tmp_path: Path) -> None:
    make_dataset(tmp_path)
    (lamp,) = MesaTaskDataset(tmp_path).read("office_table_0001")[0].objects
    assert (lamp.category, lamp.description, lamp.asset_id) == ("desk_lamp", "A lamp.", UID)
