"""What the jobs that make episodes share: which scenes, which episodes, how they are split into shards."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import stable_data
from pipelines.demonstrate.environments import EpisodeRef
from pipelines.demonstrate.settings import EpisodeSettings
from pipelines.execution.shard_job import ExpectedItems, ShardJob
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, ShardStep, StepShards
from pipelines.sources.run_scenes import ScenesOfRun
from stable_data.content_id import content_id
from stable_data.robot.arm.robots import robot_named
from stable_data.storage import schemas


class EpisodesJob(ShardJob):
    """Makes episodes in the scenes of a run, as the table ``episodes``; those of a scene are in one shard.

    Args:
        scenes: The run, with the tables ``scenes``, ``assets`` and ``meshes``; every node of a cluster must see it.
        settings: The job's settings.
        where: A condition on ``scenes``; empty: all of them.

    Raises:
        ConfigError: The run lacks a table, the condition is none or selects nothing, or the files of the robot are missing.
    """

    settings: EpisodeSettings

    def __init__(self, scenes: str, settings: EpisodeSettings, where: str = "") -> None:
        robot_named(settings.robot)
        self.settings, self.scenes = settings, ScenesOfRun(scenes, where, settled=settings.settled)
        self.dataset = self.scenes.name

    @abstractmethod
    def step(self) -> ShardStep[EpisodeRef]:
        """The step that makes the episodes."""

    @property
    def _episodes(self) -> Sequence[tuple[EpisodeRef, ...]]:
        """The episodes of each scene."""
        return [tuple(EpisodeRef(name, number) for number in range(self.settings.episodes)) for name in self.scenes.ids]

    def about(self) -> dict[str, Any]:
        """The number of scenes and of episodes."""
        count = len(self.scenes.ids)
        return {"num_scenes": count, "num_episodes": count * self.settings.episodes}

    def plan(self) -> Sequence[StepShards[Any]]:
        """The step of all episodes."""
        shaping = self.settings.shaping() | {"table_version": schemas.TABLE_VERSION, "code": stable_data.__version__}
        inputs, shards = self.inputs(), []
        for group in split_groups(self._episodes, self.settings.shard_size(len(self.scenes.ids))):
            refs = tuple(ref for episodes in group for ref in episodes)
            scene_ids = [episodes[0].scene_id for episodes in group]
            shards.append(Shard(content_id(self.name, shaping, inputs, scene_ids), refs))
        return [StepShards(self.step(), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All episodes."""
        ids = [str(ref) for episodes in self._episodes for ref in episodes]
        return [ExpectedItems("episodes", "episode_id", ids, "failed_episodes")]
