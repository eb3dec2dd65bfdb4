"""What a policy sees does not depend on where the robot stands, nor on how a box is turned into itself."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models.policy.keyframes import next_key_frames, opening_before
from models.policy.task_frame import NUM_INPUTS, NUM_KEY_INPUTS, TaskFrame, check_clonable
from stable_data.errors import ConfigError
from stable_data.robot.episode_chunks import EpisodeChunks
from stable_data.robot.observation import ENVIRONMENT_STATE_NAMES, GOAL_PART, POINTS, POINTS_PART, SLOT_SIZE
from tests.stable_data.robot.synthetic_episodes import episode

SIZE = (0.05, 0.1, 0.2)
MEMORY = np.array([[1.0, 0.5]], np.float32)


def columns(rotation: Rotation) -> np.ndarray:
    return rotation.as_matrix()[:, :2].T.ravel()


def states(turn: Rotation, box: Rotation, *, present: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """One state: a tool, a box in front of it and a goal, all turned about the base."""
    tool, tool_turn = np.array([0.4, 0.1, 0.3]), Rotation.from_euler("xyz", [3.0, 0.2, 0.4])
    robot = np.concatenate([np.zeros(7), [0.04], turn.apply(tool), columns(turn * tool_turn)])
    world = np.zeros(len(ENVIRONMENT_STATE_NAMES))
    if present:
        world[:SLOT_SIZE] = [1.0, *turn.apply([0.5, -0.1, 0.1]), *columns(turn * box), *SIZE]
        world[2 * SLOT_SIZE : 3 * SLOT_SIZE] = [1.0, *turn.apply([0.6, 0.2, 0.1]), *columns(turn), *SIZE]
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (POINTS, 3)) + np.array([0.5, -0.1, 0.1])
        world[POINTS_PART] = turn.apply(points).ravel()
    world[GOAL_PART] = [1.0, *turn.apply([0.3, 0.3, 0.0])]
    return robot[None].astype(np.float32), world[None].astype(np.float32)


@given(st.floats(-np.pi, np.pi), st.booleans())
def test_a_turn_about_the_base_changes_nothing(angle: float, present: bool) -> None:
    box, turn = Rotation.from_euler("z", 0.3), Rotation.from_euler("z", angle)
    still, turned = (TaskFrame(*states(t, box, present=present)) for t in (Rotation.identity(), turn))
    np.testing.assert_allclose(turned.inputs(MEMORY), still.inputs(MEMORY), atol=2e-4)
    np.testing.assert_allclose(turned.points(), still.points(), atol=2e-4)
    place, facing = np.array([[0.5, 0.0, 0.2]]), Rotation.from_euler("x", 2.5)
    key = still.keys(place, facing.as_matrix()[None], np.array([0.04], np.float32))
    again = turned.keys(turn.apply(place), (turn * facing).as_matrix()[None], np.array([0.04], np.float32))
    np.testing.assert_allclose(again, key, atol=1e-4)
    np.testing.assert_allclose(turned.key_inputs(key), still.key_inputs(key), atol=2e-3)


def test_a_box_turned_into_itself_looks_the_same() -> None:
    seen = [
        TaskFrame(*states(Rotation.identity(), Rotation.from_euler("z", 0.3) * flip)).inputs(MEMORY)
        for flip in (Rotation.identity(), Rotation.from_euler("z", np.pi), Rotation.from_euler("x", np.pi))
    ]
    np.testing.assert_allclose(seen[1:], [seen[0]] * 2, atol=1e-5)
    assert seen[0].shape == (1, NUM_INPUTS)


def test_the_pose_of_the_tool_itself_is_no_move() -> None:
    frame = TaskFrame(*states(Rotation.from_euler("z", 1.0), Rotation.identity()))
    inputs = frame.key_inputs(frame.keys(*frame.tool_poses, np.zeros(1, np.float32)))
    assert inputs.shape == (1, NUM_KEY_INPUTS)
    np.testing.assert_allclose(inputs[0, :24], 0.0, atol=1e-4)


@given(st.floats(-np.pi, np.pi))
def test_actions_return_from_the_task_frame(angle: float) -> None:
    frame = TaskFrame(*states(Rotation.from_euler("z", angle), Rotation.identity()))
    actions = np.random.default_rng(0).normal(size=(1, 4, 7)).astype(np.float32)
    np.testing.assert_allclose(frame.to_actions(frame.from_actions(actions)), actions, atol=1e-5)


def test_key_frames_are_those_in_which_the_hand_begins_to_close_or_open_and_the_last() -> None:
    openings = np.array([0.08, 0.08, 0.0, 0.0, 0.05, 0.05])
    actions = np.column_stack([np.zeros((6, 7)), openings])
    one, two = (episode(number=k, steps=6, actions=actions) for k in (0, 1))
    chunks = EpisodeChunks([one, two], 2)
    found = next_key_frames(chunks)
    assert found.tolist() == [2, 2, 2, 4, 4, 5, 8, 8, 8, 10, 10, 11]
    np.testing.assert_allclose(opening_before(chunks, found), [0.08, 0.08, 0.08, 0, 0, 0.05] * 2)


def test_other_controls_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"control is 'joint', expected 'ee_delta'|control is \"joint\"") as caught:
        check_clonable(episode().features)
    assert caught.value.code == "policy_features"
