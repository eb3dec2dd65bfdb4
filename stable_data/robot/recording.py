"""Episodes of the scripted expert: it acts in the environment, and everything is written down."""

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
from PIL import Image

from stable_data.condition import ConditionKind
from stable_data.errors import GoalError
from stable_data.robot.env import AGENT, CONTROL_SECONDS, ENVIRONMENT, PIXELS, Observation, RobotEnv
from stable_data.robot.episodes import Episode
from stable_data.robot.expert import Command, Expert, ExpertError, ExpertFailure
from stable_data.robot.grasp_trial import GraspFinder
from stable_data.robot.observation import ENVIRONMENT_STATE_NAMES, state_names
from stable_data.simulation.offscreen import Picture
from stable_data.tasks.goal import StepAction

DIVERGED, NOT_FULFILLED, TOO_LONG = "diverged", "not_fulfilled", "too_long"
"""Why an episode failed in which the expert did not give up."""


def record_episode(env: RobotEnv, *, number: int, seed: int, split: str | None = None, noise: float = 0.0) -> Episode:
    """Lets the expert carry out the task of an environment once.

    Args:
        env: The environment.
        number: Number of the episode of its scene.
        seed: Seed of the environment, of the expert and of the noise.
        split: Split of the scene.
        noise: Standard deviation of what is added to each action but the opening of the hand, as a share of the largest action; the
            expert corrects it, so that policies see how to come back. The actions of the episode are those that were carried out.

    Returns:
        The episode, successful or not. One without any action has one that keeps the arm still.
    """
    observation, _ = env.reset(seed=seed)
    log = _Log(env, observation)
    rng = np.random.default_rng((seed, 1))
    spread = noise * (env.controller.high - env.controller.low) / 2
    spread[-1] = 0.0
    reason: str | None = NOT_FULFILLED
    try:
        for command in task_commands(env, seed):
            action = env.controller.action_for(command.joints, command.opening)
            action = np.clip(action + spread * rng.normal(size=len(spread)), env.controller.low, env.controller.high)
            if log.carry_out(action.astype(np.float32)):
                break
    except ExpertError as error:
        reason = str(error)
    except GoalError as error:  # no free place is left
        reason = f"{ExpertFailure.NO_PLACE}: {error.code}"
    if not log.actions:
        log.carry_out(env.controller.action_for(env.world.commanded_joints, env.world.opening))
    if log.is_success:
        reason = None
    elif log.has_diverged:
        reason = DIVERGED
    elif reason == NOT_FULFILLED:
        left = "; ".join(env.progress.unfulfilled())
        reason = TOO_LONG if log.is_truncated else f"{NOT_FULFILLED}: {left}" if left else NOT_FULFILLED
    return log.episode(number, seed, split, reason)


def task_commands(env: RobotEnv, seed: int) -> Iterator[Command]:
    """Yields what the expert does for each step of the goal that is not done, and waits at the end.

    Raises:
        ExpertError: It gives up.
    """
    expert = Expert(GraspFinder(env.built, env.arm, env.clearance), env.world, seed)
    held: str | None = None
    for number, step in enumerate(env.goal.steps):
        if env.progress.is_done(number):
            continue
        if step.subject != held:
            yield from expert.pick(step.subject)
            held = step.subject
        if step.action is not StepAction.PICK:
            may_turn = not any(c.kind is ConditionKind.FACING for c in step.conditions)
            yield from expert.place(step.subject, env.progress.places(step), may_turn=may_turn)
            held = None
    yield from expert.rest()


class _Log:
    """What happens in an episode."""

    def __init__(self, env: RobotEnv, observation: Observation) -> None:
        self._env, self._observation = env, observation
        self.actions: list[Any] = []
        self._states: list[Any] = []
        self._environment: list[Any] = []
        self._rewards: list[float] = []
        self._poses = [env.world.object_poses]
        self._pictures: dict[str, list[bytes]] = {name: [] for name in env.options.cameras}
        self.is_success = self.has_diverged = self.is_truncated = False

    def carry_out(self, action: np.ndarray[Any, np.dtype[np.float32]]) -> bool:
        """Carries out an action; returns whether the episode has ended."""
        before = self._observation
        self._states.append(before[AGENT])
        self._environment.append(before[ENVIRONMENT])
        for name, files in self._pictures.items():
            files.append(png(before[PIXELS][name]))
        self.actions.append(action)
        self._observation, reward, terminated, truncated, info = self._env.step(action)
        self._rewards.append(reward)
        self._poses.append(self._env.world.object_poses)
        self.is_success, self.is_truncated = info["is_success"], truncated
        self.has_diverged = terminated and not self.is_success
        return terminated or truncated

    def episode(self, number: int, seed: int, split: str | None, reason: str | None) -> Episode:
        env, scene = self._env, self._env.scene
        height, width = env.options.image_size[1], env.options.image_size[0]
        return Episode(
            episode_id=f"{scene.scene_id}/{number}",
            scene_id=scene.scene_id,
            seed=seed,
            number=number,
            robot=env.options.robot,
            task_kind=env.task,
            instruction=env.task_description,
            success=reason is None,
            reason=reason,
            fps=1 / CONTROL_SECONDS,
            control=env.options.control,
            state_names=state_names(env.built),
            environment_state_names=ENVIRONMENT_STATE_NAMES,
            action_names=env.controller.names,
            states=np.array(self._states),
            environment_states=np.array(self._environment),
            actions=np.array(self.actions),
            rewards=np.array(self._rewards, np.float32),
            instances=env.built.names,
            object_poses=np.array(self._poses),
            pictures={name: tuple(files) for name, files in self._pictures.items()},
            image_size=(height, width) if env.options.cameras else None,
            randomization=None if env.drawn is None else env.drawn.text,
            split=split,
        )


def png(picture: Picture) -> bytes:
    """Returns a picture (H, W, 3) uint8 as a PNG file."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=3)
    return file.getvalue()


def replayed_poses(env: RobotEnv, episode: Episode) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Carries out the actions of an episode again; the poses of the objects, (T + 1, N, 7), as ``Episode.object_poses``.

    The environment has the options with which the episode was recorded.
    """
    env.reset(seed=episode.seed)
    poses = [env.world.object_poses]
    for action in episode.actions:
        env.step(action)
        poses.append(env.world.object_poses)
    return np.array(poses)
