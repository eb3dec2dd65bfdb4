"""One layout: what is refused, what is kept and noted, which frame its poses mean."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stable_data.errors import SceneError
from stable_data.limits import LayoutLimits
from stable_data.mesatask import (
    read_layout,
    to_box_centre,
    write_layout,
    yaw_frame_box,
)
from stable_data.rotations import normalise_quat, quat_product, rotation_matrix, yaw_quat
from stable_data.scene import UPRIGHT, SceneObject, Tabletop
from tests.stable_data.mesatask.layouts import LAID_FLAT, UID, entry, layout, read


@pytest.mark.parametrize(
    ("document", "code"),
    [
        ([], "json_not_object"),
        (layout(item_placement_zone=None), "zone_missing"),
        (layout(item_placement_zone=[0, 1, 2]), "zone_invalid"),
        (layout(item_placement_zone=[0, "120", 0, 66]), "zone_invalid"),
        (layout(item_placement_zone=[0, 1e300, 0, 66]), "zone_invalid"),
        (layout(item_placement_zone=[0, 0, 0, 66]), "zone_max_below_min"),
        (layout(restricted_zone=[50, 40, 0, 10]), "restricted_zone_inverted"),
        (layout(sink_zone=[True, 40, 0, 10]), "zone_invalid"),
        (layout(scene_settings={"units": "meters", "up_axis": "Z"}), "units_unknown"),
        (layout(scene_settings={"units": "centimeters", "up_axis": "Y"}), "up_axis_unknown"),
        (layout(scene_settings={"rotation_convention": "wxyz"}), "rotation_convention_unknown"),
        (layout(scene_settings=[]), "scene_settings_invalid"),
        (layout(objects={"a": 1}), "objects_invalid"),
        (layout(objects=None), "objects_invalid"),
        (layout(objects=[entry(), 3]), "object_invalid"),
        (layout(entry(position=None)), "position_missing"),
        (layout(entry(position=[1, 2])), "position_invalid"),
        (layout(entry(position=["1", "2", "3"])), "position_invalid"),
        (layout(entry(position=[True, 2, 3])), "position_invalid"),
        (layout(entry(position=[10**400, 2, 3])), "position_inf"),
        (layout(entry(position=[60, 41, -2000])), "coordinates_huge"),
        (layout(entry(size=None, scale_factor=None)), "size_missing"),
        (layout(entry(size=[1, 2], original_size=None)), "size_invalid"),
        (layout(entry(size=[1, 2, 1e9])), "size_huge"),
        (layout(entry(selected_uid="/etc/passwd")), "uid_path_traversal"),
        (layout(entry(selected_uid=None, retrieved_uid="..")), "uid_path_traversal"),
        (layout(entry(instance="caf\ud800_0")), "json_not_utf8"),
    ],
)
def test_unusable_layouts_say_why(document: object, code: str) -> None:
    with pytest.raises(SceneError, match=r"^scene_0: ") as caught:
        read(document)
    assert caught.value.code == code
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (b"", "json_truncated"),
        (b'{"objects": [', "json_truncated"),
        (b'{"objects": [{"instance": "1_cu', "json_truncated"),
        (b'{"objects": oops}', "json_invalid"),
        (b'{"a": ' + b"1" * 5000 + b"}", "json_invalid"),
        (b'{"objects": [], "objects": []}', "json_duplicate_key"),
        (b"[" * 100_000 + b"]" * 100_000, "json_too_deep"),
        (b'{"a": ' + b"[" * 100 + b"]" * 100 + b"}", "json_too_deep"),
        (b"\xff\xfe{}", "json_not_utf8"),
        (b" " * 2000, "file_too_big"),
    ],
)
def test_unsound_json_says_why(text: bytes, code: str) -> None:
    limits = LayoutLimits(max_bytes=1000) if code == "file_too_big" else None
    with pytest.raises(SceneError, match=r"scene_0: layout\.json ") as caught:
        read_layout(text, "scene_0", "office_table", limits=limits)
    assert caught.value.code == code


@pytest.mark.parametrize(
    ("changes", "codes"),
    [
        ({}, []),
        ({"z_rotation": None}, []),
        ({"z_rotation": -0.8 + 2 * math.pi}, []),
        ({"z_rotation": -0.8 + math.pi}, ["z_rotation_disagrees"]),
        ({"z_rotation": "nan"}, ["z_rotation_disagrees"]),
        ({"rotation": None}, ["rotation_missing"]),
        ({"rotation": [0, 0, 0, 0]}, ["rotation_invalid"]),
        ({"rotation": [0, 0, "0", 1]}, ["rotation_invalid"]),
        ({"rotation": 5}, ["rotation_invalid"]),
        ({"scale_factor": [1, 2]}, ["scale_invalid"]),
        ({"scale_factor": [1, 2, math.inf]}, ["scale_invalid"]),
        ({"size": [1, 2]}, ["size_invalid"]),
        ({"size": [0, 0, 0]}, ["size_invalid"]),
        ({"size": None}, ["size_missing"]),
        ({"size": [18.0, 32.0, 40.0]}, ["size_disagrees"]),
        ({"instance": ""}, ["instance_missing"]),
        ({"instance": 7}, ["instance_missing"]),
        ({"instance": "table"}, ["duplicate_instance"]),
        ({"instance": "x" * 5000}, ["instance_missing"]),
        ({"selected_uid": None, "retrieved_uid": None}, ["uid_missing"]),
        ({"selected_uid": 5}, ["uid_invalid"]),
        ({"selected_uid": None}, []),
        ({"retrieved_uid": None}, []),
    ],
)
def test_odd_objects_are_kept_and_noted(changes: dict[str, Any], codes: list[str]) -> None:
    document = layout(entry(**changes))
    scene, found = read(document)
    assert found == codes
    (lamp,) = scene.objects
    assert lamp.tilt_quat_xyzw == UPRIGHT
    assert math.remainder(lamp.yaw + 0.8, 2 * math.pi) == pytest.approx(0, abs=1e-9) or "rotation" not in document["objects"][0]
    again, _ = read(write_layout(scene))
    assert again == scene


def test_the_product_is_taken_where_size_was_rounded_from_it() -> None:
    (lamp,) = read(layout())[0].objects
    assert lamp.size == pytest.approx((0.18018, 0.32032, 0.44044), abs=1e-12)
    (flat,) = read(layout(entry(rotation=list(LAID_FLAT), z_rotation=0.0, size=[18.0, 44.1, 32.1])))[0].objects
    assert flat.size == pytest.approx((0.18, 0.441, 0.321), abs=1e-15)
    (turned,) = read(layout(entry(rotation=list(LAID_FLAT), z_rotation=0.0, size=None)))[0].objects
    assert turned.size == pytest.approx((0.18018, 0.44044, 0.32032), abs=1e-12)


@pytest.mark.parametrize("offset", [0.0, math.pi, -math.pi, 2 * math.pi])
def test_a_tilted_object_may_use_either_euler_branch(offset: float) -> None:
    rotation = normalise_quat(quat_product(yaw_quat(0.7), normalise_quat((0.3, 0.0, 0.0, 1.0))))
    scene, codes = read(layout(entry(rotation=list(rotation), z_rotation=0.7 + offset, size=[18, 40, 50])))
    assert codes == []
    whole = rotation_matrix(quat_product(yaw_quat(scene.objects[0].yaw), scene.objects[0].tilt_quat_xyzw))
    assert scene.objects[0].yaw == 0.7 + offset
    np.testing.assert_allclose(whole, rotation_matrix(rotation), atol=1e-12)


def test_any_yaw_is_right_where_the_x_axis_points_up() -> None:
    standing = (0.0, -math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4))
    scene, codes = read(layout(entry(rotation=list(standing), z_rotation=1.234, size=[44, 32, 18])))
    assert codes == []
    assert scene.objects[0].yaw == 1.234


def test_a_zone_off_the_origin_is_moved_there_and_back() -> None:
    document = layout(item_placement_zone=[-60.0, 60.0, 10.0, 76.0], restricted_zone=[-20.0, 20.0, 30.0, 50.0])
    scene, _ = read(document)
    assert scene.table == Tabletop("office_table", (1.2, 0.66), (0.4, 0.8, 0.2, 0.4))
    assert scene.objects[0].position == pytest.approx((1.2, 0.312, 0.22))
    assert write_layout(scene) == document
    moved = replace(scene, objects=(scene.objects[0].moved((0.0, 0.0, 0.22), 0.0),))
    assert write_layout(moved)["objects"][0]["position"] == [-60.0, 10.0, 22.0]


def test_either_name_of_the_sink_is_read() -> None:
    for key in ("restricted_zone", "sink_zone"):
        document = layout(**{key: [10.0, 20.0, 10.0, 20.0]})
        scene, _ = read(document)
        assert scene.table.restricted_zone == (0.1, 0.2, 0.1, 0.2)
        assert write_layout(scene) == document
    assert read(layout(sink_zone=[0, 0, 0, 0]))[1] == ["restricted_zone_empty"]


def test_unknown_keys_survive_a_change() -> None:
    document = layout(entry(mass=0.3, tags=["a", {"b": 1}]), author="x")
    scene, _ = read(document)
    moved = replace(scene, objects=(scene.objects[0].moved((0.5, 0.4, 0.22), 1.0),))
    written = write_layout(moved, decimals=1)
    assert written["author"] == "x"
    (changed,) = written["objects"]
    assert {key: changed[key] for key in ("mass", "tags", "size", "scale_factor", "original_size", "name")} == {
        key: document["objects"][0][key] for key in ("mass", "tags", "size", "scale_factor", "original_size", "name")
    }
    assert (changed["position"], changed["z_rotation"]) == ([50.0, 40.0, 22.0], 1.0)
    assert scene.objects[0].source == document["objects"][0]


def test_the_box_of_a_laid_wedge_is_off_its_meshs_centre() -> None:
    wedge = np.array([[-1, -1, -1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float64)
    low, high = yaw_frame_box(wedge, (0.1, 0.1, 0.1), normalise_quat((0.0, -1.0, 0.0, 1 + math.sqrt(2))))  # 45 degrees about y
    assert low[2] == pytest.approx(-0.1 * math.sqrt(2))
    assert high[2] == pytest.approx(0.0, abs=1e-15)
    leaning = SceneObject("a", "a", (0.5, 0.5, 0.1 * math.sqrt(2)), math.pi / 2, (0.3, 0.2, 0.15), UID, (0.1, 0.1, 0.1))
    leaning = replace(leaning, tilt_quat_xyzw=normalise_quat((0.0, -1.0, 0.0, 1 + math.sqrt(2))))
    assert to_box_centre(leaning, wedge).position[2] == pytest.approx(0.05 * math.sqrt(2))
    assert to_box_centre(replace(leaning, scale=None), wedge).position == leaning.position
