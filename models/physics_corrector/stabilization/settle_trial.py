"""Trials in MuJoCo: some objects of a layout are free, others are held; tests which of the free ones stay."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from models.physics_corrector.packing.slab_outline import BoolArray
from stable_data.scene import FloatArray, Tabletop
from stable_data.simulation.mujoco_import import mujoco, without_log_file
from stable_data.simulation.settling import Calm, PhysicsOptions, RigidBody, compile_bodies, enable_sleeping

_OPTIONS = PhysicsOptions()  # as for the verdict on stability


class SettleTrial:
    """Simulates some objects of a layout in MuJoCo.

    Args:
        bodies: All objects of the layout; their own poses are not used.
        poses: Poses of all objects, (N, 4), metres and radians.
        free: Indices of objects that can move.
        held: Indices of objects that cannot move.
        table: The table.

    Raises:
        MeshError: A body has no solid part, or MuJoCo refuses it.
    """

    def __init__(
        self, bodies: Sequence[RigidBody], poses: FloatArray, free: Sequence[int], held: Sequence[int], table: Tabletop
    ) -> None:
        self.free = list(free)
        self._stride = max(1, round(_OPTIONS.sample_seconds / _OPTIONS.timestep))

        def at(k: int, *, movable: bool) -> RigidBody:
            x, y, z, yaw = poses[k].tolist()
            return replace(bodies[k], position=(x, y, z), yaw=yaw, movable=movable)

        placed = [at(k, movable=True) for k in free] + [at(k, movable=False) for k in held]
        self._model = compile_bodies(placed, table, _OPTIONS)
        self._data = mujoco.MjData(self._model)

    def stays(self, poses: FloatArray, seconds: float, move: float, turn: float) -> BoolArray:
        """Returns which free objects never move farther or turn more than the limits, (F,); none if the simulation diverges.

        Args:
            poses: Start poses of all objects, (N, 4); those of held objects are not used.
            seconds: Simulated time; shorter if all objects are at rest or none has stayed.
            move: The limit, metres.
            turn: The limit, degrees.
        """
        return self.judge(poses, seconds, move, turn)[0]

    def judge(self, poses: FloatArray, seconds: float, move: float, turn: float) -> tuple[BoolArray, BoolArray]:
        """Returns which free objects stay, and which of them move: two (F,), with the arguments of :meth:`stays`.

        If the simulation diverges, those move that had exceeded a limit before, because objects at rest do not make it diverge;
        all, if none had. Of the others neither is known.
        """
        _, moves, turns = self._run(poses, seconds, move, turn)
        return np.asarray((moves <= move) & (turns <= turn)), np.asarray((moves > move) | (turns > turn))

    def all_stay(self, poses: FloatArray, seconds: float, move: float, turn: float) -> bool:
        """Whether all free objects stay; like :meth:`stays`, but the trial ends with the first that does not."""
        _, moves, turns = self._run(poses, seconds, move, turn, ends_at_first=True)
        return bool((moves <= move).all() and (turns <= turn).all())

    def outcome(self, poses: FloatArray, seconds: float) -> FloatArray:
        """Returns the final poses of the free objects, (F, 4); the yaw is their rotation about the vertical.

        Args:
            poses: Start poses of all objects, (N, 4).
            seconds: Simulated time.
        """
        state = self._run(poses, seconds, np.inf, np.inf)[0]
        yaws = 2 * np.arctan2(state[:, 6], state[:, 3])
        return np.column_stack([state[:, :3], yaws])

    def _run(
        self, poses: FloatArray, seconds: float, move: float, turn: float, *, ends_at_first: bool = False
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns the last poses (F, 7) with quaternions wxyz, the largest moves (F,) in metres and turns (F,) in degrees.

        If the simulation diverges, both are infinite for the objects that caused it, and NaN for the others.
        """
        model, data = self._model, self._data
        mujoco.mj_resetData(model, data)
        # Sleep is enabled only after the settling time, as for the verdict on stability; a run before this one enabled it.
        model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        settling = round(_OPTIONS.settle_seconds / _OPTIONS.sample_seconds)
        start = np.zeros((len(self.free), 7))
        start[:, :3] = poses[self.free, :3]
        start[:, 3], start[:, 6] = np.cos(poses[self.free, 3] / 2), np.sin(poses[self.free, 3] / 2)
        data.qpos[:] = start.ravel()
        moves, turns = np.zeros(len(start)), np.zeros(len(start))
        now, calm = start, Calm.of_settling(start, _OPTIONS, seconds)
        with without_log_file():
            for number in range(round(seconds / _OPTIONS.timestep / self._stride)):
                if number == settling:
                    enable_sleeping(model, _OPTIONS)
                mujoco.mj_step(model, data, nstep=self._stride)
                now = np.array(data.qpos).reshape(-1, 7)
                if not np.isfinite(now).all():  # the simulation diverged
                    gone = (moves > move) | (turns > turn)
                    unknown = np.where(gone | ~gone.any(), np.inf, np.nan)
                    return start, unknown, unknown
                moves = np.maximum(moves, np.linalg.norm(now[:, :3] - start[:, :3], axis=1))
                cosine = np.abs((now[:, 3:] * start[:, 3:]).sum(axis=1))
                turns = np.maximum(turns, np.degrees(2 * np.arccos(np.minimum(cosine, 1.0))))
                gone = (moves > move) | (turns > turn)
                if gone.all() or (ends_at_first and gone.any()) or calm.has_come(now):
                    break
        return now, moves, turns
