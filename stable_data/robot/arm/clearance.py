"""Whether an arm at some joints touches anything: quick checks for planning, with one object in the hand or none."""

import copy
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.robot.arm.assembly import RobotModel
from stable_data.robot.arm.world import RobotWorld
from stable_data.rotations import wxyz
from stable_data.scene import TABLE, FloatArray
from stable_data.simulation.mujoco_import import mujoco

_SCENE, _ROBOT = 2, 1  # bits of what collides
_TOUCH = 5e-4  # contacts shallower than this do not count, metres
SELF = "robot"
"""The name of the robot itself where it hits itself."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldObject:
    """An object in the hand.

    Attributes:
        instance: The object.
        position: Of its body in the tool frame, (3,), metres.
        rotation: Tool from body, (3, 3).
    """

    instance: str
    position: FloatArray
    rotation: FloatArray


class Clearance:
    """Checks configurations of an arm against a scene whose objects stand still.

    Args:
        built: The scene with the robot.
    """

    def __init__(self, built: RobotModel) -> None:
        self._built, self._model = built, copy.copy(built.model)
        model = self._model
        self._data = mujoco.MjData(model)
        self._collides = (model.geom_contype > 0) | (model.geom_conaffinity > 0)
        self._is_robot = built.robot_bodies[model.geom_bodyid]
        self._names = {int(body): name for body, name in zip(built.object_bodies, built.names, strict=True)}
        self._data.qpos[:] = built.start_qpos
        self._touching_itself: frozenset[tuple[int, int]] = frozenset()
        self._held: HeldObject | None = None
        self._set_masks(None)
        self._touching_itself = self._self_contacts(np.array(built.robot.home))

    def look(self, world: RobotWorld) -> None:
        """Takes over where the objects of a simulation are."""
        self._data.qpos[:] = world.data.qpos

    def hold(self, held: HeldObject | None) -> None:
        """From now on an object moves with the hand, or none does."""
        self._held = held
        self._set_masks(None if held is None else held.instance)

    def hits(
        self,
        joints: FloatArray,
        opening: float,
        *,
        allowed: frozenset[str] = frozenset(),
        allowed_depth: float = np.inf,
    ) -> str | None:
        """Returns the name of something that an arm at these joints touches; None if it touches nothing.

        Args:
            joints: (J,) radians.
            opening: Distance between the fingers, metres.
            allowed: Objects, or ``table``, that may be touched.
            allowed_depth: How deep these may be touched, metres.
        """
        data = self._data
        self._pose(joints, opening)
        mujoco.mj_collision(self._model, data)
        if not data.ncon:
            return None
        for geoms, distance in zip(data.contact.geom.tolist(), data.contact.dist.tolist(), strict=True):
            if distance > -_TOUCH:
                continue
            one, other = (int(self._model.geom_bodyid[g]) for g in geoms)
            name = self._other(one, other)
            if name in allowed and distance > -allowed_depth:
                continue
            if name == SELF and (min(one, other), max(one, other)) in self._touching_itself:
                continue
            return name
        return None

    def _pose(self, joints: FloatArray, opening: float) -> None:
        built, data = self._built, self._data
        data.qpos[built.joint_addresses] = joints
        data.qpos[built.hand_addresses] = built.hand_positions(opening)
        mujoco.mj_kinematics(self._model, data)
        if self._held is None:
            return
        turn = np.array(data.site_xmat[built.tool]).reshape(3, 3)
        place = np.array(data.site_xpos[built.tool]) + turn @ self._held.position
        rotation = Rotation.from_matrix(turn @ self._held.rotation).as_quat()
        address = built.free_addresses[self._held.instance][0]
        data.qpos[address : address + 3] = place
        data.qpos[address + 3 : address + 7] = wxyz(tuple(rotation.tolist()))
        mujoco.mj_kinematics(self._model, data)

    def _other(self, one: int, other: int) -> str:
        """The name of what is touched: neither the robot nor what it holds."""
        mine = self._built.robot_bodies
        held = None if self._held is None else self._held.instance
        names = [SELF if mine[body] else self._names.get(body, TABLE) for body in (one, other)]
        names = [SELF if name == held else name for name in names]
        return next((name for name in names if name != SELF), SELF)

    def _set_masks(self, held: str | None) -> None:
        """Robot and held object collide with the scene; the robot with itself; the scene does not with itself."""
        model = self._model
        moves = self._is_robot.copy()
        if held is not None:
            moves |= model.geom_bodyid == 1 + self._built.names.index(held)
        model.geom_contype[:] = np.where(self._collides, np.where(moves, _ROBOT, _SCENE), 0)
        own = _ROBOT if held is None else 0  # with an object in the hand, the robot would collide with it
        model.geom_conaffinity[:] = np.where(self._collides, np.where(moves, _SCENE | own, _ROBOT), 0)
        for name, values in (("body_contype", model.geom_contype), ("body_conaffinity", model.geom_conaffinity)):
            found = np.zeros(model.nbody, np.int64)
            np.bitwise_or.at(found, model.geom_bodyid, values)
            getattr(model, name)[:] = found

    def _self_contacts(self, joints: FloatArray) -> frozenset[tuple[int, int]]:
        """Pairs of bodies of the robot that touch each other at its home position, and so always may."""
        self._pose(joints, self._built.robot.hand.max_opening)
        mujoco.mj_collision(self._model, self._data)
        bodies = self._model.geom_bodyid[self._data.contact.geom] if self._data.ncon else np.zeros((0, 2), np.int64)
        mine = self._built.robot_bodies[bodies].all(axis=1) if len(bodies) else []
        return frozenset((int(min(pair)), int(max(pair))) for pair in bodies[mine].tolist()) if len(bodies) else frozenset()
