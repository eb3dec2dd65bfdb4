"""The physics of a scene, one step after another: the MuJoCo model of the stability verdict."""

import numpy as np

from stable_data.scene import FloatArray
from stable_data.simulation.mujoco_import import mujoco, without_log_file
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import compile_bodies, has_exploded


class ScenePhysics:
    """A scene in the physics engine, with the bodies, the table and the settings of the stability verdict.

    Args:
        geometry: The scene with its geometry. Its objects start at their poses.

    Raises:
        MeshError: An object has no solid part, or MuJoCo refuses the scene.
    """

    def __init__(self, geometry: SceneGeometry) -> None:
        self._is_empty = not geometry.bodies  # MuJoCo needs no steps then, and has no poses to give
        self._model = compile_bodies(geometry.bodies, geometry.scene.table)
        self._data = mujoco.MjData(self._model)
        self.reset()

    @property
    def seconds(self) -> float:
        """Simulated time since the start."""
        return float(self._data.time)

    @property
    def timestep(self) -> float:
        """Length of one step, seconds."""
        return float(self._model.opt.timestep)

    @property
    def has_diverged(self) -> bool:
        """Whether the simulation can no longer go on, because positions or velocities are no longer valid."""
        return has_exploded(self._data) or not bool(np.isfinite(self._data.xpos).all())

    def reset(self) -> None:
        """Puts the objects back to where they started, at rest."""
        mujoco.mj_resetData(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)

    def step(self, num_steps: int = 1) -> None:
        """Simulates some steps; none after the simulation has diverged."""
        if num_steps <= 0 or self.has_diverged or self._is_empty:
            return
        with without_log_file():
            mujoco.mj_step(self._model, self._data, nstep=num_steps)
            mujoco.mj_kinematics(self._model, self._data)  # mj_step leaves the poses as they were before its last step

    def poses(self) -> FloatArray:
        """Returns where the objects are, (N, 7) float64: centre that their box had at the start, metres; quaternion xyzw.

        The rotation is from the yaw frame at yaw 0.
        """
        return np.concatenate([self._data.xpos[1:], self._data.xquat[1:][:, [1, 2, 3, 0]]], axis=1)
