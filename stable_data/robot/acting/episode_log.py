"""What happens in an episode, written down step by step."""

import io
from typing import Any

import numpy as np
from PIL import Image

from stable_data.robot.arm.control import CONTROL_SECONDS
from stable_data.robot.env import AGENT, ENVIRONMENT, PIXELS, Observation, RobotEnv
from stable_data.robot.episodes import Episode, EpisodeFeatures
from stable_data.robot.observation import ENVIRONMENT_STATE_NAMES, state_names
from stable_data.simulation.offscreen import Picture

DIVERGED, NOT_FULFILLED, TOO_LONG = "diverged", "not_fulfilled", "too_long"
"""Why an episode failed in which nobody gave up."""


class EpisodeLog:
    """What happens in an episode.

    Args:
        env: The environment, after its reset.
        observation: What is observed at the start.

    Attributes:
        observation: What is observed now.
        actions: The actions until now, each (A,) float32.
        is_success: Whether the goal is fulfilled.
    """

    def __init__(self, env: RobotEnv, observation: Observation) -> None:
        self._env, self.observation = env, observation
        self.actions: list[Any] = []
        self._states: list[Any] = []
        self._environment: list[Any] = []
        self._rewards: list[float] = []
        self._poses = [env.world.object_poses]
        self._pictures: dict[str, list[bytes]] = {name: [] for name in env.options.cameras}
        self.is_success = self._has_diverged = self._is_truncated = False

    def carry_out(self, action: np.ndarray[Any, np.dtype[np.float32]]) -> bool:
        """Carries out an action; returns whether the episode has ended."""
        before = self.observation
        self._states.append(before[AGENT])
        self._environment.append(before[ENVIRONMENT])
        for name, files in self._pictures.items():
            files.append(png(before[PIXELS][name]))
        self.actions.append(action)
        self.observation, reward, terminated, truncated, info = self._env.step(action)
        self._rewards.append(reward)
        self._poses.append(self._env.world.object_poses)
        self.is_success, self._is_truncated = info["is_success"], truncated
        self._has_diverged = terminated and not self.is_success
        return terminated or truncated

    def episode(
        self,
        number: int,
        seed: int,
        split: str | None,
        *,
        gave_up: str | None = None,
        policy: str | None = None,
        lead: str | None = None,
    ) -> Episode:
        """Returns the episode, successful or not.

        Args:
            number: Number of the episode of its scene.
            seed: Seed of the environment.
            split: Split of the scene.
            gave_up: Why whoever acted gave up before the end; None: it did not.
            policy: Name of the policy that acted; None: the scripted expert.
            lead: Name of the policy that acted before this log began; None: none did.
        """
        env, scene, reason = self._env, self._env.scene, self._failure(gave_up)
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
            policy=policy,
            lead=lead,
            asset_ids=tuple(scene[name].asset_id or "" for name in env.built.names),
            subjects=tuple(dict.fromkeys(step.subject for step in env.goal.steps)),
        )

    def _failure(self, gave_up: str | None) -> str | None:
        if self.is_success:
            return None
        if self._has_diverged:
            return DIVERGED
        if gave_up is not None:
            return gave_up
        left = "; ".join(self._env.progress.unfulfilled())
        return TOO_LONG if self._is_truncated else f"{NOT_FULFILLED}: {left}" if left else NOT_FULFILLED


def png(picture: Picture) -> bytes:
    """Returns a picture (H, W, 3) uint8 as a PNG file."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG", compress_level=3)
    return file.getvalue()


def features_of(env: RobotEnv) -> EpisodeFeatures:
    """Returns what an environment shows and takes, as its episodes state it."""
    width, height = env.options.image_size
    return EpisodeFeatures(
        env.options.robot,
        1 / CONTROL_SECONDS,
        env.options.control,
        state_names(env.built),
        ENVIRONMENT_STATE_NAMES,
        env.controller.names,
        env.options.cameras,
        (height, width) if env.options.cameras else None,
    )
