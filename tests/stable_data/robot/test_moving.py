"""Paths, actions and the scripted expert."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import ConfigError
from stable_data.robot.arm.control import CONTROLS, MAX_JOINT, Controller
from stable_data.robot.arm.kinematics import Arm
from stable_data.robot.arm.motion import STEP, joint_line, plan_path, timed, tool_line
from stable_data.robot.arm.robots import ROBOTS, robot_named
from stable_data.robot.expert import Command, Expert, ExpertError
from stable_data.scene import FloatArray
from stable_data.tasks.placing import TargetPose
from tests.stable_data.robot.tables import BOX, CAN, PLATE, Bench

ROBOT = ROBOTS["simple"]
ARM = Arm(robot_named("simple"))


@given(st.floats(0.2, 3.0), st.floats(0.01, 0.1), st.integers(0, 1000))
def test_a_timed_path_keeps_its_speed_and_its_end(speed: float, step: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(0, 0.2, (6, 3)), axis=0)
    times = timed(path, speed, step)
    assert times[-1] == pytest.approx(path[-1], abs=1e-9)
    moves = abs(np.diff(np.concatenate([path[:1], times]), axis=0)).max()
    assert moves <= speed * step * (1 + 1e-6)


def test_a_line_of_the_tool_is_straight() -> None:
    begin, rotation = (found[0] for found in ARM.poses(ARM.home[None]))
    end = begin + np.array([0.05, 0.1, -0.12])
    path = tool_line(ARM, ARM.home, end, rotation)
    assert path is not None
    positions, _ = ARM.poses(path)
    away = positions - begin
    along = (end - begin) / np.linalg.norm(end - begin)
    assert np.linalg.norm(away - np.outer(away @ along, along), axis=1).max() < 3e-3
    assert tool_line(ARM, ARM.home, np.array([2.0, 0.0, 0.0]) + begin, rotation) is None


def test_a_planned_path_goes_around(bench: Bench) -> None:
    down = np.diag([1.0, -1.0, -1.0])
    low = [bench.built.mount.to_base(np.array([x, 0.25, 0.05])) for x in (0.28, 0.5)]  # the can stands between them
    start, goal = (bench.arm.solve(p[None], down[None]).joints[0] for p in low)
    straight = [bench.clearance.hits(q, 0.02) for q in joint_line(start, goal)]
    assert CAN in straight
    path = plan_path(bench.arm, bench.clearance, start, goal, 0.02)
    assert path is not None
    assert path[0] == pytest.approx(start)
    assert path[-1] == pytest.approx(goal)
    assert max(abs(b - a).max() for a, b in itertools.pairwise(path)) <= STEP + 1e-9
    assert all(bench.clearance.hits(joints, 0.02) is None for joints in path)
    assert np.array_equal(path, plan_path(bench.arm, bench.clearance, start, goal, 0.02))  # type: ignore[arg-type]


def test_no_path_leads_into_the_table(bench: Bench) -> None:
    below = bench.built.mount.to_base(np.array([0.5, 0.3, -0.03]))
    goal = bench.arm.solve(below[None], np.diag([1.0, -1.0, -1.0])[None]).joints[0]
    assert plan_path(bench.arm, bench.clearance, bench.arm.home, goal, 0.08) is None


@pytest.mark.parametrize("control", CONTROLS)
@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_an_action_for_joints_commands_them(control: str, seed: int) -> None:
    controller = Controller(ROBOT, ARM, control)
    joints = np.clip(ARM.home + np.random.default_rng(seed).uniform(-0.04, 0.04, 7), ARM.low, ARM.high)
    action = controller.action_for(joints, 0.03)
    commanded, opening = controller.command(action, ARM.home)
    reached, turned = ARM.poses(np.stack([commanded, joints]))
    assert opening == pytest.approx(0.03)
    assert reached[0] == pytest.approx(reached[1], abs=2e-3)
    assert turned[0] == pytest.approx(turned[1], abs=2e-2)
    assert action.shape == controller.low.shape == (len(controller.names),)


@pytest.mark.parametrize("control", CONTROLS)
def test_wild_actions_stay_within_limits(control: str) -> None:
    controller = Controller(ROBOT, ARM, control)
    rng, joints = np.random.default_rng(0), ARM.home
    for _ in range(30):
        before = joints
        joints, opening = controller.command(rng.normal(0, 3, controller.low.shape), joints)
        assert (joints >= ARM.low).all()
        assert (joints <= ARM.high).all()
        assert abs(joints - before).max() <= 2 * MAX_JOINT + 1e-9
        assert 0 <= opening <= ROBOT.hand.max_opening


def test_parallel_columns_are_no_error() -> None:
    controller = Controller(ROBOT, ARM, "ee")
    action = np.zeros(10, np.float32)
    action[:3] = ARM.poses(ARM.home[None])[0][0]
    joints, _ = controller.command(action, ARM.home)
    assert np.isfinite(joints).all()


@pytest.mark.parametrize("action", [[0.0], [np.nan] * 7, [[0.0] * 7]])
def test_an_action_that_is_none_is_refused(action: list[float]) -> None:
    with pytest.raises(ValueError, match="expected 7 finite numbers: tool_x_delta"):
        Controller(ROBOT, ARM, "ee_delta").command(action, ARM.home)


def test_an_unknown_control_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected one of ee_delta, ee"):
        Controller(ROBOT, ARM, "torque")


def target(position: FloatArray, support: str) -> TargetPose:
    x, y, z = position.tolist()
    return TargetPose((x, y, z), (0.0, 0.0, 0.0, 1.0), 0.0, z, support)


def run(bench: Bench, commands: "itertools.chain[Command]") -> None:
    for command in commands:
        bench.world.advance(command.joints, command.opening, 0.05)


def test_the_expert_puts_the_can_on_the_plate(bench: Bench) -> None:
    expert, k, plate = Expert(bench.finder, bench.world), bench.index(CAN), bench.built.geometry.scene[PLATE]
    can = bench.built.geometry.scene[CAN]
    run(bench, itertools.chain(expert.pick(CAN)))
    assert bench.world.contacts().held == {CAN}
    place = target(np.array([*plate.position[:2], plate.top + can.size[2] / 2]), PLATE)
    run(bench, itertools.chain(expert.place(CAN, [place]), expert.rest()))
    assert bench.world.contacts().supports[CAN] == (PLATE,)
    assert bench.world.object_poses[k, :2] == pytest.approx(plate.position[:2], abs=0.03)
    assert bench.world.object_speeds.max() < 0.02


def test_the_expert_says_why_it_gives_up(bench: Bench) -> None:
    expert = Expert(bench.finder, bench.world)
    with pytest.raises(ExpertError, match="lost: 0_can_0"):
        run(bench, itertools.chain(expert.place(CAN, [])))
    run(bench, itertools.chain(expert.pick(CAN)))
    with pytest.raises(ExpertError, match="no_place: 0_can_0"):
        run(bench, itertools.chain(expert.place(CAN, [target(np.array([5.0, 5.0, 0.1]), "table")])))


def test_a_miss_is_tried_again(bench: Bench) -> None:
    """The can is put elsewhere when the fingers close for the first time."""
    expert, k = Expert(bench.finder, bench.world), bench.index(CAN)
    is_moved = False
    for command in expert.pick(CAN):
        if command.opening == 0.0 and not is_moved:
            is_moved = True
            address, speed = bench.built.free_addresses[CAN]
            bench.world.data.qpos[address : address + 2] = [0.4, 0.36]
            bench.world.data.qvel[speed : speed + 6] = 0.0
        bench.world.advance(command.joints, command.opening, 0.05)
    assert is_moved
    assert CAN in bench.world.contacts().gripped
    assert bench.world.object_poses[k, 2] > 0.1
    assert BOX not in bench.world.contacts().hit
