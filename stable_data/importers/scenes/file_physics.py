"""Watches the free bodies of a MuJoCo scene file in its own physics: which of them stay where the file puts them.

Robots and other joints are held where they are, because nothing controls them here.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from stable_data.importers.scenes.mjcf_scenes import MjcfScene
from stable_data.importers.scenes.scene_file import BodyPose
from stable_data.rotations import quat_of
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.settling import MOVE_LIMIT, TURN_LIMIT, has_exploded, without_log_file

WATCH_SECONDS = 4.0
"""How long a file is watched: as long as the verdict ``stable`` of this library."""

_SAMPLE_SECONDS = 0.02
_MOST_STEPS = 20_000  # steps of a file with a very small time step


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """How a body moved.

    Attributes:
        move: Largest distance from its start, metres; infinite if the simulation diverged.
        turn: Largest rotation from its start, degrees; likewise.
        end: Its last pose.
    """

    move: float
    turn: float
    end: BodyPose

    @property
    def is_at_rest(self) -> bool:
        """Whether it stayed within the limits of a stable scene."""
        return self.move <= MOVE_LIMIT and self.turn <= TURN_LIMIT


def watch_file(
    scene: MjcfScene, model: mujoco.MjModel | None = None, qpos: np.ndarray | None = None, seconds: float = WATCH_SECONDS
) -> Mapping[str, BodyMotion]:
    """Simulates a scene file and watches its free bodies.

    Args:
        scene: The file.
        model: Another version of its model, such as that of the repaired file.
        qpos: Its joint positions; None: those of the scene.
        seconds: Simulated time.

    Returns:
        Name of each free body -> its motion.
    """
    model = scene.model if model is None else model
    data = mujoco.MjData(model)
    start = scene.qpos if qpos is None else qpos
    if scene.key >= 0:
        mujoco.mj_resetDataKeyframe(model, data, scene.key)
    data.qpos[:] = start
    data.qvel[:] = 0.0
    free = {name: (scene.address(name), int(model.jnt_dofadr[model.body_jntadr[b]])) for name, b in scene.free_bodies.items()}
    held_q, held_v = np.ones(model.nq, bool), np.ones(model.nv, bool)
    for q, v in free.values():
        held_q[q : q + 7], held_v[v : v + 6] = False, False
    steps = min(_MOST_STEPS, max(1, round(seconds / model.opt.timestep)))
    stride = max(1, round(_SAMPLE_SECONDS / model.opt.timestep))
    moves, turns = dict.fromkeys(free, 0.0), dict.fromkeys(free, 0.0)
    flags = int(model.opt.disableflags)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    try:
        with without_log_file():
            for step in range(steps):
                mujoco.mj_step(model, data)
                data.qpos[held_q], data.qvel[held_v] = start[held_q], 0.0
                if step % stride and step + 1 < steps:
                    continue
                if has_exploded(data) or not np.isfinite(data.qpos).all():
                    return {name: BodyMotion(np.inf, np.inf, _pose(start, q)) for name, (q, _) in free.items()}
                for name, (q, _) in free.items():
                    moves[name] = max(moves[name], float(np.linalg.norm(data.qpos[q : q + 3] - start[q : q + 3])))
                    turn = _rotation(data.qpos, q) * _rotation(start, q).inv()
                    turns[name] = max(turns[name], float(np.degrees(turn.magnitude())))
    finally:
        model.opt.disableflags = flags
    return {name: BodyMotion(moves[name], turns[name], _pose(data.qpos, q)) for name, (q, _) in free.items()}


def _rotation(qpos: np.ndarray, at: int) -> Rotation:
    w, x, y, z = qpos[at + 3 : at + 7]
    return Rotation.from_quat([x, y, z, w])


def _pose(qpos: np.ndarray, at: int) -> BodyPose:
    x, y, z = qpos[at : at + 3].tolist()
    return (x, y, z), quat_of(_rotation(qpos, at))
