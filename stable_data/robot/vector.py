"""Many scenes as one environment, and many environments side by side: what training and evaluation loops take.

An EnvHub folder (:mod:`stable_data.robot.envhub`) is made of these.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, GoalError, MeshError, SceneError
from stable_data.robot.env import Observation, RobotEnv, RobotOptions, options_for
from stable_data.simulation.offscreen import Picture
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder, Uri
from stable_data.storage.table_rows import scene_from_row
from stable_data.tasks.compiling import compile_goal
from stable_data.tasks.geometry import TaskGeometry

SceneEnvs: TypeAlias = SyncVectorEnv | AsyncVectorEnv
"""Environments side by side, in this process or each in one of its own."""


class ScenesEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """The scenes of a run one after the other: each episode is in the next one.

    Spaces, actions and ``info`` are those of :class:`stable_data.robot.env.RobotEnv`.

    Args:
        run: The run's folder or URI.
        scene_ids: The scenes, in the order of the episodes; after the last one the first follows again.
        options: The robot; None: the default one.
        settled: Objects start where they settled.
        render_mode: ``rgb_array``, or None.

    Attributes:
        current: The environment of the present scene.

    Raises:
        ConfigError: There are no scenes, or the run lacks them.
    """

    metadata = RobotEnv.metadata

    def __init__(
        self,
        run: Uri,
        scene_ids: Sequence[str],
        options: RobotOptions | None = None,
        *,
        settled: bool = False,
        render_mode: str | None = "rgb_array",
    ) -> None:
        if not scene_ids:
            raise ConfigError(f"{run}: no scenes are named, expected at least one; choose another condition", "source_empty")
        self.render_mode = render_mode
        self._run, self._ids, self._options, self._settled = run, tuple(scene_ids), options or RobotOptions(), settled
        self._store: AssetStore = run_store(run)
        self._next = 0
        self.current = self._open(self._ids[0])
        self.action_space, self.observation_space = self.current.action_space, self.current.observation_space

    @property
    def task(self) -> str:
        """Kind of the present goal."""
        return self.current.task

    @property
    def task_description(self) -> str:
        """The present instruction."""
        return self.current.task_description

    @property
    def _max_episode_steps(self) -> int:
        """The name by which evaluation loops ask for the longest episode."""
        return self._options.max_steps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Opens the next scene.

        Args:
            seed: Seed of what is varied in the scene.
            options: ``scene``: id of the scene to open instead; the order then continues after it.

        Raises:
            ConfigError: The named scene is not one of these (``scene_unknown``).
        """
        super().reset(seed=seed)
        wanted = (options or {}).get("scene")
        if wanted is not None:
            if wanted not in self._ids:
                raise ConfigError(
                    f"{self._run}: scene {wanted!r} is not one of the {len(self._ids)} of this environment", "scene_unknown"
                )
            self._next = self._ids.index(wanted)
        scene_id = self._ids[self._next % len(self._ids)]
        self._next += 1
        if self.current.scene.scene_id != scene_id:
            self.current.close()
            self.current = self._open(scene_id)
        drawn = int(self.np_random.integers(2**31)) if seed is None else seed
        return self.current.reset(seed=drawn)

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carries out an action in the present scene."""
        return self.current.step(action)

    def render(self) -> Picture | None:
        """The present scene from the front, (H, W, 3) uint8; None without a render mode."""
        return self.current.render()

    def close(self) -> None:
        """Frees the renderer."""
        self.current.close()

    def _open(self, scene_id: str) -> RobotEnv:
        scenes = RunScenes(RunFolder(self._run), SceneSelection(scene_ids=(scene_id,), settled=self._settled), self._store)
        row = scenes.row(0)
        geometry = scenes.geometry(scene_from_row(row), row)
        return RobotEnv(geometry, options=options_for(row, self._options), render_mode=self.render_mode)


def make_vector_env(
    run: Uri,
    scene_ids: Sequence[str],
    n_envs: int = 1,
    use_async_envs: bool = False,
    *,
    settled: bool = False,
    **options: Any,
) -> SceneEnvs:
    """Makes environments side by side; number k has the scenes k, k + n, k + 2 n, ….

    An episode that ends is followed by the next one at once (``AutoresetMode.SAME_STEP``): the last ``info`` of the old one is in
    ``final_info``.

    Args:
        run: The run's folder or URI.
        scene_ids: The scenes, with a checkable goal each.
        n_envs: How many.
        use_async_envs: Each in a process of its own.
        settled: Objects start where they settled.
        options: Fields of :class:`stable_data.robot.env.RobotOptions`.

    Raises:
        ConfigError: There are no scenes, or an option is invalid.
        GoalError: A first scene has no checkable goal.
    """
    if n_envs < 1:
        raise ConfigError(f"n_envs is {n_envs}, expected at least 1", "setting_invalid")
    if not scene_ids:
        raise ConfigError(f"{run}: no scenes are named, expected at least one; choose another condition", "source_empty")
    chosen = RobotOptions(**options)
    parts = [tuple(scene_ids[k % len(scene_ids) :: n_envs]) for k in range(n_envs)]
    makers = [partial(ScenesEnv, run, part, chosen, settled=settled) for part in parts]
    if use_async_envs:
        return AsyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP, context="spawn")
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)


def scenes_by_task(run: Uri, *, where: str | None = None, options: RobotOptions | None = None) -> dict[str, list[str]]:
    """Returns the ids of the scenes with a checkable goal, by kind of goal; scenes without one are left out.

    Args:
        run: The run's folder or URI.
        where: A condition on the table ``scenes``; None: all.
        options: The robot; scenes where it cannot start are left out too, which takes a third of a second a scene. None: not tried.
    """
    found: dict[str, list[str]] = {}
    scenes = RunScenes(RunFolder(run), SceneSelection(where=where))
    for row in scenes.rows():
        geometry = scenes.geometry(scene_from_row(row), row)
        try:
            goal = compile_goal(TaskGeometry.of(geometry))
            if options is not None:
                RobotEnv(geometry, goal, options_for(row, options)).close()
        except (GoalError, SceneError, MeshError):
            continue
        found.setdefault(str(goal.kind), []).append(row["scene_id"])
    return dict(sorted(found.items()))
