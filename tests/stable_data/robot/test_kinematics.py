"""Kinematics: as MuJoCo computes them, derivatives as differences show, solutions that reach."""

import mujoco
import numpy as np
import pytest

from stable_data.robot.arm.kinematics import FEW_JOINTS_TOLERANCE, POSITION_TOLERANCE, ROTATION_TOLERANCE, Arm
from stable_data.robot.arm.robots import ROBOTS, robot_named, robot_spec
from stable_data.rotations import wxyz
from stable_data.scene import FloatArray


@pytest.fixture(params=list(ROBOTS))
def name(request: pytest.FixtureRequest) -> str:
    robot = ROBOTS[request.param]
    if not robot.is_there:
        pytest.skip(f"the files of {robot.name} are not on this machine: stable-data robots --fetch {robot.name}")
    return robot.name


MOVE = np.array([0.01, -0.02, 0.01])


def drawn_joints(arm: Arm, count: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(arm.low, arm.high, (count, len(arm.low)))


def test_poses_are_those_of_mujoco(name: str) -> None:
    robot = robot_named(name)
    arm, spec = Arm(robot), robot_spec(robot)
    hand = robot.hand
    spec.body(hand.body).add_site(name="probe", pos=list(hand.position), quat=wxyz(hand.quat_xyzw))
    model = spec.compile()
    data = mujoco.MjData(model)
    joints = drawn_joints(arm, 10)
    positions, rotations = arm.poses(joints)
    for k, values in enumerate(joints):
        for joint, value in zip(robot.joints, values, strict=True):
            data.joint(joint).qpos = value
        mujoco.mj_kinematics(model, data)
        assert data.site("probe").xpos == pytest.approx(positions[k], abs=1e-9)
        assert data.site("probe").xmat.reshape(3, 3) == pytest.approx(rotations[k], abs=1e-9)


def test_the_jacobian_is_the_derivative(name: str) -> None:
    arm = Arm(robot_named(name))
    joints, small = drawn_joints(arm, 5), 1e-6
    jacobian = arm.jacobian(joints)
    position, rotation = arm.poses(joints)
    for j in range(joints.shape[1]):
        moved = joints.copy()
        moved[:, j] += small
        position_then, rotation_then = arm.poses(moved)
        assert (position_then - position) / small == pytest.approx(jacobian[:, :3, j], abs=1e-4)
        turn = (rotation_then @ rotation.transpose(0, 2, 1) - np.eye(3)) / small
        spin = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
        assert spin == pytest.approx(jacobian[:, 3:, j], abs=1e-4)


def test_reachable_poses_are_reached(name: str) -> None:
    arm = Arm(robot_named(name))
    positions, rotations = arm.poses(drawn_joints(arm, 100, seed=1))
    found = arm.solve(positions, rotations)
    assert found.found.mean() >= 0.8
    reached, turned = arm.poses(found.joints)
    assert np.linalg.norm(reached - positions, axis=1)[found.found].max() <= POSITION_TOLERANCE
    angle = np.arccos(np.clip((np.trace(turned @ rotations.transpose(0, 2, 1), axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angle[found.found].max() <= 1.1 * (ROTATION_TOLERANCE if arm.is_full else FEW_JOINTS_TOLERANCE)
    assert np.median(angle[found.found]) <= ROTATION_TOLERANCE
    assert (found.joints >= arm.low).all()
    assert (found.joints <= arm.high).all()


def test_a_pose_out_of_reach_is_not_called_found() -> None:
    arm = Arm(robot_named("simple"))
    assert not arm.solve(np.array([[3.0, 0.0, 0.2], [0.0, 0.0, -2.0]]), np.tile(np.eye(3), (2, 1, 1))).found.any()


def test_tracking_follows_a_small_move() -> None:
    arm = Arm(robot_named("simple"))
    position, rotation = (found[0] for found in arm.poses(arm.home[None]))
    joints = arm.track(position + MOVE, rotation, arm.home, iterations=10)
    reached, _ = arm.poses(joints[None])
    assert reached[0] == pytest.approx(position + MOVE, abs=5e-4)
    assert abs(joints - arm.home).max() < 0.2


def test_an_arm_with_few_joints_comes_to_the_place_and_turns_as_far_as_it_can() -> None:
    robot = ROBOTS["so101"]
    if not robot.is_there:
        pytest.skip("the files of so101 are not on this machine: stable-data robots --fetch so101")
    arm = Arm(robot)
    # Straight down, closing in a direction that the wrist gives, and tilted by 15 degrees to the side, which no joint gives.
    down = np.diag([1.0, -1.0, -1.0])
    c, s = np.cos(np.radians(15.0)), np.sin(np.radians(15.0))
    aside = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]) @ down
    places = np.array([[x, 0.0, 0.03] for x in (0.16, 0.2, 0.24, 0.28)])
    exact, near = (arm.solve(places, np.tile(turn, (len(places), 1, 1))) for turn in (down, aside))
    assert exact.found.all()
    assert exact.rotation_errors.max() <= 0.05
    assert near.found.all()
    assert near.position_errors.max() <= POSITION_TOLERANCE
    assert near.rotation_errors.max() <= np.radians(20.0)
