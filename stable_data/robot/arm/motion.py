"""Paths of an arm between configurations that touch nothing, and how fast they are followed."""

import itertools
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from stable_data.robot.arm.clearance import Clearance
from stable_data.robot.arm.kinematics import Arm
from stable_data.scene import FloatArray

_Test: TypeAlias = Callable[[FloatArray], bool]

STEP = 0.05
"""Largest change of a joint between two checked configurations of a path, radians."""

_TREE_STEP = 0.25  # radians
_NEAR_GOAL = 0.15  # share of samples that are the other tree's root
_SHORTCUTS = 60


def joint_line(start: FloatArray, goal: FloatArray) -> FloatArray:
    """Configurations on the straight line between two, (T, J), both ends included."""
    count = max(1, int(np.ceil(abs(goal - start).max() / STEP)))
    return np.asarray(start + (goal - start) * np.linspace(0.0, 1.0, count + 1)[:, None])


def tool_line(
    arm: Arm, start: FloatArray, position: FloatArray, rotation: FloatArray, *, spacing: float = 0.01, may_turn: bool = False
) -> FloatArray | None:
    """Configurations that move the tool on a straight line to a pose, (T, J); None if the arm cannot follow it.

    Args:
        arm: The arm.
        start: The first configuration, (J,).
        position: Of the tool at the end, (3,), metres, frame of the base.
        rotation: (3, 3); the tool has it along the whole line.
        spacing: Distance between the configurations, metres.
        may_turn: Whether the tool may turn on the way as far as an arm with few joints has to.
    """
    begin, _ = arm.poses(start[None])
    count = max(1, int(np.ceil(np.linalg.norm(position - begin[0]) / spacing)))
    path, joints = [start], start
    for share in np.linspace(0.0, 1.0, count + 1)[1:]:
        found = arm.solve((begin[0] + share * (position - begin[0]))[None], rotation[None], joints, starts=0)
        if not found.found[0] or abs(found.joints[0] - joints).max() > 0.5:
            return None
        joints = found.joints[0]
        path.append(joints)
        if may_turn:
            rotation = arm.poses(joints[None])[1][0]
    return np.array(path)


def plan_path(
    arm: Arm,
    clearance: Clearance,
    start: FloatArray,
    goal: FloatArray,
    opening: float,
    *,
    allowed: frozenset[str] = frozenset(),
    seed: int = 0,
    most_nodes: int = 2000,
) -> FloatArray | None:
    """Plans a path that touches nothing: the straight line if it is free, else by two trees that grow towards each other.

    The trees are those of RRT-Connect (Kuffner and LaValle, 2000); the path is then shortened.

    Args:
        arm: The arm.
        clearance: Checks configurations.
        start: (J,) radians.
        goal: (J,) radians.
        opening: Distance between the fingers, metres.
        allowed: What may be touched all along.
        seed: Seed of the samples.
        most_nodes: Size of the trees at which it gives up.

    Returns:
        Configurations (T, J), at most STEP apart, both ends included; None if no path was found.
    """

    def is_free(joints: FloatArray) -> bool:
        return clearance.hits(joints, opening, allowed=allowed) is None

    if not is_free(goal) or not is_free(start):
        return None
    line = joint_line(start, goal)
    if all(is_free(q) for q in line):
        return line
    rng = np.random.default_rng(seed)
    low, high = np.minimum(start, goal) - 1.2, np.maximum(start, goal) + 1.2
    low, high = np.maximum(low, arm.low), np.minimum(high, arm.high)
    one, other = _Tree(start), _Tree(goal)
    for turn in range(most_nodes):
        target = other.nodes[0] if rng.random() < _NEAR_GOAL else rng.uniform(low, high)
        new = one.grow(target, is_free)
        if new is not None:
            met = other.connect(one.nodes[new], is_free)
            if met is not None:
                path = one.back_from(new)[::-1] + other.back_from(met)
                path = path if turn % 2 == 0 else path[::-1]
                return _dense(_shortened(np.array(path), is_free, rng))
        if len(one.nodes) + len(other.nodes) > most_nodes:
            return None
        one, other = other, one
    return None


class _Tree:
    def __init__(self, root: FloatArray) -> None:
        self.nodes: list[FloatArray] = [root]
        self.parents: list[int] = [-1]

    def grow(self, target: FloatArray, is_free: _Test) -> int | None:
        """Adds a node one step towards a target; None if the step is not free."""
        away = np.array(self.nodes) - target
        near = int(np.argmin((away**2).sum(axis=1)))
        return self._step(near, target, is_free)

    def connect(self, target: FloatArray, is_free: _Test) -> int | None:
        """Goes towards a target until it is reached, its node, or something is in the way, None."""
        near = int(np.argmin(((np.array(self.nodes) - target) ** 2).sum(axis=1)))
        while True:
            new = self._step(near, target, is_free)
            if new is None:
                return None
            if abs(self.nodes[new] - target).max() < 1e-9:
                return new
            near = new

    def _step(self, near: int, target: FloatArray, is_free: _Test) -> int | None:
        start = self.nodes[near]
        length = abs(target - start).max()
        if length < 1e-9:
            return near
        end = start + (target - start) * min(1.0, _TREE_STEP / length)
        if not all(is_free(q) for q in joint_line(start, end)[1:]):
            return None
        self.nodes.append(end)
        self.parents.append(near)
        return len(self.nodes) - 1

    def back_from(self, node: int) -> list[FloatArray]:
        """The nodes from one to the root."""
        found = []
        while node >= 0:
            found.append(self.nodes[node])
            node = self.parents[node]
        return found


def _shortened(path: FloatArray, is_free: _Test, rng: np.random.Generator) -> FloatArray:
    """Replaces parts of a path by straight lines where these are free."""
    for _ in range(_SHORTCUTS):
        if len(path) < 3:
            break
        a, b = sorted(rng.choice(len(path), 2, replace=False).tolist())
        if b - a < 2:
            continue
        if all(is_free(q) for q in joint_line(path[a], path[b])[1:-1]):
            path = np.concatenate([path[: a + 1], path[b:]])
    return path


def _dense(path: FloatArray) -> FloatArray:
    parts = [joint_line(a, b)[1:] for a, b in itertools.pairwise(path)]
    return np.concatenate([path[:1], *parts])


def timed(path: FloatArray, speed: float, step_seconds: float, *, acceleration: float = 4.0) -> FloatArray:
    """Samples a path at equal times, starting and ending at rest.

    Args:
        path: Configurations (T, J).
        speed: Largest speed of a joint, radians a second.
        step_seconds: Time between samples.
        acceleration: Largest acceleration along the path, radians a second².

    Returns:
        Configurations (S, J), the first sample one step after the start, the last one the end of the path.
    """
    lengths = np.concatenate([[0.0], np.cumsum(abs(np.diff(path, axis=0)).max(axis=1))])
    total = lengths[-1]
    if total < 1e-9:
        return path[-1:]
    ramp = min(speed / acceleration, np.sqrt(total / acceleration))
    top = acceleration * ramp
    duration = total / top + ramp
    times = np.arange(1, int(np.ceil(duration / step_seconds)) + 1) * step_seconds
    times = np.minimum(times, duration)
    rising, falling = times < ramp, times > duration - ramp
    way = np.where(rising, acceleration * times**2 / 2, top * (times - ramp / 2))
    way = np.where(falling, total - acceleration * (duration - times) ** 2 / 2, way)
    return np.stack([np.interp(way, lengths, path[:, j]) for j in range(path.shape[1])], axis=1)
