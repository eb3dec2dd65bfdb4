"""The step of the demonstrate job: the episodes of scenes."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from stable_data.robot.episodes import episode_row

from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from stable_data.content_id import content_id
from stable_data.errors import StableDataError
from stable_data.robot.env import RobotEnv
from stable_data.robot.recording import record_episode
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder


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
        progress.step = "scene"
        env, split = _environment(self.run, item.scene_id, self.settings)
        progress.step = "episode"
        seed = int(content_id(self.settings.seed, str(item)), 16) % 2**31
        episode = record_episode(env, number=item.number, seed=seed, split=split, noise=self.settings.noise)
        return {"episodes": [episode_row(episode)]}


def _environment(run: str, scene_id: str, settings: DemonstrateSettings) -> tuple[RobotEnv, str | None]:
    found = _opened(run, scene_id, settings)
    if isinstance(found, StableDataError):  # the other episodes of the scene fail for the same reason
        raise found
    return found


@lru_cache(maxsize=1)
def _opened(run: str, scene_id: str, settings: DemonstrateSettings) -> tuple[RobotEnv, str | None] | StableDataError:
    """The environment of a scene and its split, kept for its next episode."""
    scenes = _scenes(run)
    selection = SceneSelection(scene_ids=(scene_id,), settled=settings.settled)
    chosen = RunScenes(RunFolder(run), selection, scenes.store)
    row = chosen.row(0)
    scene = next(iter(chosen))
    try:
        return RobotEnv(chosen.geometry(scene, row), options=settings.options()), row["split"]
    except StableDataError as error:
        return error


@lru_cache(maxsize=1)
def _scenes(run: str) -> RunScenes:
    """The run, with its meshes open."""
    return RunScenes(RunFolder(run))
