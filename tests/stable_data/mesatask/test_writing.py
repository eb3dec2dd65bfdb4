"""What is written reads back: made scenes, replies, task infos."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import SceneError
from stable_data.mesatask import (
    AssetAnnotation,
    MesaTaskDataset,
    read_layout,
    read_reply_layout,
    read_task_info,
    write_layout,
    write_reply_layout,
    write_scene,
    write_task_info,
)
from stable_data.rotations import normalise_quat
from stable_data.scene import UPRIGHT, QuatXyzw, Relation, RelationKind, Scene, SceneObject, Tabletop, TaskInfo
from tests.stable_data.mesatask.layouts import LAID_FLAT, UID, entry, layout, make_dataset

lengths = st.floats(0.001, 3.0)
places = st.tuples(st.floats(-1, 3), st.floats(-1, 3), st.floats(-0.5, 2))
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1).map(normalise_quat)
zones = st.tuples(*[st.floats(0.0, 0.5)] * 2, *[st.floats(0.6, 1.0)] * 2).map(lambda z: (z[0], z[2], z[1], z[3]))


@st.composite
def made_scenes(draw: st.DrawFn) -> Scene:
    objects = tuple(
        SceneObject(
            f"{k + 1}_cup_{k}",
            "cup",
            draw(places),
            draw(st.floats(-math.pi, math.pi, exclude_min=True)),
            draw(st.tuples(lengths, lengths, lengths)),
            asset_id=draw(st.sampled_from([UID, "gen_1a25ed82-e56a-d6d9-d521-6f6068215d4b"])),
            scale=draw(st.tuples(lengths, lengths, lengths)),
            tilt_quat_xyzw=draw(st.one_of(st.just(UPRIGHT), st.just(LAID_FLAT), quaternions)),
            description=draw(st.text("abc é☃", max_size=5).map(str.strip)),
        )
        for k in range(draw(st.integers(1, 4)))
    )
    table = Tabletop("kitchen_counter", draw(st.tuples(lengths, lengths)), draw(st.one_of(st.none(), zones)))
    return Scene("scene_0", table, objects)


def signless(quat_xyzw: QuatXyzw) -> tuple[float, ...]:
    """A rotation has two quaternions; this is the same for both."""
    return tuple(a * b for a in quat_xyzw for b in quat_xyzw)


@settings(deadline=None, max_examples=150)
@given(made_scenes())
def test_made_scenes_read_back(scene: Scene) -> None:
    written = write_layout(scene)
    again, notices = read_layout(json.dumps(written), "scene_0", "kitchen_counter")
    assert not notices
    assert again.table.size_xy == pytest.approx(scene.table.size_xy, rel=1e-15)
    for was, now in zip(scene.objects, again.objects, strict=True):
        assert (now.instance, now.category, now.asset_id, now.description) == (
            was.instance, was.category, was.asset_id, was.description,
        )  # fmt: skip
        numbers = ((o.position, (o.yaw,), o.size, o.scale or (), signless(o.tilt_quat_xyzw)) for o in (was, now))
        for a, b in zip(*numbers, strict=True):
            assert b == pytest.approx(a, abs=1e-12, rel=1e-14)
    assert write_layout(again) == written
    assert read_layout(write_layout(again), "scene_0", "kitchen_counter")[0] == again


@settings(deadline=None, max_examples=60)
@given(made_scenes())
def test_replies_read_back(scene: Scene) -> None:
    described = replace(scene, objects=tuple(replace(o, description="a cup") for o in scene.objects))
    reply = write_reply_layout(described)
    again = read_reply_layout("Thinking {x}\nTherefore, the scene layout is:\n**Final Answer**\n```json\n" + json.dumps(reply))
    for was, now in zip(described.objects, again.objects, strict=True):
        assert (now.instance, now.description, now.tilt_quat_xyzw) == (was.instance, "a cup", UPRIGHT)
        assert (now.yaw, *now.position, *now.size) == pytest.approx((was.yaw, *was.position, *was.size), abs=1e-12)
    assert read_layout(json.dumps(reply), "reply", "table")[0] == again
    as_dataset, notices = read_layout(write_layout(again), "reply", "table")
    assert {notice.code for notice in notices} == {"scale_factor_missing", "uid_missing"}
    assert [o.yaw for o in as_dataset.objects] == pytest.approx([o.yaw for o in again.objects], abs=1e-12)


def test_a_reply_is_in_degrees_and_may_repeat_itself() -> None:
    pen = {"instance": "pen_0", "description": "a pen", "z_rotation": 90, "size": [1, 14, 1], "position": [20, 10, 0.5]}
    reply = {"item_placement_zone": [0, 60, 0, 40], "sink_zone": [20, 45, 10, 30], "objects": [pen, pen]}
    scene = read_reply_layout(json.dumps(reply) + "<|im_end|>")
    assert [o.instance for o in scene.objects] == ["pen_0", "pen_1"]
    assert scene.objects[0].yaw == pytest.approx(math.pi / 2)
    assert (scene.objects[0].category, scene.objects[0].asset_id) == ("pen", None)
    assert scene.table.restricted_zone == (0.2, 0.45, 0.1, 0.3)
    chosen = read_reply_layout(
        {**reply, "objects": [{**pen, "selected_uid": UID}, {**pen, "instance": "a", "selected_uid": None}]}
    )
    assert [o.asset_id for o in chosen.objects] == [UID, None]
    with pytest.raises(SceneError, match="not valid JSON"):
        read_reply_layout("I cannot do that.")


def test_a_reply_need_not_repeat_the_table_and_may_be_of_no_object() -> None:
    table = Tabletop("bathroom_vanity", (1.2, 0.66), (0.2, 0.45, 0.1, 0.3))
    empty = Scene("reply", table, ())
    assert read_reply_layout(json.dumps(write_reply_layout(empty)), table=table) == empty
    assert read_reply_layout(write_reply_layout(empty)).table.size_xy == table.size_xy
    pen = {"instance": "pen_0", "description": "a pen", "z_rotation": 0, "size": [1, 14, 1], "position": [20, 10, 0.5]}
    assert read_reply_layout({"objects": [pen]}, table=table).table == table
    shifted = read_reply_layout({"item_placement_zone": [10, 70, 0, 40], "objects": [pen]}, table=table)
    assert shifted.table == table
    assert shifted.objects[0].position == pytest.approx((0.1, 0.1, 0.005))
    with pytest.raises(SceneError, match="item_placement_zone is missing"):
        read_reply_layout({"objects": [pen]})
    with pytest.raises(SceneError, match="empty list"):
        read_layout({"item_placement_zone": [0, 1, 0, 1], "objects": []}, "scene_0", "desk")


def read_object(document: dict[str, Any], annotations: dict[str, AssetAnnotation] | None = None) -> SceneObject:
    (found,) = read_layout(json.dumps(document), "scene_0", "office_table", annotations=annotations)[0].objects
    return found


@pytest.mark.parametrize(
    "changes",
    [
        {"scale": None},
        {"scale": None, "size": (0.2, 0.3, 0.4)},
        {"scale": (1.1, 1.0, 1.2)},
        {"scale": (1.0008, 1.001, 1.001)},  # too little for the product of original_size to look wrong
        {"size": (0.1801, 0.3203, 0.4403)},
        {"scale": (2.0, 2.0, 2.0), "size": (0.36, 0.64, 0.88)},
        {"tilt_quat_xyzw": LAID_FLAT, "scale": None},
    ],
)
def test_a_changed_scale_or_size_reads_back(changes: dict[str, Any]) -> None:
    document = layout()
    scene, _ = read_layout(document, "scene_0", "office_table")
    changed = replace(scene.objects[0], **changes)
    written = write_layout(replace(scene, objects=(changed,)))
    again, notices = read_layout(json.dumps(written), "scene_0", "office_table")
    assert again.objects[0].scale == changed.scale
    assert again.objects[0].size == pytest.approx(changed.size, abs=1e-9)
    assert "size_disagrees" not in [n.code for n in notices]
    is_product = changes.get("size") == (0.36, 0.64, 0.88) or changed.scale is None
    assert ("original_size" in written["objects"][0]) == is_product


def test_changed_words_are_written_and_annotated_ones_are_not() -> None:
    annotations = {UID: AssetAnnotation(UID, description="A lamp.")}
    for own, known in (("A red lamp.", None), ("A red lamp.", annotations), (None, annotations), (None, {})):
        document = layout(entry(description=own))
        scene, _ = read_layout(document, "scene_0", "office_table", annotations=known)
        assert write_layout(scene, annotations=known) == document
        changed = replace(scene, objects=(replace(scene.objects[0], description="A blue lamp."),))
        written = write_layout(changed, annotations=known)
        assert written["objects"][0]["description"] == "A blue lamp."
        assert read_object(written, known).description == "A blue lamp."
    described, _ = read_layout(layout(), "scene_0", "office_table", annotations=annotations)
    assert write_layout(described) == layout()  # whose words these are is not known


def test_numbers_that_json_does_not_have_are_written_as_null(tmp_path: Path) -> None:
    document = layout(entry(mass=math.nan, scale_factor=[math.inf, 1, 1], original_size=None), weight=-math.inf)
    scene, _ = read_layout(json.dumps(document), "office_table_0001", "office_table")
    text = (write_scene(tmp_path, scene) / "layout.json").read_text()
    written = json.loads(text, parse_constant=pytest.fail)
    assert (written["weight"], written["objects"][0]["mass"]) == (None, None)
    assert read_object(written) == scene.objects[0]


def test_new_objects_are_written_with_the_formats_names(tmp_path: Path) -> None:
    cup = SceneObject(
        "1_very_long_category_name_of_a_cup_0", "cup", (0.1, 0.2, 0.03), 0.5, (0.1, 0.1, 0.06), UID, (0.1, 0.1, 0.1)
    )
    scene = Scene("office_table_0001", Tabletop("office_table", (1.0, 0.6)), (cup,))
    folder = write_scene(tmp_path, scene, b"png", extents={UID: (1.0, 1.0, 0.6)}, decimals=1)
    assert folder == tmp_path / "Layout_info" / "office_table" / "office_table_0001"
    assert {path.name for path in folder.iterdir()} == {"layout.json", "front.png"}
    (made,) = json.loads((folder / "layout.json").read_bytes())["objects"]
    assert made["name"] == f"{cup.instance}_{UID}"[:63]
    assert made["retrieved_uid"] == made["selected_uid"] == UID
    assert made["original_size"] == [1.0, 1.0, 0.6]
    assert (made["size"], made["position"]) == ([10.0, 10.0, 6.0], [10.0, 20.0, 3.0])
    for scene_id in ("../evil", "a/b", ""):
        with pytest.raises(SceneError, match="cannot name a folder"):
            write_scene(tmp_path, replace(scene, scene_id=scene_id))


TASK = {
    "Environment": "A desk.",
    "item_placement_zone": [0, 120, 0, 66],
    "Task": "Put the cup on the tray.",
    "Goal": ["The cup is on the tray."],
    "Action Sequence": ["Pick(Cup)", "PlaceOn(Tray)"],
    "Objects cluster": ["Cup", "Tray"],
    "task_objects": ["1_cup_0"],
    "relations": [["1_cup_0", "left of", "2_tray_0"]],
    "hint": 5,
}


def test_task_infos_read_and_write_back() -> None:
    task = read_task_info(json.dumps(TASK), "scene_0")
    assert task.action_sequence == ("Pick(Cup)", "PlaceOn(Tray)")
    assert task.relations == (Relation("1_cup_0", RelationKind.LEFT_OF, "2_tray_0"),)
    table = Tabletop("bathroom_vanity", (1.2, 0.66), (0.2, 0.45, 0.1, 0.3))
    assert write_task_info(task, table) == TASK
    changed = replace(task, goal=("Done.",), origin="model")
    written = write_task_info(changed, table)
    assert written == TASK | {"Goal": ["Done."], "origin": "model"}
    assert read_task_info(json.dumps(written), "scene_0") == changed
    made = TaskInfo("A bath.", "Tidy up.", relations=task.relations, origin="template")
    document = write_task_info(made, table)
    assert document["sink_zone"] == pytest.approx([20, 45, 10, 30])
    assert document["Goal"] == []
    assert read_task_info(json.dumps(document), "scene_0") == made


@pytest.mark.parametrize(
    "changes",
    [
        {"Task": ""},
        {"Task": None},
        {"Task": "lamp, " * 2000 + "lamp off " * 2000},
        {"Goal": 5},
        {"Goal": [1]},
        {"Environment": []},
        {"relations": [[1, 2, 3]]},
        {"relations": ["ab"]},
    ],
)
def test_a_malformed_task_info_is_a_notice(changes: dict[str, Any], tmp_path: Path) -> None:
    folder = make_dataset(tmp_path)
    (folder / "task_info.json").write_text(json.dumps(TASK | changes))
    scene, notices = MesaTaskDataset(tmp_path).read("office_table_0001")
    assert scene.task is None
    assert [notice.code for notice in notices] == ["task_info_invalid"]
