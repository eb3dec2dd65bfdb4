"""What the numbers of an action mean: position control of the joints or of the tool, with the opening of the hand."""

from collections.abc import Mapping
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stable_data.errors import ConfigError
from stable_data.json_text import quote_value
from stable_data.robot.arm.kinematics import Arm
from stable_data.robot.arm.robots import Robot
from stable_data.scene import FloatArray

Control: TypeAlias = Literal["ee_delta", "ee", "joint_delta", "joint"]
"""What an action commands, beside the opening of the hand: a change of the tool's pose, the tool's pose, a change of the joints, the
joints. All are relative to, or replace, the last command, not the measured state.
"""

CONTROLS: Mapping[str, str] = {
    "ee_delta": "change of the tool's pose in the frame of the base: metres and rotation vector, radians",
    "ee": "pose of the tool in the frame of the base: metres, and the first two columns of its rotation matrix",
    "joint_delta": "change of the joints, radians",
    "joint": "joints, radians",
}
"""What an action means, for help texts."""

CONTROL_SECONDS = 0.05
"""Simulated time of one action: the time between two commands to the arm."""

COLUMNS = ("column_1_x", "column_1_y", "column_1_z", "column_2_x", "column_2_y", "column_2_z")
"""Names of the first two columns of a rotation matrix, which say all of a rotation without jumps."""

MAX_MOVE, MAX_TURN, MAX_JOINT = 0.05, 0.3, 0.15
"""Largest change in one action: metres, radians of the tool, radians of a joint."""

_LEASH = 0.12  # how far the commanded tool may be from the measured one, metres
_WORKSPACE = 1.2  # of positions in the frame of the base, metres


class Controller:
    """Turns actions into commanded joints, and back.

    Args:
        robot: The robot.
        arm: Its kinematics.
        control: What an action commands.

    Attributes:
        names: Names of the numbers of an action.
        low: Lower limits, (A,) float32.
        high: Upper limits.

    Raises:
        ConfigError: There is no such control (``setting_invalid``).
    """

    def __init__(self, robot: Robot, arm: Arm, control: str) -> None:
        if control not in get_args(Control):
            raise ConfigError(
                f"control is {quote_value(control)}, expected one of {', '.join(get_args(Control))}", "setting_invalid"
            )
        self.control, self._robot, self._arm = control, robot, arm
        tool = ["tool_x", "tool_y", "tool_z"]
        turns = ["turn_x", "turn_y", "turn_z"] if control == "ee_delta" else list(COLUMNS)
        moves = [*tool, *turns] if control.startswith("ee") else [*robot.joints]
        delta = "_delta" if control.endswith("_delta") else ""
        self.names = (*(f"{name}{delta}" for name in moves), "opening")
        limits = {
            "ee_delta": (np.array([-MAX_MOVE] * 3 + [-MAX_TURN] * 3), np.array([MAX_MOVE] * 3 + [MAX_TURN] * 3)),
            "ee": (np.array([-_WORKSPACE] * 3 + [-1.0] * 6), np.array([_WORKSPACE] * 3 + [1.0] * 6)),
            "joint_delta": (np.full(len(robot.joints), -MAX_JOINT), np.full(len(robot.joints), MAX_JOINT)),
            "joint": (arm.low, arm.high),
        }
        low, high = limits[control]
        self.low: npt.NDArray[np.float32] = np.append(low, 0.0).astype(np.float32)
        self.high: npt.NDArray[np.float32] = np.append(high, robot.hand.max_opening).astype(np.float32)
        self.reset(arm.home)

    def reset(self, joints: FloatArray) -> None:
        """Starts from commanded joints (J,)."""
        self._joints = np.array(joints, np.float64)
        position, rotation = self._arm.poses(self._joints[None])
        self._position, self._rotation = position[0], rotation[0]

    def command(self, action: npt.ArrayLike, measured: FloatArray) -> tuple[FloatArray, float]:
        """Returns the joints, (J,), and the opening of the hand, metres, that an action commands.

        Args:
            action: (A,), clipped to the limits.
            measured: The joints as they are, (J,). The command does not run away from them.

        Raises:
            ValueError: The action has another shape, or is not finite.
        """
        values = np.asarray(action, np.float64)
        if values.shape != self.low.shape or not np.isfinite(values).all():
            raise ValueError(f"action is {values.tolist()}, expected {len(self.low)} finite numbers: {', '.join(self.names)}")
        values = np.clip(values, self.low, self.high)
        moves, opening = values[:-1], float(values[-1])
        if self.control == "joint":
            self._follow_joints(np.clip(moves, self._joints - 2 * MAX_JOINT, self._joints + 2 * MAX_JOINT))
        elif self.control == "joint_delta":
            self._follow_joints(self._joints + moves)
        elif self.control == "ee_delta":
            turn = Rotation.from_rotvec(moves[3:]).as_matrix()
            self._follow_tool(self._position + moves[:3], turn @ self._rotation, measured)
        else:
            self._follow_tool(moves[:3], _from_columns(moves[3:]), measured)
        return self._joints.copy(), opening

    def action_for(self, joints: FloatArray, opening: float) -> npt.NDArray[np.float32]:
        """Returns the action, (A,) float32, that commands joints (J,), or comes as near as one action can."""
        if self.control == "joint":
            moves = joints
        elif self.control == "joint_delta":
            moves = joints - self._joints
        else:
            position, rotation = (found[0] for found in self._arm.poses(joints[None]))
            if self.control == "ee":
                moves = np.concatenate([position, rotation[:, 0], rotation[:, 1]])
            else:
                turn = Rotation.from_matrix(rotation @ self._rotation.T).as_rotvec()
                moves = np.concatenate([position - self._position, turn])
        clipped: npt.NDArray[np.float32] = np.clip(np.append(moves, opening), self.low, self.high).astype(np.float32)
        return clipped

    def _follow_joints(self, joints: FloatArray) -> None:
        self._joints = np.clip(joints, self._arm.low, self._arm.high)
        position, rotation = self._arm.poses(self._joints[None])
        self._position, self._rotation = position[0], rotation[0]

    def _follow_tool(self, position: FloatArray, rotation: FloatArray, measured: FloatArray) -> None:
        """Commands the joints nearest to the last ones that bring the tool to a pose, or near it."""
        here, _ = self._arm.poses(measured[None])
        away = position - here[0]
        length = float(np.linalg.norm(away))
        if length > _LEASH:
            position = here[0] + away * (_LEASH / length)
        joints = self._arm.track(position, rotation, self._joints)
        joints = np.clip(joints, self._joints - 2 * MAX_JOINT, self._joints + 2 * MAX_JOINT)
        self._follow_joints(joints)


def _from_columns(columns: FloatArray) -> FloatArray:
    """The rotation matrix whose first two columns are nearest to given ones: Gram and Schmidt's process."""
    length = float(np.linalg.norm(columns[:3]))
    first = columns[:3] / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    second = columns[3:] - (columns[3:] @ first) * first
    length = float(np.linalg.norm(second))
    if length < 1e-6:  # parallel columns say nothing about the second one
        second = np.cross(first, [1.0, 0.0, 0.0] if abs(first[0]) < 0.9 else [0.0, 1.0, 0.0])
        length = float(np.linalg.norm(second))
    second = second / length
    return np.stack([first, second, np.cross(first, second)], axis=1)
