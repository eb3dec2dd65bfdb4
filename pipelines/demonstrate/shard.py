"""The step of the demonstrate job: the episodes of scenes."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import SceneError, StableDataError
from stable_data.robot.env import RobotEnv, options_for
from stable_data.robot.episodes import episode_row
from stable_data.robot.grasp_trial import GraspFinder
from stable_data.robot.pick_tasks import pick_order, with_pick_task
from stable_data.robot.recording import record_episode
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


@dataclass(frozen=True, slots=True)
class DemonstrateStep(ItemStep[EpisodeRef]):
    """Records episodes.

    Attributes:
        run: The run of the scenes; readable for every worker.
        settings: The job's settings.
    """

    TABLES: ClassVar = ("warnings", "failures", "episodes")
    UNIT: ClassVar = "episode"

    run: str
    settings: DemonstrateSettings

    @property
    def seconds_per_item(self) -> float:
        """The time limit of an episode, seconds."""
        return self.settings.seconds_per_item

    def item_rows(self, item: EpisodeRef, progress: ItemProgress) -> Rows:
        """The row of one episode."""
        settings = self.settings
        seed = int(content_id(settings.seed, str(item)), 16) % 2**31
        progress.step = "scene"
        geometry, row = _geometry(self.run, item.scene_id, settings.settled)
        progress.step = "episode"
        env = _scene_env(self.run, item.scene_id, settings) if settings.task == "scene" else _pick_env(geometry, seed, settings)
        episode = record_episode(env, number=item.number, seed=seed, split=row["split"], noise=settings.noise)
        return {"episodes": [episode_row(episode)]}


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


def _scene_env(run: str, scene_id: str, settings: DemonstrateSettings) -> RobotEnv:
    found = _opened(run, scene_id, settings)
    if isinstance(found, StableDataError):  # the other episodes of the scene fail for the same reason
        raise found
    return found


@lru_cache(maxsize=1)
def _opened(run: str, scene_id: str, settings: DemonstrateSettings) -> RobotEnv | StableDataError:
    """The environment of a scene with its own task, kept for its next episode."""
    geometry, row = _geometry(run, scene_id, settings.settled)
    try:
        return RobotEnv(geometry, options=options_for(row, settings.options()))
    except StableDataError as error:
        return error


def _pick_env(geometry: SceneGeometry, seed: int, settings: DemonstrateSettings) -> RobotEnv:
    """The environment with the task to pick up an object that the robot reaches.

    Raises:
        SceneError: There is no such object among the first few that are drawn (``nothing_reachable``).
    """
    names = pick_order(geometry.scene, np.random.default_rng((seed, 2)))
    reasons = []
    for name in names[:_MOST_DRAWN]:
        try:
            env = RobotEnv(with_pick_task(geometry, name), options=settings.options())
        except SceneError as error:
            reasons.append(error.code)
            continue
        survey = GraspFinder(env.built, env.arm, env.clearance).survey(env.world, name)
        if survey.reachable:
            return env
        reasons.append(f"{name} {survey.reason}")
    raise SceneError(
        f"{geometry.scene.scene_id}: the robot reaches none of the objects that were drawn ({'; '.join(reasons) or 'there are none'}); "
        "choose another scene, mount or robot",
        "nothing_reachable",
    )
