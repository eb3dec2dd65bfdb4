"""Episodes of a policy: it acts in an environment until the goal is fulfilled or the time is up."""

from collections.abc import Callable
from typing import TypeVar

from stable_data.errors import ConfigError, StableDataError
from stable_data.limits import is_out_of_memory
from stable_data.robot.acting.episode_log import EpisodeLog
from stable_data.robot.acting.policies import ActingPolicy, actions_of
from stable_data.robot.env import RobotEnv
from stable_data.robot.episodes import Episode

R = TypeVar("R")


def run_policy(env: RobotEnv, policy: ActingPolicy, name: str, *, number: int, seed: int, split: str | None = None) -> Episode:
    """Lets a policy act in an environment once.

    Args:
        env: The environment.
        policy: The policy.
        name: Its name, for the episode.
        number: Number of the episode of its scene.
        seed: Seed of the environment.
        split: Split of the scene.

    Returns:
        The episode, successful or not: the reason of a failure is ``too_long`` or ``diverged``.

    Raises:
        ConfigError: The policy gives no actions (``policy_invalid``), or fails (``policy_failed``). This ends an evaluation, because
            an episode that is left out would not count as a failure.
    """
    observation, _ = env.reset(seed=seed)
    log = EpisodeLog(env, observation)
    _call(name, "reset", policy.reset)
    while True:
        actions = _call(name, "act", lambda: list(actions_of(policy, log.observation, len(env.controller.low), name)))
        for action in actions:
            if log.carry_out(action):
                return log.episode(number, seed, split, policy=name)


def _call(name: str, method: str, function: Callable[[], R]) -> R:
    try:
        return function()
    except StableDataError:
        raise
    except Exception as error:
        if is_out_of_memory(error):
            raise
        line = " ".join(str(error).split())
        raise ConfigError(
            f"policy {name}: {method}() raised {type(error).__name__}: {line}; correct the policy and run again",
            "policy_failed",
        ) from error
