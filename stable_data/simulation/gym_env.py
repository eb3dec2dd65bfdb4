"""A scene as a Gymnasium environment: a hand pushes the objects of a table.

    env = gymnasium.make("stable_data.simulation.gym_env:stable_data/Tabletop-v0", run=RUN, scene=scene_id)

The physics are those that the stability verdict was given (:mod:`stable_data.simulation.mujoco_model`); beside the objects
there is a ball, the hand, that goes where it is told, whatever stands in its way. It is the least that can act on any scene,
and no robot: who has one puts it into the exported MJCF.
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
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.mujoco_model import CAMERAS, HOME, VISUAL_GROUP, engine_spec
from stable_data.simulation.render import Picture, open_renderer
from stable_data.simulation.run_reader import RunScenes, SceneSelection, SettledPoses
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import COLLIDER, compile_spec, has_exploded, without_log_file
from stable_data.storage.run_folder import RunFolder, Uri

Observation: TypeAlias = dict[str, Any]
"""Name -> array, as ``TabletopEnv.observation_space`` says."""

Reward: TypeAlias = Callable[[Observation, Observation], float]
"""Reward of a step: the observations before and after it."""

HAND_RADIUS = 0.02
"""Of the ball that pushes, metres."""

HAND_SPEED = 0.25
"""Along each axis, metres a second, at an action of 1."""

STEP_SECONDS = 0.05
"""What a step of the environment takes."""

_REACH = 0.15  # how far beyond the table and above the highest object the hand may go, metres
_HAND = "hand"
_HAND_COLOUR = (0.15, 0.15, 0.18, 1.0)
_FAR = 1000.0  # what falls off the table falls for ever; farther than this it is not told, metres
_FALLEN = -0.1  # an object whose centre is lower has left the table, metres


class TabletopEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """A scene whose objects can be pushed.

    An action is the hand's velocity along x, y and z, (3,) float32 from -1 to 1, in shares of ``HAND_SPEED``. An observation
    holds

    - ``objects``: position (metres) and quaternion (xyzw) of every object, (N, 7) float32, in the order of the scene;
    - ``hand``: its centre, (3,) float32, metres;
    - a picture (H, W, 3) uint8 by the name of each camera.

    ``info`` says ``scene_id``, ``instruction``, ``instances`` and which of them have ``fallen`` off the table. An episode is
    terminated where the simulation blew up, and truncated after ``max_steps``.

    Args:
        solid: The scene with its geometry.
        reward: Of a step; None: 0.
        cameras: Pictures in the observation, of ``front`` and ``top``.
        image_size: Width and height of pictures, pixels.
        max_steps: Of an episode.
        render_mode: ``rgb_array`` (a picture from the front), or None.

    Raises:
        ConfigError: A camera or render mode is not known (``setting_invalid``).
        MeshError: An object has no solid part, or the engine refuses it.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_SECONDS)}  # noqa: RUF012

    def __init__(
        self,
        solid: SceneGeometry,
        *,
        reward: Reward | None = None,
        cameras: Sequence[str] = (),
        image_size: tuple[int, int] = (128, 128),
        max_steps: int = 200,
        render_mode: str | None = None,
    ) -> None:
        _check_settings(cameras, max_steps, render_mode)
        self.scene, self.render_mode = solid.scene, render_mode
        self._reward, self._cameras, self._image_size, self._max_steps = reward, tuple(cameras), image_size, max_steps
        tops = [p[2] + shape.size[2] / 2 for p, shape in zip(solid.scene.poses(), solid.shapes, strict=True)]
        x, y = solid.scene.table.size_xy
        self._start_height = max(tops, default=0.0) + 2 * HAND_RADIUS
        # In single precision, so that an observation at the edge is within its space.
        self._low = np.array([-_REACH, -_REACH, HAND_RADIUS], np.float32)
        self._high = np.array([x + _REACH, y + _REACH, self._start_height + _REACH], np.float32)
        self._farthest = np.tile(np.array([_FAR] * 3 + [1.0] * 4, np.float32), (len(solid.scene.objects), 1))
        self._model = _model(solid, image_size)
        self._data = mujoco.MjData(self._model)
        self._renderer: Any = None
        self._num_steps = 0
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = self._space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Puts every object where the scene has it, and the hand somewhere above them.

        Args:
            seed: Of the hand's place.
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
            action: Its velocity, (3,) from -1 to 1; more counts as 1.

        Raises:
            ValueError: It is no such action.
        """
        wanted = np.asarray(action, np.float64)
        if wanted.shape != (3,) or not np.isfinite(wanted).all():
            raise ValueError(f"action is {action}, expected three finite numbers: the hand's velocity along x, y and z")
        before = self._observation() if self._reward is not None else None
        velocity = HAND_SPEED * np.clip(wanted, -1.0, 1.0)
        timestep = self._model.opt.timestep
        with without_log_file():
            for _ in range(round(STEP_SECONDS / timestep)):
                self._data.mocap_pos[0] = np.clip(self._data.mocap_pos[0] + timestep * velocity, self._low, self._high)
                mujoco.mj_step(self._model, self._data)
            mujoco.mj_kinematics(self._model, self._data)
        self._num_steps += 1
        after = self._observation()
        reward = 0.0 if self._reward is None or before is None else float(self._reward(before, after))
        terminated = bool(has_exploded(self._data) or not np.isfinite(after["objects"]).all())
        return after, reward, terminated, self._num_steps >= self._max_steps, self._info()

    def render(self) -> Picture | None:
        """The scene from the front, (H, W, 3) uint8; None without a render mode.

        Raises:
            ConfigError: The machine cannot draw (``no_gl``).
        """
        return None if self.render_mode is None else self._picture(CAMERAS[0])

    def close(self) -> None:
        """Frees what draws."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _space(self) -> spaces.Dict:
        width, height = self._image_size
        found: dict[str, spaces.Space[Any]] = {
            "objects": spaces.Box(-self._farthest, self._farthest, dtype=np.float32),
            _HAND: spaces.Box(self._low, self._high, dtype=np.float32),
        }
        return spaces.Dict(found | {name: spaces.Box(0, 255, (height, width, 3), np.uint8) for name in self._cameras})

    def _observation(self) -> Observation:
        poses = np.concatenate([self._positions(), self._data.xquat[1:-1][:, [1, 2, 3, 0]]], axis=1).astype(np.float32)
        hand = np.clip(self._data.mocap_pos[0], self._low, self._high).astype(np.float32)
        pictures = {name: self._picture(name) for name in self._cameras}
        return {"objects": np.clip(poses, -self._farthest, self._farthest), _HAND: hand, **pictures}

    def _positions(self) -> FloatArray:
        """Of the objects, (N, 3): the world is body 0, the hand the last."""
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
    """The environment of a scene of a run.

    Args:
        run: The run's folder or URI, with the tables ``scenes``, ``assets`` and ``meshes``.
        scene: Its id; or the scene itself, as the loader gives it.
        settled: Objects lie where the physics engine left them (table ``settled``).
        store: The assets of the run, :func:`stable_data.assets.run_assets.run_store`, where many environments are made of them.
        settings: Of :class:`TabletopEnv`.

    Raises:
        ConfigError: The run has no such scene, or lacks a table; or a setting cannot be.
        SceneError: It was never settled, and that is asked for.
        MeshError: An object has no solid part.
    """
    if isinstance(scene, str):
        scenes = RunScenes(RunFolder(run), SceneSelection(scene_ids=(scene,), settled=settled), store)
        return TabletopEnv(scenes.solid(next(iter(scenes))), **settings)
    rest = SettledPoses(RunFolder(run)).of(scene.scene_id) if settled else None
    return TabletopEnv(SceneGeometry.of(scene, store or run_store(run), rest), **settings)


def _model(solid: SceneGeometry, image_size: tuple[int, int]) -> mujoco.MjModel:
    """The scene's model with a hand."""
    spec = engine_spec(solid, image_size)
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
