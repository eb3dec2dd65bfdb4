"""Conditions on states that are made by hand: true where the goal is reached, false before and after."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.condition import GoalCondition
from stable_data.errors import GoalError
from stable_data.rotations import yaw_quat
from stable_data.tasks.checking import GoalChecker, SceneState, start_state
from stable_data.tasks.goal import Goal, GoalKind
from tests.stable_data.tasks.task_scenes import geometry, goal, lifted, moved, of, states_of

SPACE = geometry()
START = start_state(SPACE)


def turned(state: SceneState, name: str, quat: tuple[float, float, float, float]) -> SceneState:
    quats = state.quats_xyzw.copy()
    quats[SPACE.rows[name]] = quat
    return replace(state, quats_xyzw=quats)


def put(name: str, x: float, y: float, z: float, *touched: str) -> Callable[[SceneState], SceneState]:
    return lambda state: moved(state, SPACE, name, (x, y, z), *touched)


HALF = math.sqrt(0.5)
REACHED: list[tuple[tuple[GoalCondition, ...], Callable[[SceneState], SceneState]]] = [
    ((of("mug_0", "held"),), lambda s: lifted(s, SPACE, "mug_0")),
    ((of("mug_0", "on", "book_0"),), put("mug_0", 0.47, 0.2, 0.08, "book_0")),
    ((of("block_0", "on", "table"), of("block_0", "on", "book_0", negated=True)), put("block_0", 0.3, 0.3, 0.025, "table")),
    ((of("mug_0", "in", "bin_0"),), put("mug_0", 0.9, 0.45, 0.075, "bin_0")),
    ((of("mug_0", "left of", "book_0"), of("mug_0", "beside", "book_0")), put("mug_0", 0.32, 0.2, 0.05, "table")),
    ((of("mug_0", "right of", "book_0"),), put("mug_0", 0.66, 0.25, 0.05, "table")),
    ((of("mug_0", "in front of", "book_0"),), put("mug_0", 0.5, 0.06, 0.05, "table")),
    ((of("mug_0", "behind", "book_0"),), put("mug_0", 0.5, 0.4, 0.05, "table")),
    ((of("mug_0", "beside", "plate_0"),), put("mug_0", 0.6, 0.06, 0.05, "table")),
    ((of("mug_0", "between", "book_0, plate_0"),), put("mug_0", 0.64, 0.18, 0.05, "table")),
    ((of("block_1", "apart", "block_2", 0.2),), put("block_1", 0.05, 0.5, 0.025, "table")),
    ((of("block_1", "at", "back_right"),), put("block_1", 1.1, 0.6, 0.025, "table")),
    ((of("block_1", "at", "right"),), put("block_1", 1.1, 0.1, 0.025, "table")),
    ((of("block_1", "at", "front_edge"),), put("block_1", 0.1, 0.06, 0.025, "table")),
    ((of("block_1", "at", "right_half"),), put("block_1", 0.7, 0.45, 0.025, "table")),
    (
        (of("block_1", "at", "mug_0"),),
        lambda s: put("block_1", 0.21, 0.2, 0.025, "table")(put("mug_0", 0.1, 0.6, 0.05, "table")(s)),
    ),
    ((of("block_1", "at", "middle_left", negated=True),), put("block_1", 0.2, 0.6, 0.025, "table")),
    ((of("book_0", "facing", "right"),), lambda s: turned(s, "book_0", yaw_quat(math.pi / 2))),
    ((of("mug_0", "facing", "book_0"),), lambda s: turned(s, "mug_0", yaw_quat(math.pi / 2))),
    ((of("block_1", "moved", "left", 0.1),), put("block_1", 0.11, 0.46, 0.025, "table")),
    ((of("bin_0", "empty", "in"),), put("pen_0", 0.6, 0.6, 0.006, "table")),
    ((of("book_0", "empty", "on"),), put("block_0", 0.3, 0.3, 0.025, "table")),
    ((of("block_1, block_2", "together"),), put("block_1", 0.28, 0.5, 0.025, "table")),
    (
        (of("block_1, block_2, mug_0", "in a row"),),
        lambda s: put("mug_0", 0.5, 0.47, 0.05, "table")(put("block_2", 0.35, 0.46, 0.025, "table")(s)),
    ),
    ((of("block_2, block_1", "ordered"),), put("block_1", 0.5, 0.6, 0.025, "table")),
    ((of("mug_0, block_2, plate_0", "evenly spaced"),), put("block_2", 0.475, 0.5, 0.025, "table")),
]
NAMES = ["; ".join(map(str, conditions)) for conditions, _ in REACHED]


@pytest.mark.parametrize(("conditions", "reach"), REACHED, ids=NAMES)
def test_a_goal_is_reached_and_lost_again(
    conditions: tuple[GoalCondition, ...], reach: Callable[[SceneState], SceneState]
) -> None:
    target = goal(*conditions)
    checker, there = GoalChecker(target, SPACE), reach(START)
    assert not checker.is_success(START)
    assert checker.conditions(there) == (True,) * len(conditions)
    assert checker.is_success(there)
    assert checker.reward(there) == 1.0 > checker.reward(START) >= 0.0
    assert not checker.is_success(SceneState(START.positions, START.quats_xyzw, START.touching))


@pytest.mark.parametrize(("conditions", "reach"), REACHED[1:], ids=NAMES[1:])
def test_what_is_not_released_or_still_moves_is_not_placed(
    conditions: tuple[GoalCondition, ...], reach: Callable[[SceneState], SceneState]
) -> None:
    checker, there = GoalChecker(goal(*conditions), SPACE), reach(START)
    assert not checker.is_success(replace(there, max_speed=0.1))
    for name in conditions[0].subjects:
        assert not checker.is_success(replace(there, grasped=frozenset({name})))
        assert checker.reward(replace(there, grasped=frozenset({name}))) < 1.0


@pytest.mark.parametrize(("conditions", "reach"), REACHED, ids=NAMES)
def test_an_object_that_fell_off_the_table_fulfils_nothing(
    conditions: tuple[GoalCondition, ...], reach: Callable[[SceneState], SceneState]
) -> None:
    state = replace(reach(START), held=frozenset())
    for name in conditions[0].subjects:
        assert not GoalChecker(goal(*conditions), SPACE).is_success(moved(state, SPACE, name, (0.5, 0.3, -0.7)))


def test_a_held_object_over_its_container_is_not_in_it() -> None:
    checker = GoalChecker(goal(of("mug_0", "in", "bin_0")), SPACE)
    inside = moved(START, SPACE, "mug_0", (0.9, 0.45, 0.075))
    assert not checker.is_success(replace(inside, held=frozenset({"mug_0"})))
    above = moved(START, SPACE, "mug_0", (0.9, 0.45, 0.3))
    assert not checker.is_success(above)


def test_a_mug_is_in_the_bin_on_what_is_in_the_bin() -> None:
    checker = GoalChecker(goal(of("mug_0", "in", "bin_0")), SPACE)
    assert checker.is_success(moved(START, SPACE, "mug_0", (0.9, 0.45, 0.073), "pen_0"))


def test_a_tipped_mug_stands_upright_only_on_its_base() -> None:
    tilted = SPACE.scene.objects[0]
    lying = replace(tilted, tilt_quat_xyzw=(HALF, 0.0, 0.0, HALF), size=(0.08, 0.1, 0.08), position=(0.2, 0.2, 0.04))
    shape = SPACE.shapes[0]
    turned_shape = replace(shape, vertices=shape.vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float))
    space = replace(
        SPACE, scene=replace(SPACE.scene, objects=(lying, *SPACE.scene.objects[1:])), shapes=(turned_shape, *SPACE.shapes[1:])
    )
    target = Goal(GoalKind.TURN, (of("mug_0", "upright"),), ())
    checker, start = GoalChecker(target, space), start_state(space)
    assert not checker.is_success(start)
    quats = start.quats_xyzw.copy()
    quats[0] = space.upright_quat(0, 0.4)
    positions = start.positions.copy()
    positions[0, 2] = 0.05
    assert checker.is_success(replace(start, quats_xyzw=quats, positions=positions))


def test_a_held_goal_needs_a_lift() -> None:
    checker = GoalChecker(goal(of("mug_0", "held")), SPACE)
    assert not checker.is_success(lifted(START, SPACE, "mug_0", 0.005))
    assert not checker.is_success(replace(lifted(START, SPACE, "mug_0"), held=frozenset({"block_1"})))
    assert checker.is_success(replace(lifted(START, SPACE, "mug_0"), max_speed=0.3))


def test_what_is_handed_over_is_held_at_the_edge_of_the_user() -> None:
    target = goal(of("block_1", "held", "front_edge"))
    checker = GoalChecker(target, SPACE)
    states = states_of(target, SPACE)
    assert [checker.is_success(state) for state in states] == [False, False, True]
    rewards = [checker.reward(state) for state in states]
    assert rewards == sorted(rewards)
    assert rewards[-1] == 1.0
    standing = moved(START, SPACE, "block_1", (0.2, 0.05, 0.025), "table")
    assert not checker.is_success(standing)  # it is at the edge, but not held
    far = lifted(moved(START, SPACE, "block_1", (0.2, 0.2, 0.025)), SPACE, "block_1")
    beyond = lifted(moved(START, SPACE, "block_1", (0.2, -0.1, 0.025)), SPACE, "block_1")
    assert (checker.is_success(far), checker.is_success(beyond)) == (False, True)


def test_a_push_of_another_length_or_direction_is_not_the_goal() -> None:
    checker = GoalChecker(goal(of("block_1", "moved", "left", 0.1)), SPACE)
    for x, y in ((0.17, 0.45), (0.05, 0.45), (0.3, 0.45), (0.1, 0.3)):
        assert not checker.is_success(moved(START, SPACE, "block_1", (x, y, 0.025), "table"))


@pytest.mark.parametrize(
    "condition",
    [
        of("cat_0", "held"),
        of("mug_0", "on", "cat_0"),
        of("mug_0", "in", "table"),
        of("mug_0", "at", "moon"),
        of("mug_0", "moved", "up"),
        of("mug_0", "between", "book_0"),
        of("mug_0", "in a row"),
        of("mug_0, book_0", "held"),
        of("mug_0, mug_0", "together"),
        of("mug_0", "held", "book_0"),
        of("block_1, block_2", "ordered", "by_weight"),
        of("bin_0", "empty", "under"),
    ],
)
def test_a_condition_about_nothing_is_refused(condition: GoalCondition) -> None:
    with pytest.raises(GoalError) as refused:
        GoalChecker(Goal(GoalKind.SEVERAL, (condition,), ()), SPACE)
    assert refused.value.code == "goal_unresolved"


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(REACHED), st.integers(0, 2**31), st.booleans(), st.floats(0, 0.2))
def test_a_reward_is_a_share_and_1_means_success(
    reached: tuple[tuple[GoalCondition, ...], Callable[[SceneState], SceneState]], seed: int, is_held: bool, speed: float
) -> None:
    rng = np.random.default_rng(seed)
    checker = GoalChecker(goal(*reached[0]), SPACE)
    state = reached[1](START) if rng.random() < 0.3 else START
    positions = state.positions + rng.normal(0, 0.1, state.positions.shape) * (rng.random((len(state.positions), 1)) < 0.3)
    quats = rng.normal(size=state.quats_xyzw.shape) * 0.2 + state.quats_xyzw
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    name = reached[0][0].subjects[0]
    state = replace(state, positions=positions, quats_xyzw=quats, max_speed=speed, gripper_position=rng.uniform(0, 1, 3))
    state = replace(state, held=frozenset({name})) if is_held else state
    reward = checker.reward(state)
    assert 0.0 <= reward <= 1.0
    assert (reward == 1.0) == checker.is_success(state)


def test_the_reward_grows_from_the_start_to_the_goal() -> None:
    target = goal(of("mug_0", "in", "bin_0"))
    checker, mug = GoalChecker(target, SPACE), START.positions[0]
    far = replace(START, gripper_position=mug + np.array((0.4, 0.2, 0.3)))
    near = replace(START, gripper_position=mug + np.array((0.0, 0.0, 0.05)))
    grasped = replace(near, grasped=frozenset({"mug_0"}), gripper_position=mug)
    held = lifted(START, SPACE, "mug_0")
    over = replace(moved(held, SPACE, "mug_0", (0.9, 0.45, 0.25)), gripper_position=np.array((0.9, 0.45, 0.25)))
    rewards = [checker.reward(state) for state in (far, near, grasped, held, over, states_of(target, SPACE)[-1])]
    assert rewards == sorted(rewards)
    assert rewards[-1] == 1.0 > rewards[-2]
