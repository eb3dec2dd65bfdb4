"""What the network sees of a state, and how it says an action: everything relative to the tool, in a frame that looks at the subject.

The task frame has the origin and the z axis of the robot's base, and its x axis points towards the subject of the step, or towards
the tool if there is no subject. A scene that is turned about the base gives the same numbers, so that one demonstration counts for
all directions. Boxes are described by ``R diag(size) R^T``, which is the same for all turns that map a box to itself.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.errors import ConfigError
from stable_data.json_text import quote_value
from stable_data.robot.arm.control import COLUMNS
from stable_data.robot.episodes import EpisodeFeatures, FloatArray32
from stable_data.robot.observation import ENVIRONMENT_STATE_NAMES, GOAL_PART, POINTS, POINTS_PART, SLOT_SIZE, SLOTS
from stable_data.scene import FloatArray

CONTROL = "ee_delta"
"""The control of episodes that a policy can clone."""

NUM_ACTIONS = 7
"""Numbers of an action: three of the tool's move, three of its turn, and the opening of the hand."""

_MOVES = ("tool_x_delta", "tool_y_delta", "tool_z_delta", "turn_x_delta", "turn_y_delta", "turn_z_delta")
_POSE = ("opening", "tool_x", "tool_y", "tool_z", *COLUMNS)  # the end of a state of the robot, of whatever joints
_NEAR, _FINE = 0.05, 0.01  # distances below this are seen finely, metres
_FINE_TURN = 0.1  # radians
_SIDES = np.triu_indices(3)
_LENGTH = 10.0  # extents and distances are small numbers of metres


def check_clonable(features: EpisodeFeatures, cameras: Sequence[str] = ()) -> None:
    """Refuses episodes whose states or actions the network does not know, or that lack pictures.

    Args:
        features: The features of the episodes.
        cameras: Cameras whose pictures the network needs.

    Raises:
        ConfigError: The control or the names differ from what is expected, or a camera is missing (``policy_features``).
    """
    if missing := sorted(set(cameras) - set(features.cameras)):
        raise ConfigError(
            f"cameras is {quote_value(list(features.cameras))}, expected {', '.join(missing)} too; record the episodes with "
            f"--set 'cameras={json.dumps(list(cameras))}'",
            "policy_features",
        )
    wanted = {
        "control": (features.control, CONTROL),
        "action_names": (features.action_names, (*_MOVES, "opening")),
        "environment_state_names": (features.environment_state_names, ENVIRONMENT_STATE_NAMES),
        "the end of state_names": (features.state_names[-len(_POSE) :], _POSE),
    }
    for name, (found, expected) in wanted.items():
        if found != expected:
            raise ConfigError(
                f"{name} is {quote_value(_plain(found))[:200]}, expected {quote_value(_plain(expected))[:200]}; record the episodes "
                f"with --set control={CONTROL}, and anew if an older version recorded them",
                "policy_features",
            )


def _plain(value: str | Sequence[str]) -> object:
    return value if isinstance(value, str) else list(value)


class TaskFrame:
    """The task frames of some states.

    Args:
        states: States of the robot, (B, S) float32.
        environment_states: States of the environment, (B, E) float32.
        sees_objects: Whether the states of the objects are seen; without them there is no subject.

    Attributes:
        has_subject: Whether there is an object to act on, (B,) bool.
    """

    def __init__(self, states: FloatArray32, environment_states: FloatArray32, *, sees_objects: bool = True) -> None:
        self._states, self._environment = np.asarray(states, np.float64), np.asarray(environment_states, np.float64)
        if not sees_objects:
            self._environment = np.zeros_like(self._environment)
        self._tool, columns = self._states[:, -9:-6], self._states[:, -6:]
        self._rotation = _rotations(columns)  # (B, 3, 3), base from tool
        self.has_subject = self._environment[:, 0] > 0.5
        ahead = np.where(self.has_subject[:, None], self._environment[:, 1:3], self._tool[:, :2])
        angle = np.arctan2(ahead[:, 1], ahead[:, 0])
        cosine, sine, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
        turn = [[cosine, sine, zero], [-sine, cosine, zero], [zero, zero, one]]
        self._turn: FloatArray = np.moveaxis(np.array(turn), 2, 0)  # (B, 3, 3), task frame from base

    def inputs(self, memory: FloatArray32) -> FloatArray32:
        """What the network sees, (B, :data:`NUM_INPUTS`) float32.

        Args:
            memory: What is remembered of the hand, (B, 2), see :class:`models.policy.keyframes.HandMemory`.
        """
        tool, rotation = self._turned(self._tool), self._turn @ self._rotation
        subject = self._slot(0)
        offset = self._turned(subject.position - self._tool) * subject.present
        in_tool = np.einsum("bji,bj->bi", rotation, offset)
        extents = self._turn @ subject.extents @ self._turn.transpose(0, 2, 1)
        extents_in_tool = rotation.transpose(0, 2, 1) @ extents @ rotation
        height = np.sqrt((extents[:, 2] ** 2).sum(axis=1, keepdims=True))
        top = (offset[:, 2:] + height / 2) * subject.present
        where = self._turned(subject.position) * subject.present
        parts = [
            subject.present,
            tool * 2,
            rotation[:, :, 0],
            rotation[:, :, 1],
            self._states[:, -10:-9] * _LENGTH,
            offset * 2,
            np.tanh(offset / _NEAR),
            in_tool * 2,
            np.tanh(in_tool / _NEAR),
            np.tanh(top / _NEAR),
            where[:, ::2] * 2,
            subject.size * _LENGTH,
            extents[:, *_SIDES] * _LENGTH,
            extents_in_tool[:, *_SIDES] * _LENGTH,
        ]
        for k in range(1, SLOTS):
            other = self._slot(k)
            away = self._turned(other.position - subject.position) * other.present
            sides = (self._turn @ other.extents @ self._turn.transpose(0, 2, 1))[:, *_SIDES]
            parts += [other.present, np.tanh(2 * away), np.tanh(away / (2 * _NEAR)), sides * _LENGTH]
        parts.append(np.asarray(memory, np.float64))
        goal = self._environment[:, GOAL_PART]
        to_goal = self._turned(goal[:, 1:] - self._tool) * goal[:, :1]
        parts += [goal[:, :1], to_goal * 2, np.tanh(to_goal / _NEAR)]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def points(self) -> FloatArray32:
        """What the network sees of the surface of the subject, (B, P, :data:`NUM_POINT_INPUTS`) float32; 0 without a subject.

        The first three numbers of a point are its place relative to the centre of the subject, metres, task frame.
        """
        found = self._environment[:, POINTS_PART].reshape(-1, POINTS, 3)
        rotation = self._turn @ self._rotation
        away = np.einsum("bij,bpj->bpi", self._turn, found - self._environment[:, None, 1:4])
        to_tool = np.einsum("bij,bpj->bpi", self._turn, found - self._tool[:, None])
        in_tool = np.einsum("bji,bpj->bpi", rotation, to_tool)
        parts = [away, np.tanh(away / _NEAR), to_tool * 2, np.tanh(to_tool / _NEAR), np.tanh(in_tool / _NEAR)]
        return (np.concatenate(parts, axis=2) * self.has_subject[:, None, None]).astype(np.float32)

    def keys(self, positions: FloatArray, rotations: FloatArray, openings: FloatArray32) -> FloatArray32:
        """Describes poses of the tool in the task frame: relative to the subject, or to the tool if there is none.

        Args:
            positions: (B, 3), metres, frame of the base.
            rotations: (B, 3, 3), base from tool.
            openings: Of the hand on the way there, (B,), metres.

        Returns:
            (B, :data:`NUM_KEY`) float32: position, the first two columns of the rotation, and the opening.
        """
        turned = self._turn @ rotations
        away = self._turned(positions - self._anchor())
        parts: list[FloatArray] = [away, turned[:, :, 0], turned[:, :, 1], np.asarray(openings, np.float64)[:, None]]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def key_inputs(self, keys: FloatArray32) -> FloatArray32:
        """What the network sees of the pose that the tool shall reach, (B, :data:`NUM_KEY_INPUTS`) float32.

        Args:
            keys: As :meth:`keys` gives them; the columns need not be orthonormal.
        """
        found = np.asarray(keys, np.float64)
        rotation, wanted = self._turn @ self._rotation, _orthonormal(found[:, 3:9])
        away = self._turned(self._anchor() - self._tool) + found[:, :3]
        in_tool = np.einsum("bji,bj->bi", rotation, away)
        turn = Rotation.from_matrix(wanted @ rotation.transpose(0, 2, 1)).as_rotvec()
        turn_in_tool = np.einsum("bji,bj->bi", rotation, turn)
        fine = [np.tanh(values / scale) for values in (away, in_tool) for scale in (_NEAR, _FINE)]
        turns = [turn, turn_in_tool, np.tanh(turn / _FINE_TURN)]
        return np.concatenate(
            [away * 2, *fine, *turns, found[:, :3] * 5, wanted[:, :, 2], found[:, 9:] * _LENGTH], axis=1
        ).astype(np.float32)

    def _anchor(self) -> FloatArray:
        return np.where(self.has_subject[:, None], self._environment[:, 1:4], self._tool)

    def from_actions(self, actions: FloatArray32) -> FloatArray32:
        """Turns actions in the frame of the base, (B, H, 7), into the task frame."""
        return self._turned_actions(actions, self._turn)

    @property
    def tool_poses(self) -> tuple[FloatArray, FloatArray]:
        """Position (B, 3), metres, and rotation (B, 3, 3) of the tool in the frame of the base."""
        return self._tool, self._rotation

    def to_actions(self, actions: FloatArray32) -> FloatArray32:
        """Turns actions in the task frame, (B, H, 7), into the frame of the base."""
        return self._turned_actions(actions, self._turn.transpose(0, 2, 1))

    def _turned(self, vectors: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("bij,bj->bi", self._turn, vectors))

    def _turned_actions(self, actions: FloatArray32, turn: FloatArray) -> FloatArray32:
        found = np.array(actions, np.float64)
        for part in (slice(0, 3), slice(3, 6)):
            found[..., part] = np.einsum("bij,bhj->bhi", turn, found[..., part])
        return found.astype(np.float32)

    def _slot(self, number: int) -> "_Box":
        values = self._environment[:, number * SLOT_SIZE : (number + 1) * SLOT_SIZE]
        rotation, size = _rotations(values[:, 4:10]), values[:, 10:13]
        extents = np.einsum("bij,bj,bkj->bik", rotation, size, rotation)
        return _Box(values[:, :1], values[:, 1:4], size, extents)


@dataclass(frozen=True, slots=True, eq=False)
class _Box:
    """One of the objects that the states show.

    Attributes:
        present: 1 if there is one, else 0, (B, 1).
        position: Of its centre, (B, 3), metres, frame of the base.
        size: In its own frame, (B, 3), metres.
        extents: ``R diag(size) R^T``, (B, 3, 3), metres, frame of the base.
    """

    present: FloatArray
    position: FloatArray
    size: FloatArray
    extents: FloatArray


def _rotations(columns: FloatArray) -> FloatArray:
    """Rotation matrices (B, 3, 3) of their first two columns (B, 6)."""
    first, second = columns[:, :3], columns[:, 3:]
    return np.stack([first, second, np.cross(first, second)], axis=2)


def _orthonormal(columns: FloatArray) -> FloatArray:
    """The rotations (B, 3, 3) whose first two columns are nearest to given ones (B, 6): Gram and Schmidt's process."""
    first = columns[:, :3] / np.linalg.norm(columns[:, :3], axis=1, keepdims=True).clip(1e-6)
    second = columns[:, 3:] - (columns[:, 3:] * first).sum(axis=1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=1, keepdims=True).clip(1e-6)
    return _rotations(np.concatenate([first, second], axis=1))


_EMPTY = TaskFrame(*(np.zeros((1, len(names)), np.float32) for names in (_POSE, ENVIRONMENT_STATE_NAMES)))
NUM_INPUTS = _EMPTY.inputs(np.zeros((1, 2), np.float32)).shape[1]
"""Numbers that the network sees of a state."""

NUM_POINT_INPUTS = _EMPTY.points().shape[2]
"""Numbers that the network sees of a point of the subject."""

NUM_KEY = 10
"""Numbers of a pose of the tool with the opening of the hand."""

NUM_KEY_INPUTS = 31
"""Numbers that the network sees of the pose that the tool shall reach."""
