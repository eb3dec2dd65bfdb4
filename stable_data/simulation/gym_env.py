"""A scene as a Gymnasium environment: a hand pushes the objects of a table.

    env = gymnasium.make("stable_data.simulation.gym_env:stable_data/Tabletop-v0", run=RUN, scene=scene_id)

The physics are those of the stability verdict (:mod:`stable_data.simulation.mujoco_model`). Beside the objects there is a ball,
the hand, which moves as commanded; no object stops it. It is a minimal actuator for any scene and no robot; to add a robot, use
the exported MJCF.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.scene import FloatArray, Scene
from stable_data.simulation.mujoco_import import mujoco, without_log_file
from stable_data.simulation.mujoco_model import CAMERAS, HOME, VISUAL_GROUP, engine_spec
from stable_data.simulation.offscreen import Picture, open_renderer
from stable_data.simulation.run_reader import RunScenes, SceneSelection, SettledPoses
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import COLLIDER, compile_spec, has_exploded
from stable_data.storage.run_folder import RunFolder, Uri

Observation: TypeAlias = dict[str, Any]
"""Name -> array, as in ``TabletopEnv.observation_space``."""

Reward: TypeAlias = Callable[[Observation, Observation], float]
"""Reward of a step: the observations before and after it."""

HAND_RADIUS = 0.02
"""Radius of the ball that pushes, metres."""

HAND_SPEED = 0.25
"""Speed along each axis at an action of 1, metres a second."""

STEP_SECONDS = 0.05
"""Simulated time of one step of the environment."""

_REACH = 0.15  # how far beyond the table and above the highest object the hand may go, metres
_HAND = "hand"
_HAND_COLOUR = (0.15, 0.15, 0.18, 1.0)
_FAR = 1000.0  # objects that fall off the table fall without end; observed positions are clipped to this, metres
_FALLEN = -0.1  # an object whose centre is lower has left the table, metres


class TabletopEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """A scene whose objects can be pushed.

    An action is the hand's velocity along x, y and z, (3,) float32 from -1 to 1, in shares of ``HAND_SPEED``. An observation
    contains

    - ``objects``: position (metres) and quaternion (xyzw) of every object, (N, 7) float32, in the order of the scene;
    - ``hand``: its centre, (3,) float32, metres;
    - a picture (H, W, 3) uint8 for each camera, by its name.

    ``info`` contains ``scene_id``, ``instruction``, ``instances`` and those that have ``fallen`` off the table. An episode is
    terminated if the simulation diverges, and truncated after ``max_steps``.

    Args:
        geometry: The scene with its geometry.
        reward: Reward of a step; None: 0.
        cameras: Cameras whose pictures are observed, of ``front`` and ``top``.
        image_size: Width and height of pictures, pixels.
        max_steps: Steps of an episode.
        render_mode: ``rgb_array`` (a picture from the front), or None.

    Raises:
        ConfigError: A camera or render mode is not known (``setting_invalid``).
        MeshError: An object has no solid part, or MuJoCo refuses it.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_SECONDS)}  # noqa: RUF012

    def __init__(
        self,
        geometry: SceneGeometry,
        *,
        reward: Reward | None = None,
        cameras: Sequence[str] = (),
        image_size: tuple[int, int] = (128, 128),
        max_steps: int = 200,
        render_mode: str | None = None,
    ) -> None:
        _check_settings(cameras, max_steps, render_mode)
        self.scene, self.render_mode = geometry.scene, render_mode
        self._reward, self._cameras, self._image_size, self._max_steps = reward, tuple(cameras), image_size, max_steps
        tops = [p[2] + shape.size[2] / 2 for p, shape in zip(geometry.scene.poses(), geometry.shapes, strict=True)]
        x, y = geometry.scene.table.size_xy
        self._start_height = max(tops, default=0.0) + 2 * HAND_RADIUS
        # In single precision, so that an observation at the limit is within its space.
        self._low = np.array([-_REACH, -_REACH, HAND_RADIUS], np.float32)
        self._high = np.array([x + _REACH, y + _REACH, self._start_height + _REACH], np.float32)
        self._farthest = np.tile(np.array([_FAR] * 3 + [1.0] * 4, np.float32), (len(geometry.scene.objects), 1))
        self._model = _model_with_hand(geometry, image_size)
        self._data = mujoco.MjData(self._model)
        self._renderer: Any = None
        self._num_steps = 0
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = self._space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Puts every object at its pose in the scene, and the hand at a random place above them.

        Args:
            seed: Seed of the hand's place.
            options: ``hand``: its place, (3,) metres, instead.
        """
        super().reset(seed=seed)
        mujoco.mj_resetDataKeyframe(self._model, self._data, self._model.key(HOME).id)
        x, y = self.scene.table.size_xy
        drawn = self.np_random.uniform((0.0, 0.0), (x, y))
        hand = (options or {}).get(_HAND, (*drawn.tolist(), self._start_height))
        self._data.mocap_pos[0] = np.clip(np.asarray(hand, np.float64), self._low, self._high)
        mujoco.mj_forward(self._model, self._data)
        self._num_steps = 0
        return self._observation(), self._info()

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves the hand for ``STEP_SECONDS``.

        Args:
            action: Its velocity, (3,), clipped to -1 to 1.

        Raises:
            ValueError: The action is not three finite numbers.
        """
        command = np.asarray(action, np.float64)
        if command.shape != (3,) or not np.isfinite(command).all():
            raise ValueError(f"action is {action}, expected three finite numbers: the hand's velocity along x, y and z")
        before = self._observation() if self._reward is not None else None
        velocity = HAND_SPEED * np.clip(command, -1.0, 1.0)
        timestep = self._model.opt.timestep
        with without_log_file():
            for _ in range(round(STEP_SECONDS / timestep)):
                self._data.mocap_pos[0] = np.clip(self._data.mocap_pos[0] + timestep * velocity, self._low, self._high)
                mujoco.mj_step(self._model, self._data)
            mujoco.mj_kinematics(self._model, self._data)  # mj_step leaves the poses as they were before its last step
        self._num_steps += 1
        after = self._observation()
        reward = 0.0 if self._reward is None or before is None else float(self._reward(before, after))
        terminated = bool(has_exploded(self._data) or not np.isfinite(after["objects"]).all())
        return after, reward, terminated, self._num_steps >= self._max_steps, self._info()

    def render(self) -> Picture | None:
        """The scene from the front, (H, W, 3) uint8; None without a render mode.

        Raises:
            ConfigError: The machine cannot render (``no_gl``).
        """
        return None if self.render_mode is None else self._picture(CAMERAS[0])

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _space(self) -> spaces.Dict:
        width, height = self._image_size
        entries: dict[str, spaces.Space[Any]] = {
            "objects": spaces.Box(-self._farthest, self._farthest, dtype=np.float32),
            _HAND: spaces.Box(self._low, self._high, dtype=np.float32),
        }
        return spaces.Dict(entries | {name: spaces.Box(0, 255, (height, width, 3), np.uint8) for name in self._cameras})

    def _observation(self) -> Observation:
        poses = np.concatenate([self._positions(), self._data.xquat[1:-1][:, [1, 2, 3, 0]]], axis=1).astype(np.float32)
        hand = np.clip(self._data.mocap_pos[0], self._low, self._high).astype(np.float32)
        pictures = {name: self._picture(name) for name in self._cameras}
        return {"objects": np.clip(poses, -self._farthest, self._farthest), _HAND: hand, **pictures}

    def _positions(self) -> FloatArray:
        """Positions of the objects, (N, 3): the world is body 0, the hand is the last body."""
        return np.asarray(self._data.xpos[1:-1], np.float64)

    def _info(self) -> dict[str, Any]:
        names = tuple(o.instance for o in self.scene.objects)
        low = self._positions()[:, 2] < _FALLEN
        return {
            "scene_id": self.scene.scene_id,
            "instruction": None if self.scene.task is None else self.scene.task.task,
            "instances": names,
            "fallen": tuple(name for name, is_low in zip(names, low.tolist(), strict=True) if is_low),
        }

    def _picture(self, camera: str) -> Picture:
        if self._renderer is None:
            self._renderer = open_renderer(self._model, self._image_size)
        self._renderer.update_scene(self._data, camera=camera)
        return np.asarray(self._renderer.render(), np.uint8)


def make_env(
    run: Uri, scene: str | Scene, *, settled: bool = False, store: AssetStore | None = None, **settings: Any
) -> TabletopEnv:
    """Makes the environment of a scene of a run.

    Args:
        run: The run's folder or URI, with the tables ``scenes``, ``assets`` and ``meshes``.
        scene: Its id, or the scene itself, as the loader gives it.
        settled: Objects start at their poses after settling (table ``settled``).
        store: The assets of the run, :func:`stable_data.assets.run_assets.run_store`, to share them between many environments.
        settings: Settings of :class:`TabletopEnv`.

    Raises:
        ConfigError: The run has no such scene, or lacks a table; or a setting is invalid.
        SceneError: The scene was never settled, but ``settled`` is set.
        MeshError: An object has no solid part.
    """
    if isinstance(scene, str):
        scenes = RunScenes(RunFolder(run), SceneSelection(scene_ids=(scene,), settled=settled), store)
        return TabletopEnv(scenes.geometry(next(iter(scenes))), **settings)
    rest = SettledPoses(RunFolder(run)).of(scene.scene_id) if settled else None
    return TabletopEnv(SceneGeometry.of(scene, store or run_store(run), rest), **settings)


def _model_with_hand(geometry: SceneGeometry, image_size: tuple[int, int]) -> mujoco.MjModel:
    spec = engine_spec(geometry, image_size)
    body = spec.worldbody.add_body(name=_HAND, mocap=True)
    body.add_geom(
        spec.find_default(COLLIDER),
        name=_HAND,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[HAND_RADIUS, 0.0, 0.0],
        rgba=list(_HAND_COLOUR),
        group=VISUAL_GROUP,
    )
    return compile_spec(spec)


def _check_settings(cameras: Sequence[str], max_steps: int, render_mode: str | None) -> None:
    unknown = [name for name in cameras if name not in CAMERAS]
    if unknown:
        raise ConfigError(f"cameras {unknown} are not known, expected some of {', '.join(CAMERAS)}", "setting_invalid")
    if max_steps < 1:
        raise ConfigError(f"max_steps is {max_steps}, expected at least 1", "setting_invalid")
    if render_mode not in (None, *TabletopEnv.metadata["render_modes"]):
        raise ConfigError(f"render_mode is {render_mode!r}, expected rgb_array or None", "setting_invalid")


gymnasium.register("stable_data/Tabletop-v0", entry_point="stable_data.simulation.gym_env:make_env")
