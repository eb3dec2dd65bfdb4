"""The step of the demonstrate job: the episodes of scenes."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

from pipelines.demonstrate.environments import EpisodeRef, open_episode
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from stable_data.robot.acting.episode_log import features_of
from stable_data.robot.acting.recording import Lead, record_episode
from stable_data.robot.env import RobotEnv
from stable_data.robot.episodes import episode_row

if TYPE_CHECKING:
    from models.policy.chunk_policy import OpenedPolicy


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
        progress.step = "scene"
        found = open_episode(self.run, item, settings)
        progress.step = "episode"
        episode = record_episode(
            found.env,
            number=item.number,
            seed=found.seed,
            split=found.split,
            noise=settings.noise,
            lead=_lead(settings.lead, settings.lead_actions, found.env) if settings.lead else None,
        )
        return {"episodes": [episode_row(episode)]}


def _lead(name: str, most_actions: int, env: RobotEnv) -> Lead:
    from models.policy.weights import check_environment

    opened = _opened(name)
    if opened.features is not None:
        check_environment(opened.features, features_of(env), opened.name)
    return Lead(opened.policy, name, most_actions)


@lru_cache(maxsize=1)
def _opened(name: str) -> "OpenedPolicy":
    from models.policy.chunk_policy import open_policy  # takes seconds to import

    return open_policy(name)
