import math
from dataclasses import replace

import pytest

from models.semantic_reasoner.replies.to_scene import attach_task_info, objects_of_reply, staged_by_instruction
from models.semantic_reasoner.text.prompt import Wanted
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.condition import ConditionKind, GoalCondition
from stable_data.metrics.alignment import AlignmentReference
from stable_data.metrics.matching import RequiredObject
from stable_data.scene import Relation, RelationKind, Scene, Stage
from tests.models.semantic_reasoner.language.known_categories import ask, interpreter, thing

PLATE, MUG = thing("plate_0", 30, 30, turned=90), thing("mug_0", 30, 30, bottom=2.0)


@pytest.mark.parametrize("stage", list(Stage))
def test_objects_have_the_stage_that_was_asked_for_and_what_carries_them(stage: Stage) -> None:
    plate, mug = objects_of_reply(LayoutReply((PLATE, MUG)), ask(wanted=stage))
    assert (plate.stage, mug.stage) == (stage, stage)
    assert (plate.support, mug.support) == ("table", "plate_0")
    assert plate.position == pytest.approx((0.3, 0.3, 0.01))
    assert plate.yaw == pytest.approx(math.pi / 2)
    assert (plate.instance, plate.category, plate.description, plate.asset_id) == ("plate_0", "plate", "a plate", None)


def test_what_carries_may_be_in_the_layout() -> None:
    (mug,) = objects_of_reply(LayoutReply((MUG,)), ask(wanted=Stage.IMPORTANT, layout=[PLATE]))
    assert (mug.support, mug.stage) == ("plate_0", Stage.IMPORTANT)


def test_what_floats_has_no_support() -> None:
    (mug,) = objects_of_reply(LayoutReply((thing("mug_0", 30, 30, bottom=30.0),)), ask())
    assert mug.support is None


def whole(instruction: str) -> dict[str, Stage | None]:
    far, near = thing("laptop_0", 100, 40), thing("pen_0", 30, 46)
    wanted: Wanted = "whole"
    objects = objects_of_reply(LayoutReply((PLATE, far, MUG, near)), ask(instruction, wanted), interpreter())
    return {o.instance: o.stage for o in objects}


def test_a_whole_layout_is_staged_by_its_instruction() -> None:
    assert whole("Take the mug.") == {
        "plate_0": Stage.TASK,  # carries the mug
        "laptop_0": Stage.SECONDARY,
        "mug_0": Stage.TASK,
        "pen_0": Stage.SECONDARY,
    }
    assert whole("Turn the plate.")["pen_0"] is Stage.SECONDARY
    assert whole("Hand me the pen.") == {
        "plate_0": Stage.SECONDARY,
        "laptop_0": Stage.SECONDARY,
        "mug_0": Stage.SECONDARY,
        "pen_0": Stage.TASK,
    }


def test_a_whole_layout_that_means_nothing_known_is_all_task() -> None:
    assert set(whole("Tidy up.").values()) == {Stage.TASK}


def test_an_edit_sees_what_stays() -> None:
    tall = thing("cake_stand_0", 90, 30)
    edit = ask("Put the mug on the cake stand.", "edit", [PLATE, MUG, tall])
    (mug,) = objects_of_reply(LayoutReply((thing("mug_0", 90, 30, bottom=12.0),)), edit)
    assert (mug.support, mug.stage) == ("cake_stand_0", None)
    gone = objects_of_reply(LayoutReply((thing("mug_0", 90, 30, bottom=12.0),), removed=("cake_stand_0",)), edit)
    assert gone[0].support is None


def test_an_empty_reply_is_nothing() -> None:
    nothing: tuple[LayoutObject, ...] = ()
    assert objects_of_reply(LayoutReply(nothing), ask(wanted=Stage.IMPORTANT)) == ()


def test_a_task_says_in_which_corner_its_object_is() -> None:
    wanted = ask("Lift the mug that is in the back right corner.")
    mugs = objects_of_reply(LayoutReply((thing("mug_0", 15, 10), thing("mug_1", 110, 55))), wanted)
    scene = attach_task_info(Scene("scene", wanted.table, mugs), wanted.instruction, mugs, interpreter())
    assert scene.task is not None
    assert scene.task.relations == (Relation("mug_1", RelationKind.IS_AT, "back_right"),)


def test_a_task_info_has_the_goal_that_was_read_or_labelled() -> None:
    wanted = ask("Put the mug on the cake stand.")
    layout = objects_of_reply(LayoutReply((thing("mug_0", 15, 10), thing("cake_stand_0", 90, 30))), wanted)
    scene = Scene("scene", wanted.table, tuple(replace(o, stage=Stage.TASK) for o in layout))
    read = attach_task_info(scene, wanted.instruction, layout, interpreter())
    assert read.task is not None
    assert read.task.conditions == (GoalCondition("mug_0", ConditionKind.ON, "cake_stand_0"),)
    reference = AlignmentReference("labels", (RequiredObject("3_mug_0", ("mug",)),))
    labels = (GoalCondition("3_mug_0", ConditionKind.AT, "back_left"),)
    labelled = attach_task_info(scene, wanted.instruction, layout, interpreter(), reference, labels)
    assert labelled.task is not None
    assert labelled.task.conditions == (GoalCondition("mug_0", ConditionKind.AT, "back_left"),)
    of_another = (GoalCondition("9_lamp_0", ConditionKind.HELD),)
    lost = attach_task_info(scene, wanted.instruction, layout, interpreter(), reference, of_another)
    assert lost.task is not None
    assert lost.task.conditions == read.task.conditions


def test_of_like_objects_a_task_info_names_those_for_which_its_relations_hold() -> None:
    """A bow or a rim reaches above the surface that carries: by boxes alone, the second mug is in the plate and not on it."""
    wanted = ask("Lift the mug that is on the plate.")
    apart, on = thing("mug_0", 80, 30), thing("mug_1", 30, 30, bottom=8.0)
    deep = thing("plate_0", 30, 30, size=(20.0, 20.0, 10.0))
    free, carried, plate = (o.to_scene_object(Stage.TASK) for o in (apart, on, deep))
    layout = (free, replace(carried, support="plate_0"), plate)
    expected = Relation("mug_1", RelationKind.ON, "plate_0")
    scene = attach_task_info(Scene("scene", wanted.table, layout), wanted.instruction, layout, interpreter())
    assert scene.task is not None
    assert scene.task.relations == (expected,)
    staged = staged_by_instruction(layout, wanted.table, wanted.instruction, interpreter())
    assert [o.stage for o in staged] == [Stage.SECONDARY, Stage.TASK, Stage.TASK]
    reference = AlignmentReference(
        "labels",
        (RequiredObject("the_mug", ("mug",)), RequiredObject("the_plate", ("plate",))),
        (Relation("the_mug", RelationKind.ON, "the_plate"),),
    )
    labels = (GoalCondition("the_mug", ConditionKind.HELD),)
    labelled = attach_task_info(Scene("scene", wanted.table, layout), wanted.instruction, layout, None, reference, labels)
    assert labelled.task is not None
    assert labelled.task.conditions == (GoalCondition("mug_1", ConditionKind.HELD),)
