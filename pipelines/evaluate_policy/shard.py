"""The step of the evaluate-policy job: the episodes of a policy."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

from models.policy.chunk_policy import OpenedPolicy, open_policy
from models.policy.weights import check_environment
from pipelines.demonstrate.environments import EpisodeRef, open_episode
from pipelines.evaluate_policy.settings import EvaluatePolicySettings
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows
from stable_data.robot.acting.episode_log import features_of
from stable_data.robot.acting.recording import record_episode
from stable_data.robot.acting.rollout import run_policy
from stable_data.robot.env import RobotEnv
from stable_data.robot.episodes import episode_row

EXPERT = "expert"
"""Name of the scripted expert, which knows the simulation's state; a line of reference."""

OPENING = "scene"
"""Step of a failure of an episode that never began; any other failure is one of the policy."""


@dataclass(frozen=True, slots=True)
class EvaluatePolicyStep(ItemStep[EpisodeRef]):
    """Lets a policy act.

    Attributes:
        run: The run of the scenes; readable for every worker.
        policy: The policy as :func:`open_policy` takes it, or ``expert``; readable for every worker.
        settings: The job's settings.
    """

    TABLES: ClassVar = ("warnings", "failures", "episodes")
    UNIT: ClassVar = "episode"

    run: str
    policy: str
    settings: EvaluatePolicySettings

    @property
    def seconds_per_item(self) -> float:
        """The time limit of an episode, seconds."""
        return self.settings.seconds_per_item

    def prepare(self, item: EpisodeRef) -> None:
        """Opens the policy."""
        if self.policy != EXPERT:
            _opened(self.policy)

    def item_rows(self, item: EpisodeRef, progress: ItemProgress) -> Rows:
        """The row of one episode."""
        progress.step = OPENING
        found = open_episode(self.run, item, self.settings)
        progress.step = "act"
        if self.policy == EXPERT:
            episode = record_episode(found.env, number=item.number, seed=found.seed, split=found.split)
            episode = replace(episode, policy=EXPERT)
        else:
            opened = _opened(self.policy)
            _check(opened, found.env)
            episode = run_policy(found.env, opened.policy, opened.name, number=item.number, seed=found.seed, split=found.split)
        return {"episodes": [episode_row(episode)]}


def _check(policy: OpenedPolicy, env: RobotEnv) -> None:
    if policy.features is not None:
        check_environment(policy.features, features_of(env), policy.name)


@lru_cache(maxsize=1)
def _opened(name: str) -> OpenedPolicy:
    return open_policy(name)
