"""A robot with a task at a table, as a Gymnasium environment.

    env = gymnasium.make("stable_data.robot.env:stable_data/Robot-v0", run=RUN, scene=scene_id)

The objects and their physics are those of the stability verdict; the task is the goal that the scene's task info states.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, SceneError
from stable_data.robot.arm.assembly import CAMERAS, assemble
from stable_data.robot.arm.clearance import Clearance
from stable_data.robot.arm.control import CONTROL_SECONDS, Controller
from stable_data.robot.arm.kinematics import arm_of
from stable_data.robot.arm.mounting import AUTO, mount_of
from stable_data.robot.arm.robots import robot_named
from stable_data.robot.arm.world import RobotWorld
from stable_data.robot.observation import ENVIRONMENT_STATE_NAMES, FAR, environment_state, robot_state, state_names
from stable_data.robot.randomization import Drawn, RandomizationOptions, Randomizer
from stable_data.robot.task_progress import TaskProgress, target_places
from stable_data.scene import Scene
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.offscreen import Picture, open_renderer
from stable_data.simulation.run_reader import RunScenes, SceneSelection, SettledPoses
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder, Uri
from stable_data.storage.table_rows import scene_from_row
from stable_data.tasks.compiling import compile_goal
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import Goal

Observation: TypeAlias = dict[str, Any]
"""Name -> array, as in ``RobotEnv.observation_space``."""

AGENT, ENVIRONMENT, PIXELS = "agent_pos", "environment_state", "pixels"
"""Names in an observation."""


@dataclass(frozen=True, slots=True)
class RobotOptions:
    """The robot, what it sees, and how it is commanded.

    Attributes:
        robot: Name of the robot, see ``stable-data robots``.
        mount: Where it stands: ``auto``, an edge of the table, or an edge and a share of its length, such as ``front:0.25``.
        control: Meaning of an action, see :data:`stable_data.robot.arm.control.CONTROLS`.
        cameras: Cameras whose pictures are observed, of ``wrist``, ``front`` and ``top``.
        image_size: Width and height of the pictures, pixels.
        shadows: Whether pictures have shadows, which take five times as long without a graphics card.
        max_steps: Actions of an episode at most.
        randomization: What is varied from episode to episode.
    """

    robot: str = "panda"
    mount: str = AUTO
    control: str = "ee_delta"
    cameras: tuple[str, ...] = ()
    image_size: tuple[int, int] = (128, 128)
    shadows: bool = False
    max_steps: int = 600
    randomization: RandomizationOptions = field(default_factory=RandomizationOptions)

    def __post_init__(self) -> None:
        """Refuses what makes no environment."""
        unknown = [name for name in self.cameras if name not in CAMERAS]
        if unknown:
            raise ConfigError(f"cameras {unknown} are not known, expected some of {', '.join(CAMERAS)}", "setting_invalid")
        if self.max_steps < 1:
            raise ConfigError(f"max_steps is {self.max_steps}, expected at least 1", "setting_invalid")
        if min(self.image_size) < 1:
            raise ConfigError(f"image_size is {self.image_size}, expected two positive numbers of pixels", "setting_invalid")


class RobotEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """A scene with a robot and a task.

    An action commands the arm and the hand for ``CONTROL_SECONDS``; ``RobotOptions.control`` says how. An observation contains

    - ``agent_pos``: the state of the robot, (S,) float32, see :func:`stable_data.robot.observation.robot_state`;
    - ``environment_state``: the objects that matter for the task, (E,) float32, see
      :func:`stable_data.robot.observation.environment_state`;
    - ``pixels``: a picture (H, W, 3) uint8 for each camera, by its name, if there are cameras.

    The reward is that of the goal: from 0 to 1, and 1 only if it is fulfilled. ``info`` contains ``is_success``, ``scene_id``,
    ``instruction`` and ``task_kind``. An episode is terminated if the goal is fulfilled, or if the simulation diverges, and truncated
    after ``max_steps``.

    Args:
        geometry: The scene with its geometry.
        goal: The goal; None: that of the scene's task.
        options: The robot.
        render_mode: ``rgb_array`` (a picture from the front), or None.

    Attributes:
        scene: The scene.
        goal: The goal.
        options: The robot.
        world: The simulation.
        arm: Kinematics of the robot.
        controller: The meaning of actions.
        drawn: What the domain randomisation drew at the last reset; None before the first one.

    Raises:
        ConfigError: The robot, a camera, the mount or the render mode is not known (``setting_invalid``), or the files of the robot
            are missing (``robot_missing``).
        GoalError: The task states no goal that can be checked.
        SceneError: The robot would touch something where it starts (``robot_start_collides``).
        MeshError: An object has no solid part.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1 / CONTROL_SECONDS)}  # noqa: RUF012

    def __init__(
        self,
        geometry: SceneGeometry,
        goal: Goal | None = None,
        options: RobotOptions = RobotOptions(),
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render_mode is {render_mode!r}, expected rgb_array or None", "setting_invalid")
        robot = robot_named(options.robot)
        self.scene, self.options, self.render_mode = geometry.scene, options, render_mode
        task = TaskGeometry.of(geometry)
        self.goal = compile_goal(task) if goal is None else goal
        wanted = {name for step in self.goal.steps for name in (step.subject, *(t for c in step.conditions for t in c.targets))}
        mount = mount_of(robot, geometry.scene, options.mount, wanted, target_places(self.goal, task))
        self.built = assemble(geometry, robot, mount, options.image_size)
        self.arm = arm_of(robot)
        self.clearance = Clearance(self.built)
        hit = self.clearance.hits(self.arm.home, robot.hand.max_opening)
        if hit is not None:
            raise SceneError(
                f"{geometry.scene.scene_id}: the {robot.title} touches {hit} at its start; "
                f"choose another mount than {options.mount}, or another robot",
                "robot_start_collides",
            )
        self.world = RobotWorld(self.built)
        self.controller = Controller(robot, self.arm, options.control)
        self.progress = TaskProgress(self.goal, task, self.world)
        self.drawn: Drawn | None = None
        self._randomizer = Randomizer(self.built, options.randomization)
        self._renderer: Any = None
        self._num_steps = 0
        self.action_space = spaces.Box(self.controller.low, self.controller.high, dtype=np.float32)
        self.observation_space = self._space()

    @property
    def task(self) -> str:
        """Kind of the goal; the name by which results are grouped."""
        return str(self.goal.kind)

    @property
    def task_description(self) -> str:
        """The instruction."""
        return "" if self.scene.task is None else self.scene.task.task

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Puts every object at its pose in the scene, and the arm near its home position; varies what the options say.

        Args:
            seed: Seed of what is varied.
            options: Not used.
        """
        super().reset(seed=seed)
        self.drawn = self._randomizer.apply(self.np_random)
        self.world.reset()
        self.clearance.hold(None)
        self.clearance.look(self.world)  # not at what the former episode left
        start = self.drawn.start
        if self.clearance.hits(start, self.built.robot.hand.max_opening) is not None:
            start = self.arm.home  # which touches nothing
        self.world.reset(start)
        self.controller.reset(start)
        self.progress.reset()
        self._num_steps = 0
        return self._observation(), self._info(is_success=False)

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carries out an action.

        Args:
            action: (A,), clipped to the action space.

        Raises:
            ValueError: The action has another shape, or is not finite.
        """
        joints, opening = self.controller.command(action, self.world.joints)
        self.world.advance(joints, opening, CONTROL_SECONDS)
        self._num_steps += 1
        if self.world.has_diverged:
            self.world.reset()  # so that what is observed is finite
            return self._observation(), 0.0, True, False, self._info(is_success=False)
        reward, is_success = self.progress.update()
        return (
            self._observation(),
            reward,
            is_success,
            self._num_steps >= self.options.max_steps,
            self._info(is_success=is_success),
        )

    def render(self) -> Picture | None:
        """The scene from the front, (H, W, 3) uint8; None without a render mode.

        Raises:
            ConfigError: The machine cannot render (``no_gl``).
        """
        return None if self.render_mode is None else self.picture("front")

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def picture(self, camera: str) -> Picture:
        """A picture of one of the cameras, (H, W, 3) uint8."""
        if self._renderer is None:
            self._renderer = open_renderer(self.built.model, self.options.image_size)
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self.options.shadows
        mujoco.mj_camlight(self.built.model, self.world.data)
        self._renderer.update_scene(self.world.data, camera=camera)
        return np.asarray(self._renderer.render(), np.uint8)

    def _space(self) -> spaces.Dict:
        width, height = self.options.image_size
        entries: dict[str, spaces.Space[Any]] = {
            AGENT: spaces.Box(-FAR, FAR, (len(state_names(self.built)),), np.float32),
            ENVIRONMENT: spaces.Box(-FAR, FAR, (len(ENVIRONMENT_STATE_NAMES),), np.float32),
        }
        if self.options.cameras:
            entries[PIXELS] = spaces.Dict(
                {name: spaces.Box(0, 255, (height, width, 3), np.uint8) for name in self.options.cameras}
            )
        return spaces.Dict(entries)

    def _observation(self) -> Observation:
        subject, target, place = self.progress.now()
        found: Observation = {
            AGENT: robot_state(self.world),
            ENVIRONMENT: environment_state(self.world, subject, target, place),
        }
        if self.options.cameras:
            found[PIXELS] = {name: self.picture(name) for name in self.options.cameras}
        return found

    def _info(self, *, is_success: bool) -> dict[str, Any]:
        return {
            "is_success": is_success,
            "scene_id": self.scene.scene_id,
            "instruction": self.task_description,
            "task_kind": self.task,
        }


def options_for(row: Mapping[str, Any], options: RobotOptions) -> RobotOptions:
    """Returns the options for a scene: with ``mount=auto`` the robot stands where its row of ``scenes`` says that it reaches the task.

    Args:
        row: The row.
        options: The robot.
    """
    is_stated = row.get("robot") == options.robot and row.get("robot_mount")
    return replace(options, mount=row["robot_mount"]) if is_stated and options.mount == AUTO else options


def make_robot_env(
    run: Uri,
    scene: str | Scene,
    *,
    settled: bool = False,
    store: AssetStore | None = None,
    render_mode: str | None = None,
    goal: Goal | None = None,
    **options: Any,
) -> RobotEnv:
    """Makes the environment of a scene of a run.

    Args:
        run: The run's folder or URI, with the tables ``scenes``, ``assets`` and ``meshes``.
        scene: Its id, or the scene itself, as the loader gives it.
        settled: Objects start at their poses after settling (table ``settled``).
        store: The assets of the run, :func:`stable_data.assets.run_assets.run_store`, to share them between many environments.
        render_mode: ``rgb_array``, or None.
        goal: The goal; None: that of the scene's task.
        options: Fields of :class:`RobotOptions`.

    Raises:
        ConfigError: The run has no such scene, or lacks a table; or an option is invalid.
        SceneError: The scene was never settled, but ``settled`` is set; or see :class:`RobotEnv`.
        GoalError: The task states no goal that can be checked.
        MeshError: An object has no solid part.
    """
    if isinstance(options.get("randomization"), Mapping):
        options["randomization"] = RandomizationOptions(**options["randomization"])
    if isinstance(options.get("cameras"), list):
        options["cameras"] = tuple(options["cameras"])
    chosen = RobotOptions(**options)
    if isinstance(scene, str):
        scenes = RunScenes(RunFolder(run), SceneSelection(scene_ids=(scene,), settled=settled), store)
        row = scenes.row(0)
        geometry, chosen = scenes.geometry(scene_from_row(row), row), options_for(row, chosen)
    else:
        rest = SettledPoses(RunFolder(run)).of(scene.scene_id) if settled else None
        geometry = SceneGeometry.of(scene, store or run_store(run), rest)
    return RobotEnv(geometry, goal, chosen, render_mode)


gymnasium.register("stable_data/Robot-v0", entry_point="stable_data.robot.env:make_robot_env")
