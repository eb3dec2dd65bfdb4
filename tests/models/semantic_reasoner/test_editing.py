"""Replies to edits: what they do not name stays to the last bit, what rests on a thing goes along, nonsense is refused."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.semantic_reasoner.editing import EditPrompt, EditResult, apply_edit, edit_prompt_of
from models.semantic_reasoner.text.prompt import messages
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply, parse_reply
from models.semantic_reasoner.training.examples import edit_example_of
from stable_data.embedded_world.edit_table import edit_rows
from stable_data.errors import SceneError
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Tabletop, Vec3
from stable_data.scene_graph.relations import supports
from stable_data.storage.table_rows import object_from_row, scene_from_row
from tests.stable_data.embedded_world.edit_scenes import made_scenes, row_of


def thing(name: str, category: str, x: float, y: float, low: float, size: Vec3, support: str | None = TABLE) -> SceneObject:
    placed = SceneObject(name, category, (x, y, low + size[2] / 2), 0.3, size, f"mesh_of_{name}", (0.01,) * 3)
    return replace(placed, description=f"a {category}", support=support)


SCENE = Scene(
    "office_table_0001",
    Tabletop("office_table", (1.2, 0.7)),
    (
        thing("1_mug_0", "mug", 0.31234, 0.3, 0.0201, (0.08, 0.08, 0.09), "2_tray_0"),
        thing("2_tray_0", "tray", 0.3, 0.31, 0.0, (0.3, 0.2, 0.02)),
        thing("3_spoon_0", "spoon", 0.31234, 0.3, 0.03, (0.02, 0.02, 0.15), "1_mug_0"),
        thing("4_mug_1", "mug", 0.9, 0.5, 0.0, (0.07, 0.07, 0.1)),
    ),
    relations=(Relation("1_mug_0", RelationKind.ON, "2_tray_0"), Relation("4_mug_1", RelationKind.RIGHT_OF, "2_tray_0")),
)


def shown(name: str) -> LayoutObject:
    return next(o for o in edit_prompt_of(SCENE).layout if o.instance == name)


def edit(*objects: LayoutObject, remove: tuple[str, ...] = ()) -> EditResult:
    return apply_edit(SCENE, LayoutReply(objects, remove))


def test_the_layout_is_in_the_order_of_generation() -> None:
    assert [o.instance for o in edit_prompt_of(SCENE).layout] == ["tray_0", "mug_0", "spoon_0", "mug_1"]


def test_an_empty_edit_changes_nothing() -> None:
    assert edit().scene is SCENE
    assert edit().kind == "none"
    assert edit(*edit_prompt_of(SCENE).layout).scene is SCENE  # a model that repeats the whole layout changes nothing either


@given(st.sets(st.sampled_from([o.instance for o in edit_prompt_of(SCENE).layout])), st.floats(-0.1, 0.1))
def test_what_a_reply_repeats_stays_to_the_last_bit(names: set[str], shift: float) -> None:
    repeated = tuple(o for o in edit_prompt_of(SCENE).layout if o.instance in names)
    x, y, z = shown("mug_1").position_cm
    moved = replace(shown("mug_1"), position_cm=(round(x + 100 * shift, 1), y, z))
    done = edit(*(o for o in repeated if o.instance != "mug_1"), moved)
    assert [o for o in done.scene.objects if o.instance != "4_mug_1"] == [o for o in SCENE.objects if o.instance != "4_mug_1"]
    assert done.scene["4_mug_1"].position[1:] == SCENE["4_mug_1"].position[1:]
    assert done.scene["4_mug_1"].yaw == SCENE["4_mug_1"].yaw
    assert abs(done.scene["4_mug_1"].position[0] - (0.9 + shift)) <= 5.1e-4
    assert done.untouched >= {"1_mug_0", "2_tray_0", "3_spoon_0"}


def test_what_rests_on_a_thing_goes_along_as_one_body() -> None:
    tray = shown("tray_0")
    done = edit(replace(tray, position_cm=(60.0, 35.0, tray.position_cm[2]), z_rotation_deg=tray.z_rotation_deg + 90))
    assert (done.changed, done.carried, done.kind) == (("2_tray_0",), ("1_mug_0", "3_spoon_0"), "move")
    turn = done.scene["2_tray_0"].yaw - SCENE["2_tray_0"].yaw
    c, s = math.cos(turn), math.sin(turn)
    for name in done.carried:
        was = np.subtract(SCENE[name].position, SCENE["2_tray_0"].position)
        now = np.subtract(done.scene[name].position, done.scene["2_tray_0"].position)
        np.testing.assert_allclose(now, [c * was[0] - s * was[1], s * was[0] + c * was[1], was[2]], atol=1e-12)
        assert math.remainder(done.scene[name].yaw - SCENE[name].yaw - turn, 2 * math.pi) == pytest.approx(0, abs=1e-12)
        assert done.scene[name].support == SCENE[name].support


def test_what_the_reply_places_itself_does_not_go_along() -> None:
    done = edit(replace(shown("tray_0"), position_cm=(60.0, 35.0, 1.0)), shown("mug_0"))
    assert done.scene["1_mug_0"].position == SCENE["1_mug_0"].position
    assert done.scene["3_spoon_0"] == SCENE["3_spoon_0"]


def test_what_rested_on_a_thing_that_goes_comes_down() -> None:
    done = edit(remove=("tray_0",))
    assert (done.removed, done.carried, done.kind) == (("2_tray_0",), ("1_mug_0", "3_spoon_0"), "remove")
    mug, spoon = done.scene["1_mug_0"], done.scene["3_spoon_0"]
    assert mug.position[2] - mug.size[2] / 2 == pytest.approx(0, abs=1e-12)
    assert mug.position[:2] == SCENE["1_mug_0"].position[:2]
    assert spoon.position[2] == pytest.approx(SCENE["3_spoon_0"].position[2] - 0.0201, abs=1e-12)
    assert (mug.support, spoon.support) == (TABLE, "1_mug_0")
    assert done.scene["4_mug_1"] == SCENE["4_mug_1"]


def test_what_is_asked_of_things_that_change_is_asked_no_more() -> None:
    done = edit(replace(shown("mug_0"), position_cm=(60.0, 35.0, 4.5)))
    assert done.scene.relations == (SCENE.relations[1],)
    assert done.scene["1_mug_0"].support == TABLE


def test_other_words_want_another_asset_and_other_articles_do_not() -> None:
    done = edit(replace(shown("mug_1"), description="The mug"), replace(shown("mug_0"), description="a blue mug"))
    assert done.need_asset == ("1_mug_0",)
    assert (done.scene["1_mug_0"].asset_id, done.scene["1_mug_0"].scale, done.kind) == (None, None, "restyle")
    assert done.scene["1_mug_0"].position == SCENE["1_mug_0"].position
    assert done.scene["4_mug_1"] == SCENE["4_mug_1"]


def test_another_size_keeps_the_asset() -> None:
    done = edit(replace(shown("tray_0"), size_cm=(30.0, 20.0, 4.0), position_cm=(30.0, 31.0, 2.0)))
    tray = done.scene["2_tray_0"]
    assert (tray.asset_id, tray.scale, tray.size, done.need_asset) == ("mesh_of_2_tray_0", None, (0.3, 0.2, 0.04), ())
    mug = done.scene["1_mug_0"]  # stood 0.1 mm above the top, and still does
    assert mug.position[2] - mug.size[2] / 2 == pytest.approx(0.0401, abs=1e-12)


def test_what_is_higher_stands_where_it_stood() -> None:
    done = edit(replace(shown("mug_1"), size_cm=(7.0, 7.0, 15.0)))
    assert done.scene["4_mug_1"].position == pytest.approx((0.9, 0.5, 0.075))


def test_new_things_get_names_of_their_own_and_what_carries_them() -> None:
    new = LayoutObject("mug_7", "a red mug", (8.0, 8.0, 9.0), (50.0, 10.0, 4.5), 90)
    on_top = LayoutObject("coin_0", "a coin", (2.0, 2.0, 0.2), (25.0, 35.0, 2.1), 0)
    done = edit(new, on_top)
    assert (done.added, done.need_asset, done.kind) == (("5_mug_2", "6_coin_0"),) * 2 + ("add",)
    assert (done.scene["5_mug_2"].support, done.scene["6_coin_0"].support) == (TABLE, "2_tray_0")
    assert done.scene.objects[: len(SCENE.objects)] == SCENE.objects
    assert done.scene["5_mug_2"].yaw == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        (LayoutReply((), ("mug_7",)), "mug_7 is to be removed, but is not in the layout, which has mug_0, mug_1"),
        (LayoutReply((), ("lamp_0",)), "which has tray_0, mug_0, spoon_0, mug_1"),
        (LayoutReply((), ("mug_0", "mug_0")), "mug_0 is removed 2 times"),
        (LayoutReply((shown("mug_0"), shown("mug_0"))), "mug_0 appears 2 times"),
        (LayoutReply((shown("mug_0"),), ("mug_0",)), "mug_0 is removed and given anew"),
    ],
)
def test_a_reply_that_cannot_be_meant_is_refused_with_a_reason(reply: LayoutReply, reason: str) -> None:
    with pytest.raises(SceneError) as caught:
        apply_edit(SCENE, reply)
    assert caught.value.code == "edit_refused"
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)
    chat = messages(edit_prompt_of(SCENE).question("Take the mug away."), [("{}", str(caught.value))])
    assert reason in chat[-1]["content"]


def _near(one: SceneObject, other: SceneObject, slack: float) -> bool:
    lengths = np.abs(np.subtract((*one.position, *one.size), (*other.position, *other.size)))
    return bool(lengths.max() <= slack and abs(math.remainder(one.yaw - other.yaw, 2 * math.pi)) <= math.radians(0.51))


@pytest.mark.sim
def test_the_answer_of_an_example_makes_the_scene_that_it_was_made_of() -> None:
    kinds = set()
    for made in made_scenes(2, 4, 5):
        row = row_of(made)
        scene = scene_from_row(row)
        for told in edit_rows(row, 10):
            example, shown_to = edit_example_of(told), edit_prompt_of(scene)
            assert shown_to.question(told["instruction"]) == example.question
            done = apply_edit(shown_to, parse_reply(example.answer))
            new = {o["instance"]: object_from_row(o) for o in told["objects_out"]}
            kinds.add(done.kind)
            assert done.kind == told["kind"]
            assert {o.instance for o in done.scene.objects} == {*new, *(o.instance for o in scene.objects)} - {*told["removed"]}
            for o in done.scene.objects:
                if o.instance in new:
                    assert _near(
                        o, new[o.instance], 1.01e-3
                    )  # a number that is repeated stays, so it may be off by two roundings
                elif o.instance in done.carried:
                    assert _near(o, scene[o.instance], 2e-3)
                else:
                    assert o == scene[o.instance]
    assert kinds == {"add", "remove", "replace", "move", "restyle"}


def _left(o: LayoutObject) -> LayoutReply:
    return LayoutReply((replace(o, position_cm=(round(o.position_cm[0] - 1.0, 1), *o.position_cm[1:])),))


@pytest.mark.parametrize(
    ("reply_to", "kind"),
    [
        (lambda shown_to: LayoutReply(()), "none"),
        (lambda shown_to: LayoutReply((), (shown_to.layout[-1].instance,)), "remove"),
        (lambda shown_to: _left(shown_to.layout[0]), "move"),
        (lambda shown_to: LayoutReply((replace(shown_to.layout[0], instance="zebra_0"),)), "add"),
        (lambda shown_to: LayoutReply((replace(shown_to.layout[0], description="another thing"),)), "restyle"),
        (lambda s: LayoutReply((replace(s.layout[0], instance="zebra_0"),), (s.layout[0].instance,)), "replace"),
    ],
)
def test_real_scenes_keep_what_is_not_named(real_data: Path, reply_to: Callable[[EditPrompt], LayoutReply], kind: str) -> None:
    dataset = MesaTaskDataset(real_data)
    for scene_id in dataset.scene_ids:
        read = dataset.read(scene_id)[0]
        carriers = supports(read, {})
        scene = replace(read, objects=tuple(replace(o, support=carriers[o.instance]) for o in read.objects))
        done = apply_edit(scene, reply_to(edit_prompt_of(scene)))
        assert done.kind == kind
        assert all(done.scene[name] == scene[name] for name in done.untouched)
        expected = len(scene.objects) - len(done.removed) + len(done.added)
        assert len(done.scene.objects) == expected == len(done.untouched) + len({*done.added, *done.changed, *done.carried})
        if kind == "move":
            shift = [np.subtract(done.scene[name].position, scene[name].position) for name in (*done.changed, *done.carried)]
            np.testing.assert_allclose(shift, np.tile(shift[0], (len(shift), 1)), atol=1e-12)
