"""What a policy observes of a scene with a robot: the state of the robot, and the state of the objects that matter, in fixed sizes.

All positions and rotations are in the frame of the robot's base, so that a policy need not know where the robot stands.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from stable_data.robot.arm.assembly import SURFACE_POINTS, RobotModel
from stable_data.robot.arm.control import COLUMNS
from stable_data.robot.arm.world import RobotWorld
from stable_data.rotations import rotation_matrix
from stable_data.scene import FloatArray

SLOTS = 4
"""Objects of which the state of the environment tells: of the current step of the task the subject and its target, then those nearest
to the subject.
"""

_SLOT = ("present", "x", "y", "z", *COLUMNS, "width", "depth", "height")
SLOT_SIZE = len(_SLOT)
"""Numbers of one object: whether there is one, the centre of its box, the first two columns of its rotation, and its box."""

GOAL_NAMES = ("goal_present", "goal_x", "goal_y", "goal_z")
"""Where the subject is to be put, if the step puts it anywhere."""

POINTS = SURFACE_POINTS
"""Points of the surface of the subject that the state of the environment tells."""

_POINT_NAMES = tuple(f"point_{k}_{axis}" for k in range(POINTS) for axis in "xyz")
_SLOTS_END = SLOTS * SLOT_SIZE
GOAL_PART = slice(_SLOTS_END, _SLOTS_END + len(GOAL_NAMES))
"""Where the goal is in a state of the environment."""

POINTS_PART = slice(GOAL_PART.stop, GOAL_PART.stop + len(_POINT_NAMES))
"""Where the points are in a state of the environment."""

ENVIRONMENT_STATE_NAMES = (
    *(f"object_{k}_{name}" for k in range(SLOTS) for name in _SLOT),
    *GOAL_NAMES,
    *_POINT_NAMES,
)
"""Names of the numbers of a state of the environment."""

FAR = 10.0
"""Positions are clipped to this, metres: an object that fell off the table falls without end."""


def state_names(built: RobotModel) -> tuple[str, ...]:
    """Returns the names of the numbers of a state of the robot."""
    return (*built.robot.joints, "opening", "tool_x", "tool_y", "tool_z", *COLUMNS)


def robot_state(world: RobotWorld) -> npt.NDArray[np.float32]:
    """Returns the state of the robot, (S,) float32: joints (radians), opening and position of the tool (metres), and its rotation."""
    position, rotation = world.built.tool_pose(world.data)
    state = np.concatenate([world.joints, [world.opening], position, rotation[:, 0], rotation[:, 1]])
    return np.asarray(np.clip(state, -FAR, FAR), np.float32)


def environment_state(
    world: RobotWorld, subject: str | None, target: str | None, goal: FloatArray | None
) -> npt.NDArray[np.float32]:
    """Returns the state of the environment, (E,) float32.

    Args:
        world: The simulation.
        subject: The object that is acted on now; None: nothing is left to do.
        target: The object to which it is related, if any.
        goal: Where it is to be put, (3,), metres, frame of the scene; None: nowhere.
    """
    built, poses = world.built, world.object_poses
    state = np.zeros(len(ENVIRONMENT_STATE_NAMES), np.float64)
    for k, index in enumerate(_shown(built.names, poses, subject, target)):
        x, y, z, w = poses[index, 3:].tolist()
        rotation = built.mount.rotation.T @ rotation_matrix((x, y, z, w))
        position = np.clip(built.mount.to_base(poses[index, :3]), -FAR, FAR)
        size = built.geometry.shapes[index].size
        state[k * SLOT_SIZE : (k + 1) * SLOT_SIZE] = np.concatenate([[1.0], position, rotation[:, 0], rotation[:, 1], size])
    if goal is not None:
        state[GOAL_PART] = [1.0, *built.mount.to_base(goal)]
    if subject in built.names:
        index = built.names.index(subject)
        x, y, z, w = poses[index, 3:].tolist()
        points = poses[index, :3] + built.surface(index) @ rotation_matrix((x, y, z, w)).T
        state[POINTS_PART] = built.mount.to_base(points).ravel()
    return np.asarray(np.clip(state, -FAR, FAR), np.float32)


def _shown(names: Sequence[str], poses: FloatArray, subject: str | None, target: str | None) -> list[int]:
    """Numbers of the objects that the slots show; -1 never occurs, and slots may stay empty."""
    first = [names.index(name) for name in (subject, target) if name in names]
    if not first:
        return []
    distance = np.linalg.norm(poses[:, :3] - poses[first[0], :3], axis=1)
    near = [int(k) for k in np.argsort(distance, kind="stable") if int(k) not in first]
    if len(first) == 1:  # the second slot is the target's, and stays empty without one
        return [first[0], *near[: SLOTS - 1]]
    return [*first, *near[: SLOTS - 2]]
