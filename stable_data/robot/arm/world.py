"""A simulated robot at a table: commands, and what is where, touches what, and is held."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stable_data.robot.arm.assembly import RobotModel
from stable_data.robot.arm.robots import control_of, opening_of
from stable_data.scene import TABLE, FloatArray
from stable_data.simulation.mujoco_import import mujoco, without_log_file
from stable_data.simulation.settling import has_exploded

UPWARD = 0.1
"""A contact supports the upper body if the vertical part of its unit normal is larger than this."""

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_SLEEP_SPEED = 1e-4  # objects slower than this are not simulated until something touches them, metres a second


@dataclass(frozen=True, slots=True)
class WorldContacts:
    """What touches what.

    Attributes:
        supports: Instance -> what carries it, instances or ``table``: contacts with an upward normal.
        gripped: Objects in contact with both fingers.
        held: Those of them that touch nothing but the robot.
        hit: Whatever the robot touches, ``table`` included.
    """

    supports: Mapping[str, tuple[str, ...]]
    gripped: frozenset[str]
    held: frozenset[str]
    hit: frozenset[str]


class RobotWorld:
    """The simulation of a scene with a robot.

    Args:
        model: The scene with the robot.

    Attributes:
        built: The scene with the robot.
        model: Its MuJoCo model.
        data: The state of the simulation.
    """

    def __init__(self, model: RobotModel) -> None:
        self.built, self.model = model, model.model
        self.data, self._probe = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self.model.opt.sleep_tolerance = _SLEEP_SPEED
        self._names = {int(body): name for body, name in zip(model.object_bodies, model.names, strict=True)}
        self._fingers = model.finger_bodies
        self.reset()

    def reset(self, joints: FloatArray | None = None) -> None:
        """Puts every object at its pose in the scene, and the arm at its home position or at given joints (J,), with an open hand."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.built.start_qpos
        self.place_arm(np.array(self.built.robot.home) if joints is None else joints)

    def place_arm(self, joints: FloatArray, opening: float | None = None) -> None:
        """Puts the arm at joints (J,) without moving it there; the hand is opened to ``opening``, metres, or fully."""
        built, hand = self.built, self.built.robot.hand
        self.data.qpos[built.joint_addresses] = joints
        self.data.qvel[built.speed_addresses] = 0.0
        self.data.qpos[built.hand_addresses] = built.start_qpos[built.hand_addresses]
        self.data.ctrl[built.hand_control] = control_of(hand, hand.max_opening if opening is None else opening)
        self.data.ctrl[built.controls] = joints
        mujoco.mj_forward(self.model, self.data)

    def advance(self, joints: FloatArray, opening: float, seconds: float) -> None:
        """Simulates; the commands move evenly from the last command to the new one.

        Args:
            joints: Commanded joints at the end, (J,), radians.
            opening: Commanded distance between the fingers, metres.
            seconds: How long.
        """
        steps = max(1, round(seconds / self.model.opt.timestep))
        before = np.array(self.data.ctrl[self.built.controls])
        hand, was = self.built.hand_control, float(self.data.ctrl[self.built.hand_control])
        wanted = control_of(self.built.robot.hand, opening)
        flags = self.model.opt.enableflags
        self.model.opt.enableflags = flags | mujoco.mjtEnableBit.mjENBL_SLEEP
        with without_log_file():
            for k in range(1, steps + 1):
                self.data.ctrl[self.built.controls] = before + (k / steps) * (joints - before)
                self.data.ctrl[hand] = was + (k / steps) * (wanted - was)
                mujoco.mj_step(self.model, self.data)
            mujoco.mj_kinematics(self.model, self.data)  # mj_step leaves the poses as they were before its last step
        self.model.opt.enableflags = flags

    @property
    def has_diverged(self) -> bool:
        """Whether the simulation has no meaning any more."""
        return bool(has_exploded(self.data) or not np.isfinite(self.data.qpos).all())

    @property
    def joints(self) -> FloatArray:
        """Positions of the arm's joints, (J,) float64, radians."""
        return np.array(self.data.qpos[self.built.joint_addresses])

    @property
    def commanded_joints(self) -> FloatArray:
        """The joints that were commanded last, (J,)."""
        return np.array(self.data.ctrl[self.built.controls])

    @property
    def opening(self) -> float:
        """Distance between the fingers, metres."""
        return float(opening_of(self.built.robot.hand, float(self.data.qpos[self.built.opening_address])))

    @property
    def object_poses(self) -> FloatArray:
        """Position (metres, scene frame) and quaternion (xyzw) of every object, (N, 7)."""
        return self.built.object_poses(self.data)

    @property
    def object_speeds(self) -> FloatArray:
        """Speed of every object, (N,), metres a second; 0 for fixed ones."""
        speeds = np.zeros(len(self.built.names))
        for k, name in enumerate(self.built.names):
            if name in self.built.free_addresses:
                start = self.built.free_addresses[name][1]
                speeds[k] = np.linalg.norm(self.data.qvel[start : start + 3])
        return speeds

    @property
    def tool_position(self) -> FloatArray:
        """Origin of the tool frame, (3,), metres, frame of the scene."""
        return np.array(self.data.site_xpos[self.built.tool])

    def contacts(self) -> WorldContacts:
        """What touches what now."""
        model, probe = self.model, self._probe
        # Sleeping objects have no contacts in the simulation itself.
        probe.qpos[:] = self.data.qpos
        mujoco.mj_kinematics(model, probe)
        mujoco.mj_collision(model, probe)
        if not probe.ncon:
            return WorldContacts({}, frozenset(), frozenset(), frozenset())
        touching = probe.contact.dist <= 0.0
        bodies = model.geom_bodyid[probe.contact.geom][touching]  # (C, 2)
        normals = probe.contact.frame[touching, 2]  # the z of the normal, which points from the first geom to the second
        # A pair of bodies touches at many points: of each pair only whether one carries the other is of interest.
        sides = np.where(normals > UPWARD, 1, np.where(normals < -UPWARD, -1, 0))
        rows = np.unique(np.column_stack([bodies, sides]), axis=0).tolist()
        supports: dict[str, list[str]] = {}
        gripped: tuple[set[str], set[str]] = (set(), set())
        touched: set[str] = set()
        hit: set[str] = set()
        is_robot = self.built.robot_bodies
        for one, other, side in rows:
            if is_robot[one] and is_robot[other]:
                continue
            if is_robot[one] or is_robot[other]:
                robot_body, body = (one, other) if is_robot[one] else (other, one)
                name = self._names.get(body, TABLE)
                hit.add(name)
                for found, fingers in zip(gripped, self._fingers, strict=True):
                    if robot_body in fingers:
                        found.add(name)
                continue
            touched |= {self._names.get(one, TABLE), self._names.get(other, TABLE)}
            below, above = (one, other) if side > 0 else (other, one)
            if side and above in self._names:
                supporter, carried = self._names.get(below, TABLE), supports.setdefault(self._names[above], [])
                if supporter not in carried:
                    carried.append(supporter)
        both = frozenset(gripped[0] & gripped[1]) - {TABLE}
        return WorldContacts(
            {name: tuple(found) for name, found in supports.items()}, both, frozenset(both - touched), frozenset(hit)
        )

    def snapshot(self) -> FloatArray:
        """The state of the simulation, for :meth:`restore`."""
        state = np.zeros(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        return state

    def restore(self, state: FloatArray) -> None:
        """Brings the simulation back to a state."""
        mujoco.mj_setState(self.model, self.data, state, _STATE)
        mujoco.mj_forward(self.model, self.data)
