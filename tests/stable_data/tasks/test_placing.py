"""Poses for objects that are put down: free, on the table, and where the step wants them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from stable_data.condition import GoalCondition
from stable_data.errors import GoalError
from stable_data.rotations import heading, yaw_quat
from stable_data.scene import Tabletop
from stable_data.tasks.checking import GoalChecker, StateView, start_state
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import Goal, GoalKind, Step, StepAction
from stable_data.tasks.placing import CLEARANCE, placed_state, target_poses
from tests.stable_data.tasks.task_scenes import geometry, goal, lifted, of

SPACE = geometry()
START = start_state(SPACE)


def place(subject: str, *conditions: GoalCondition) -> Step:
    return Step(StepAction.PLACE, subject, conditions)


@pytest.mark.parametrize(
    "condition",
    [
        of("mug_0", "on", "table"),
        of("mug_0", "left of", "book_0"),
        of("mug_0", "beside", "plate_0"),
        of("mug_0", "between", "block_2, bin_0"),
        of("mug_0", "at", "back_right"),
        of("mug_0", "at", "front_edge"),
        of("mug_0", "apart", "book_0", 0.2),
        of("mug_0", "at", "front_left", negated=True),
    ],
    ids=str,
)
def test_a_pose_on_the_table_is_free_and_right(condition: GoalCondition) -> None:
    poses = target_poses(place("mug_0", condition), SPACE, START)
    assert len(poses) >= 3
    for pose in poses:
        after = placed_state(SPACE, START, "mug_0", pose)
        view = StateView(SPACE, after)
        assert pose.support == "table"
        assert pose.release_height > pose.position[2]
        assert view.item("mug_0").bottom == pytest.approx(0.0, abs=1e-6)
        x_min, y_min, x_max, y_max = shapely.bounds(view.outline("mug_0"))
        assert min(x_min, y_min, 1.2 - x_max, 0.7 - y_max) >= -1e-9
        assert min(view.gap("mug_0", name) for name in SPACE.rows if name != "mug_0") >= CLEARANCE - 1e-9
        assert GoalChecker(Goal(GoalKind.MOVE, (condition,), ()), SPACE).is_success(after)


def test_a_pose_of_what_is_handed_over_is_in_the_air_at_the_front_edge() -> None:
    held = of("block_0", "held", "front_edge")
    poses = target_poses(Step(StepAction.CARRY, "block_0", (held,)), SPACE, START)
    assert len({pose.position[0] for pose in poses}) >= 3  # far from each other
    for pose in poses:
        after = placed_state(SPACE, START, "block_0", pose)
        item = StateView(SPACE, after).item("block_0")
        assert pose.support is None
        assert after.touching["block_0"] == ()
        assert after.held == {"block_0"}
        assert item.bottom >= 0.1 - 1e-9
        assert pose.release_height == pose.position[2]
        assert GoalChecker(Goal(GoalKind.HAND_OVER, (held,), ()), SPACE).is_success(after)
    high = replace(SPACE.scene, objects=tuple(replace(o, position=(*o.position[:2], 0.4)) for o in SPACE.scene.objects))
    raised = TaskGeometry(high, SPACE.shapes, SPACE.containers)
    lowest = target_poses(Step(StepAction.CARRY, "block_0", (held,)), raised, start_state(raised))[0].position[2]
    assert lowest > 0.4  # lifted, from wherever it was


def test_a_pose_in_a_container_is_released_above_its_rim_and_rests_on_its_floor() -> None:
    pose = target_poses(place("mug_0", of("mug_0", "in", "bin_0")), SPACE, START)[0]
    half = SPACE.scene.objects[0].size[2] / 2
    assert pose.support == "bin_0"
    assert pose.release_height - half > 0.15
    assert 0.009 < pose.position[2] - half < 0.03
    assert np.hypot(pose.position[0] - 0.9, pose.position[1] - 0.45) < 0.06


def test_a_pen_stands_in_a_narrow_mug() -> None:
    pose = target_poses(place("pen_0", of("pen_0", "in", "mug_0")), SPACE, START)[0]
    item = StateView(SPACE, placed_state(SPACE, START, "pen_0", pose)).item("pen_0")
    assert item.size[2] == pytest.approx(0.14, abs=1e-6)
    assert 0.007 < item.bottom < 0.02
    assert pose.release_height - 0.07 > 0.1


def test_the_best_place_for_a_stack_is_the_middle() -> None:
    pose = target_poses(place("block_1", of("block_1", "on", "block_2")), SPACE, START)[0]
    assert pose.position[:2] == pytest.approx((0.35, 0.5), abs=1e-6)
    assert pose.position[2] == pytest.approx(0.075, abs=2e-3)


def test_a_place_on_an_object_is_beside_what_is_there() -> None:
    for pose in target_poses(place("block_1", of("block_1", "on", "book_0")), SPACE, START):
        view = StateView(SPACE, placed_state(SPACE, START, "block_1", pose))
        assert view.gap("block_1", "block_0") > 0


def test_nothing_is_put_into_the_restricted_zone() -> None:
    table = Tabletop("desk", (1.2, 0.7), restricted_zone=(0.3, 1.2, 0.3, 0.7))
    space = TaskGeometry(SPACE.scene.__class__("scene", table, SPACE.scene.objects[:1]), SPACE.shapes[:1], {"mug_0": True})
    for pose in target_poses(place("mug_0", of("mug_0", "on", "table")), space, start_state(space)):
        assert pose.position[0] < 0.26 or pose.position[1] < 0.26
    with pytest.raises(GoalError) as refused:
        target_poses(place("mug_0", of("mug_0", "at", "back_right")), space, start_state(space))
    assert refused.value.code == "no_free_place"


def test_what_an_object_carries_goes_with_it() -> None:
    pose = target_poses(place("bin_0", of("bin_0", "at", "front_right")), SPACE, START)[0]
    after = placed_state(SPACE, START, "bin_0", pose)
    step = after.positions - START.positions
    assert step[SPACE.rows["pen_0"]] == pytest.approx(step[SPACE.rows["bin_0"]], abs=1e-9)
    assert GoalChecker(goal(of("bin_0", "at", "front_right")), SPACE).is_success(after)


def test_a_row_stays_where_it_is_when_a_hand_turns_a_member_and_shifts_another_object() -> None:
    row = of("book_0, block_0", "in a row")
    first = target_poses(place("book_0", row), SPACE, START)[0]
    state = lifted(START, SPACE, "book_0")
    quats, positions = state.quats_xyzw.copy(), state.positions.copy()
    turn = yaw_quat(heading(tuple(quats[SPACE.rows["book_0"]].tolist()))[0] + 0.5)
    quats[SPACE.rows["book_0"]] = turn
    positions[SPACE.rows["plate_0"], 0] += 0.02
    again = target_poses(place("book_0", row), SPACE, replace(state, quats_xyzw=quats, positions=positions))[0]
    assert again.position[:2] == pytest.approx(first.position[:2], abs=1e-6)
    assert again.yaw == pytest.approx(first.yaw, abs=1e-6)


def test_a_push_ends_where_it_is_stated() -> None:
    pose = target_poses(Step(StepAction.PUSH, "block_1", (of("block_1", "moved", "left", 0.1),)), SPACE, START)[0]
    assert pose.position[:2] == pytest.approx((0.1, 0.45), abs=1e-6)
