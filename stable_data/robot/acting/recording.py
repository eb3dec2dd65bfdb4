"""Episodes of the scripted expert: it acts in the environment, and everything is written down."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from stable_data.condition import ConditionKind
from stable_data.errors import GoalError
from stable_data.robot.acting.episode_log import EpisodeLog
from stable_data.robot.acting.policies import ActingPolicy, actions_of
from stable_data.robot.env import Observation, RobotEnv
from stable_data.robot.episodes import Episode, EpisodeError
from stable_data.robot.expert import Command, Expert, ExpertError, ExpertFailure
from stable_data.robot.grasp_trial import GraspFinder
from stable_data.tasks.goal import StepAction

_SLACK = 10  # actions for which the arm keeps still after a replay


@dataclass(frozen=True, slots=True)
class Lead:
    """A policy that acts before the expert, so that there are demonstrations from where the policy comes to.

    Attributes:
        policy: The policy.
        name: Its name, for errors and for the episode.
        most_actions: Actions of the policy at most; their number is drawn from 0 to this.
    """

    policy: ActingPolicy
    name: str
    most_actions: int


def record_episode(
    env: RobotEnv, *, number: int, seed: int, split: str | None = None, noise: float = 0.0, lead: Lead | None = None
) -> Episode:
    """Lets the expert carry out the task of an environment once.

    Args:
        env: The environment.
        number: Number of the episode of its scene.
        seed: Seed of the environment, of the expert, of the noise and of the lead.
        split: Split of the scene.
        noise: Standard deviation of what is added to each action but the opening of the hand, as a share of the largest action; the
            expert corrects it, so that policies see how to come back. The actions of the episode are those that were carried out.
        lead: A policy that acts first. Its actions are not part of the episode, which begins where the expert takes over.

    Returns:
        The episode, successful or not. One without any action has one that keeps the arm still.
    """
    observation, _ = env.reset(seed=seed)
    rng = np.random.default_rng((seed, 1))
    after_lead = None if lead is None else _follow(env, observation, lead, seed)
    log = EpisodeLog(env, observation if after_lead is None else after_lead)
    spread = noise * (env.controller.high - env.controller.low) / 2
    spread[-1] = 0.0
    gave_up: str | None = None
    try:
        for command in task_commands(env, seed):
            action = env.controller.action_for(command.joints, command.opening)
            action = np.clip(action + spread * rng.normal(size=len(spread)), env.controller.low, env.controller.high)
            if log.carry_out(action.astype(np.float32)):
                break
    except ExpertError as error:
        gave_up = str(error)
    except GoalError as error:  # no free place is left
        gave_up = f"{ExpertFailure.NO_PLACE}: {error.code}"
    if not log.actions:
        log.carry_out(env.controller.action_for(env.world.commanded_joints, env.world.opening))
    return log.episode(number, seed, split, gave_up=gave_up, lead=None if lead is None or after_lead is None else lead.name)


def _follow(env: RobotEnv, observation: Observation, lead: Lead, seed: int) -> Observation | None:
    """Lets a policy act for a while; returns what is observed then, or None if it did nothing after the reset.

    The expert takes over with an empty hand. If the policy ends the episode, it begins anew with half as many actions.
    """
    count = int(np.random.default_rng((seed, 3)).integers(lead.most_actions + 1))
    while count:
        lead.policy.reset()
        done = has_ended = False
        steps = 0
        while not (done or has_ended):
            for action in actions_of(lead.policy, observation, len(env.controller.low), lead.name):
                observation, _, terminated, truncated, _ = env.step(action)
                steps, has_ended = steps + 1, terminated or truncated
                done = steps >= count and not env.world.contacts().gripped
                if done or has_ended:
                    break
        if not has_ended:
            return observation
        observation, _ = env.reset(seed=seed)
        count = min(count, steps) // 2
    return None


def task_commands(env: RobotEnv, seed: int) -> Iterator[Command]:
    """Yields what the expert does for each step of the goal that is not done, and waits at the end.

    If the open hand would touch something where it is, it is opened and moved back first.

    Raises:
        ExpertError: It gives up.
    """
    expert = Expert(GraspFinder(env.built, env.arm, env.clearance), env.world, seed)
    held: str | None = None
    env.clearance.look(env.world)
    if env.clearance.hits(env.world.commanded_joints, env.built.robot.hand.max_opening) is not None:
        yield from expert.withdraw()
    for number, step in enumerate(env.goal.steps):
        if env.progress.is_done(number):
            continue
        if step.subject != held:
            yield from expert.pick(step.subject)
            held = step.subject
        if step.action is StepAction.CARRY:
            yield from expert.carry(step.subject, env.progress.places(step))
        elif step.action is not StepAction.PICK:
            may_turn = not any(c.kind is ConditionKind.FACING for c in step.conditions)
            yield from expert.place(step.subject, env.progress.places(step), may_turn=may_turn)
            held = None
    yield from expert.rest()


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What became of an episode whose actions were carried out again.

    Attributes:
        object_poses: Poses of the objects at the start and after each action, (T + 1, N, 7), as ``Episode.object_poses``; fewer if
            the simulation diverged.
        is_success: Whether the goal was fulfilled, at the latest half a second after the last action.
    """

    object_poses: np.ndarray[Any, np.dtype[np.float64]]
    is_success: bool


def replay(env: RobotEnv, episode: Episode) -> Replay:
    """Carries out the actions of an episode again, from the same start of the arm.

    With the options with which the episode was recorded the poses are the same. With another
    :attr:`stable_data.robot.env.RobotOptions.randomization` of friction or mass the replay shows whether the episode holds there too.

    Raises:
        EpisodeError: A policy acted before the expert (:class:`Lead`), so that the episode does not begin at the reset (``episode_led``).
    """
    if episode.lead is not None:
        raise EpisodeError(
            f"{episode.episode_id}: policy {episode.lead} acted before the first action, expected an episode that begins at the reset",
            "episode_led",
        )
    env.reset(seed=episode.seed)
    poses, is_success, has_diverged = [env.world.object_poses], False, False
    for action in episode.actions:
        _, _, terminated, _, info = env.step(action)
        is_success = is_success or info["is_success"]
        has_diverged = terminated and not info["is_success"]
        poses.append(env.world.object_poses)
        if has_diverged:
            break
    for _ in range(0 if has_diverged else _SLACK):  # under other physics the goal may be fulfilled a little later
        if is_success:
            break
        is_success = env.step(env.controller.action_for(env.world.commanded_joints, episode.actions[-1, -1]))[-1]["is_success"]
    return Replay(np.array(poses), is_success)
