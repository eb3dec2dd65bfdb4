"""Environments of episodes: which scene, which task, which seed. Demonstrations and evaluations take them from here."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipelines.demonstrate.settings import EpisodeSettings
from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import SceneError, StableDataError
from stable_data.robot.env import RobotEnv, options_for
from stable_data.robot.grasp_trial import GraspFinder
from stable_data.robot.pick_tasks import pick_order, with_pick_task
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import scene_from_row

_MOST_DRAWN = 6  # objects that are tried for a pick


@dataclass(frozen=True, slots=True, order=True)
class EpisodeRef:
    """An episode that is to be recorded.

    Attributes:
        scene_id: Its scene.
        number: Its number among the episodes of the scene.
    """

    scene_id: str
    number: int

    def __str__(self) -> str:
        """Its id."""
        return f"{self.scene_id}/{self.number}"


@dataclass(frozen=True, slots=True, eq=False)
class OpenedEpisode:
    """An episode that can begin.

    Attributes:
        env: Its environment.
        seed: Its seed.
        split: Split of its scene.
    """

    env: RobotEnv
    seed: int
    split: str | None


def open_episode(run: str, ref: EpisodeRef, settings: EpisodeSettings) -> OpenedEpisode:
    """Opens the environment of an episode; the scene is kept for its next one.

    Args:
        run: The run of the scenes.
        ref: The episode.
        settings: The robot and the task.

    Raises:
        SceneError, GoalError, MeshError: The episode cannot begin, see :class:`RobotEnv`; or the robot reaches no object
            (``nothing_reachable``).
    """
    seed = int(content_id(settings.seed, str(ref)), 16) % 2**31
    _, row = _geometry(run, ref.scene_id, settings.settled)
    env = _scene_env(run, ref.scene_id, settings) if settings.task == "scene" else _pick_env(run, ref.scene_id, seed, settings)
    return OpenedEpisode(env, seed, row["split"])


@lru_cache(maxsize=1)
def _geometry(run: str, scene_id: str, settled: bool) -> tuple[SceneGeometry, Row]:
    """A scene and its row, kept for its next episode."""
    selection = SceneSelection(scene_ids=(scene_id,), settled=settled)
    scenes = RunScenes(RunFolder(run), selection, _store(run))
    row = scenes.row(0)
    return scenes.geometry(scene_from_row(row), row), row


@lru_cache(maxsize=1)
def _store(run: str) -> AssetStore:
    """The meshes of the run."""
    return run_store(run)


def _scene_env(run: str, scene_id: str, settings: EpisodeSettings) -> RobotEnv:
    found = _opened(run, scene_id, settings)
    if isinstance(found, StableDataError):  # the other episodes of the scene fail for the same reason
        raise found
    return found


@lru_cache(maxsize=1)
def _opened(run: str, scene_id: str, settings: EpisodeSettings) -> RobotEnv | StableDataError:
    """The environment of a scene with its own task, kept for its next episode."""
    geometry, row = _geometry(run, scene_id, settings.settled)
    try:
        env = RobotEnv(geometry, options=options_for(row, settings.options()))
    except StableDataError as error:
        return error
    names = dict.fromkeys(step.subject for step in env.goal.steps)
    reasons = {name: _out_of_reach(env, name) for name in names}
    if None in reasons.values() or not names:
        return env
    why = "; ".join(str(reason) for reason in reasons.values())
    message = f"{scene_id}: the robot can grasp nothing that the task moves ({why}); choose another scene, mount or robot"
    return SceneError(message, "nothing_reachable")


def _pick_env(run: str, scene_id: str, seed: int, settings: EpisodeSettings) -> RobotEnv:
    """The environment with the task to pick up an object that the robot reaches.

    Raises:
        SceneError: There is no such object among the first few that are drawn (``nothing_reachable``).
    """
    geometry, _ = _geometry(run, scene_id, settings.settled)
    names = pick_order(geometry.scene, np.random.default_rng((seed, 2)))
    opened, reasons = _opened_picks(run, scene_id, settings), []
    for name in names[:_MOST_DRAWN]:
        if name not in opened:
            opened[name] = _opened_pick(geometry, name, settings)
        found = opened[name]
        if isinstance(found, RobotEnv):
            return found
        reasons.append(found)
    raise SceneError(
        f"{scene_id}: the robot reaches none of the objects that were drawn ({'; '.join(reasons) or 'there are none'}); "
        "choose another scene, mount or robot",
        "nothing_reachable",
    )


@lru_cache(maxsize=1)
def _opened_picks(run: str, scene_id: str, settings: EpisodeSettings) -> dict[str, RobotEnv | str]:
    """The environments of the picks in a scene, kept for its next episodes, or why an object cannot be picked up."""
    del run, scene_id, settings  # the dictionary is theirs
    return {}


def _opened_pick(geometry: SceneGeometry, name: str, settings: EpisodeSettings) -> RobotEnv | str:
    try:
        env = RobotEnv(with_pick_task(geometry, name), options=settings.options())
    except SceneError as error:
        return error.code
    return _out_of_reach(env, name) or env


def _out_of_reach(env: RobotEnv, name: str) -> str | None:
    """Why the robot can grasp an object nowhere at the start; None if it can."""
    finder = GraspFinder(env.built, env.arm, env.clearance)
    if next(finder.reachable(env.world, name), None) is not None:
        return None
    return f"{name} {finder.survey(env.world, name).reason}"
