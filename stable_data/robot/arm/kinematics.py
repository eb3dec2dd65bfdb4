"""Kinematics of an arm, for many configurations at once: forward, Jacobian, inverse by damped least squares.

Frame of all poses: the robot's base. A pose is a position and a rotation matrix of the tool frame.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stable_data.robot.arm.robots import Robot, robot_spec
from stable_data.rotations import rotation_matrix, wxyz
from stable_data.scene import FloatArray

BoolArray: TypeAlias = npt.NDArray[np.bool_]

POSITION_TOLERANCE = 1e-3
"""Largest error of a solution, metres."""

ROTATION_TOLERANCE = 1e-2
"""Largest error of a solution, radians, for arms that can bring the tool to any pose."""

PLACING_TOLERANCE = 0.2
"""Largest error of the rotation with which an object is put down, radians."""

FEW_JOINTS_TOLERANCE = 0.5
"""Largest error of a solution, radians, for arms with fewer than six joints, which choose the nearest direction that they can.

Five joints bring the tool to a place exactly, but only to directions in the upright plane of the arm.
"""

_DAMPING = 0.03
_MAX_STEP = 0.35  # radians of a joint in one iteration
_ITERATIONS = 20  # with many joints more starts reach more poses than more iterations
_FEW_JOINTS_ITERATIONS = 60
_MARGIN = 0.02  # distance from the limits of the joints, radians
_FULL = 6  # joints
_TURN_WEIGHT = 0.005  # metres a radian; a direction that the arm cannot take then hardly moves the tool
_AT_REST = 1e-4  # a smaller step of the joints ends the search, radians
_STARTS = 8  # further starts for poses that the first one does not reach
_FEW_STARTS = 1  # the same for few joints, which find a pose from the first start or hardly ever


@dataclass(frozen=True, slots=True, eq=False)
class Solutions:
    """Configurations that bring the tool to poses.

    Attributes:
        joints: (K, J) float64, radians.
        position_errors: (K,) metres.
        rotation_errors: (K,) radians.
        rotation_tolerance: Largest error of a solution, radians.
    """

    joints: FloatArray
    position_errors: FloatArray
    rotation_errors: FloatArray
    rotation_tolerance: float = ROTATION_TOLERANCE

    @property
    def found(self) -> BoolArray:
        """Which poses are reached, (K,) bool."""
        return (self.position_errors <= POSITION_TOLERANCE) & (self.rotation_errors <= self.rotation_tolerance)

    @property
    def can_place(self) -> BoolArray:
        """Which poses are reached so exactly that an object can be put down there, (K,) bool."""
        return self.found & (self.rotation_errors <= PLACING_TOLERANCE)


class Arm:
    """The chain of joints from the base of a robot to its tool frame.

    Args:
        robot: The robot.

    Attributes:
        low: Lower limits of the joints, (J,) float64, radians, with a small margin.
        high: Upper limits.
        home: The joints at the start of an episode, (J,) float64.
        is_full: Whether it has enough joints to bring the tool to any pose.
    """

    def __init__(self, robot: Robot) -> None:
        spec = robot_spec(robot)
        site = spec.body(robot.hand.body).add_site(name="tool", pos=list(robot.hand.position), quat=wxyz(robot.hand.quat_xyzw))
        model = spec.compile()
        chain: list[int] = []
        body = int(model.site(site.name).bodyid[0])
        while body:
            chain.insert(0, body)
            body = int(model.body_parentid[body])
        number = {int(model.joint(name).id): k for k, name in enumerate(robot.joints)}
        count, fixed = len(number), np.eye(4)
        # Joint k turns a body by a frame that is links + sin(angle) sines + (1 - cos(angle)) cosines, each (J, 4, 4): Rodrigues' formula.
        self._links, self._sines, self._cosines = np.zeros((count, 4, 4)), np.zeros((count, 4, 4)), np.zeros((count, 4, 4))
        self._axes, self._anchors = np.zeros((count, 3)), np.ones((count, 4))
        for body in chain:
            fixed = fixed @ _frame(np.array(model.body_pos[body]), _matrix(model.body_quat[body]))
            joint = int(model.body_jntadr[body]) if model.body_jntnum[body] else -1
            if joint not in number:
                continue
            k, axis, anchor = number[joint], np.array(model.jnt_axis[joint]), np.array(model.jnt_pos[joint])
            cross = np.cross(axis, np.eye(3), axisb=0, axisc=0)
            self._links[k] = fixed
            for found, turn in ((self._sines, cross), (self._cosines, cross @ cross)):
                found[k, :3, :3], found[k, :3, 3] = turn, -turn @ anchor
                found[k] = fixed @ found[k]
            self._axes[k], self._anchors[k, :3] = axis, anchor
            fixed = np.eye(4)
        self._tool = fixed @ _frame(np.array(robot.hand.position), rotation_matrix(robot.hand.quat_xyzw))
        ranges = np.array([model.joint(name).range for name in robot.joints])
        self.low, self.high = ranges[:, 0] + _MARGIN, ranges[:, 1] - _MARGIN
        self.home = np.clip(np.array(robot.home), self.low, self.high)
        self.is_full = len(robot.joints) >= _FULL
        # With few joints the position comes first.
        self._weights = np.array([1.0] * 3 + [1.0 if self.is_full else _TURN_WEIGHT] * 3)

    def poses(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Computes the pose of the tool.

        Args:
            joints: (K, J) float64, radians.

        Returns:
            Positions (K, 3) and rotation matrices (K, 3, 3).
        """
        position, rotation, _, _ = self._forward(joints)
        return position, rotation

    def _forward(self, joints: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Pose of the tool, and axis and anchor of each joint, (K, J, 3)."""
        sin, cos = np.sin(joints)[:, :, None, None], np.cos(joints)[:, :, None, None]
        frames = self._links + sin * self._sines + (1 - cos) * self._cosines  # (K, J, 4, 4), then from the base
        for k in range(1, frames.shape[1]):
            frames[:, k] = frames[:, k - 1] @ frames[:, k]
        tool = frames[:, -1] @ self._tool
        axes = (frames[:, :, :3, :3] @ self._axes[:, :, None])[..., 0]  # a joint turns neither its axis nor its anchor
        anchors = (frames[:, :, :3] @ self._anchors[:, :, None])[..., 0]
        return tool[:, :3, 3], tool[:, :3, :3], axes, anchors

    def jacobian(self, joints: FloatArray) -> FloatArray:
        """Derivative of the tool's position and rotation by the joints, (K, 6, J): metres and radians a radian."""
        position, _, axes, anchors = self._forward(joints)
        return _jacobian(position, axes, anchors)

    def solve(
        self,
        positions: FloatArray,
        rotations: FloatArray,
        start: FloatArray | None = None,
        *,
        seed: int = 0,
        starts: int = _STARTS,
    ) -> Solutions:
        """Finds joints that bring the tool to poses.

        Args:
            positions: (K, 3) float64, metres.
            rotations: Rotation matrices, (K, 3, 3).
            start: Joints from which the search starts, (J,) or (K, J); None: the home position, turned towards each pose.
            seed: Seed of further starts.
            starts: How many further starts are tried for poses that are not reached.

        Returns:
            A solution for each pose; where none was found, the nearest one.
        """
        begin = self._facing(positions) if start is None else np.broadcast_to(start, (len(positions), len(self.low)))
        best = self._descend(positions, rotations, np.array(begin, np.float64))
        rng = np.random.default_rng(seed)
        for _ in range(starts if self.is_full else min(starts, _FEW_STARTS)):
            open_ = np.flatnonzero(~best.found)
            if not len(open_):
                break
            noise = rng.uniform(-0.9, 0.9, (len(open_), len(self.low)))
            again = np.clip(self._facing(positions[open_]) + noise, self.low, self.high)
            tried = self._descend(positions[open_], rotations[open_], again)
            nearer = tried.position_errors + 0.1 * tried.rotation_errors < (
                best.position_errors[open_] + 0.1 * best.rotation_errors[open_]
            )
            better = tried.found | nearer
            rows = open_[better]
            best.joints[rows] = tried.joints[better]
            best.position_errors[rows] = tried.position_errors[better]
            best.rotation_errors[rows] = tried.rotation_errors[better]
        return best

    def track(self, position: FloatArray, rotation: FloatArray, joints: FloatArray, *, iterations: int = 12) -> FloatArray:
        """Follows a pose that moves little: the joints (J,) nearest to the present ones that bring the tool there, or near it."""
        found = self._descend(position[None], rotation[None], joints[None].copy(), iterations)
        return np.asarray(found.joints[0])

    def _facing(self, positions: FloatArray) -> FloatArray:
        """The home position with the first joint turned towards each position, (K, J)."""
        joints = np.tile(self.home, (len(positions), 1))
        tool, _ = self.poses(self.home[None])
        joints[:, 0] += np.arctan2(positions[:, 1], positions[:, 0]) - np.arctan2(tool[0, 1], tool[0, 0])
        return np.asarray(np.clip(joints, self.low, self.high))

    def _descend(
        self, positions: FloatArray, rotations: FloatArray, joints: FloatArray, iterations: int | None = None
    ) -> Solutions:
        if iterations is None:
            iterations = _ITERATIONS if self.is_full else _FEW_JOINTS_ITERATIONS
        active = np.arange(len(joints))
        move, turn = np.full(len(joints), np.inf), np.full(len(joints), np.inf)
        for left in range(iterations, -1, -1):
            position, rotation, axes, anchors = self._forward(joints[active])
            away, twist = positions[active] - position, _rotation_vectors(rotations[active] @ rotation.transpose(0, 2, 1))
            move[active], turn[active] = np.linalg.norm(away, axis=1), np.linalg.norm(twist, axis=1)
            # Well within the tolerances, so that a solution is not at their edge.
            open_ = move[active] > 0.1 * POSITION_TOLERANCE
            if self.is_full:
                open_ |= turn[active] > 0.1 * ROTATION_TOLERANCE
            else:
                open_[:] = True  # the rotation comes as near as it can
            active = active[open_]
            if not len(active) or not left:
                break
            jacobian = _jacobian(position, axes, anchors)[open_] * self._weights[:, None]
            error = (np.concatenate([away, twist], axis=1) * self._weights)[open_]
            step = _step(jacobian, error)
            if not self.is_full:  # what a joint at its limit cannot do, the others may
                at_limit = (joints[active] + step < self.low) | (joints[active] + step > self.high)
                step = _step(jacobian * ~at_limit[:, None], error)
            moved = np.clip(joints[active] + step, self.low, self.high)
            if not self.is_full:
                still = abs(moved - joints[active]).max(axis=1) < _AT_REST
                moved, active = moved[~still], active[~still]
            joints[active] = moved
        return Solutions(joints, move, turn, ROTATION_TOLERANCE if self.is_full else FEW_JOINTS_TOLERANCE)


@lru_cache(maxsize=4)
def arm_of(robot: Robot) -> Arm:
    """Returns the kinematics of a robot, made once in a process.

    Raises:
        ConfigError: The files of the robot cannot be read (``robot_missing``).
    """
    return Arm(robot)


def _step(jacobian: FloatArray, error: FloatArray) -> FloatArray:
    """The damped step of the joints (K, J) against errors (K, 6)."""
    square = jacobian @ jacobian.transpose(0, 2, 1)
    damping = _DAMPING**2 * np.minimum(1.0, np.linalg.norm(error, axis=1) * 10)[:, None, None] * np.eye(6) + 1e-8 * np.eye(6)
    step = (jacobian.transpose(0, 2, 1) @ np.linalg.solve(square + damping, error[:, :, None]))[:, :, 0]
    return np.asarray(step * np.minimum(1.0, _MAX_STEP / np.maximum(abs(step).max(axis=1), 1e-9))[:, None])


def _jacobian(position: FloatArray, axes: FloatArray, anchors: FloatArray) -> FloatArray:
    return np.concatenate([_cross(axes, position[:, None] - anchors), axes], axis=2).transpose(0, 2, 1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """The cross product of the last axes, as ``np.cross``, which is slow for few vectors."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def _rotation_vectors(matrices: FloatArray) -> FloatArray:
    """The rotation vector of each matrix, (K, 3), radians."""
    twice = matrices[:, [2, 0, 1], [1, 2, 0]] - matrices[:, [1, 2, 0], [2, 0, 1]]  # 2 sin(angle) times the axis
    sin = np.linalg.norm(twice, axis=1)
    angle = np.arctan2(sin, np.trace(matrices, axis1=1, axis2=2) - 1)
    vectors = twice * np.where(sin > 1e-9, angle / np.maximum(sin, 1e-9), 0.5)[:, None]
    flat = np.flatnonzero((angle > 3.0) | (sin <= 1e-9))  # near half a turn the axis is not in the difference
    if len(flat):
        vectors[flat] = Rotation.from_matrix(matrices[flat]).as_rotvec()
    return vectors


def _frame(position: FloatArray, rotation: FloatArray) -> FloatArray:
    """A pose as a matrix, (4, 4)."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, position
    return frame


def _matrix(quat_wxyz: FloatArray) -> FloatArray:
    w, x, y, z = quat_wxyz.tolist()
    return rotation_matrix((x, y, z, w))
