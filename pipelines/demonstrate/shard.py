"""The step of the demonstrate job: the episodes of scenes."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from pipelines.demonstrate.environments import EpisodeRef, open_episode
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from stable_data.robot.acting.recording import Lead, record_episode
from stable_data.robot.episodes import episode_row


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
            lead=_lead(settings.lead, settings.lead_actions) if settings.lead else None,
        )
        return {"episodes": [episode_row(episode)]}


@lru_cache(maxsize=1)
def _lead(name: str, most_actions: int) -> Lead:
    from models.policy.chunk_policy import open_policy  # takes seconds to import

    return Lead(open_policy(name).policy, name, most_actions)
