"""Chunks of actions for training a policy: the states of all frames and the actions that follow each one, as numpy arrays."""

from collections.abc import Iterable, Iterator
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from stable_data.errors import ConfigError
from stable_data.robot.episodes import Episode, FloatArray32
from stable_data.scene import IntArray


class ChunkBatch(TypedDict):
    """B frames and the H actions from each one on.

    Attributes:
        states: States of the robot, (B, S) float32.
        environment_states: States of the environment, (B, E) float32.
        actions: The action of each frame and the H - 1 that follow; after the end of the episode the last one, (B, H, A) float32.
        is_padding: Whether an action is after the end of the episode, (B, H) bool.
        episodes: Number of the episode of each frame, an index of :attr:`EpisodeChunks.instructions`, (B,) int64.
    """

    states: FloatArray32
    environment_states: FloatArray32
    actions: FloatArray32
    is_padding: npt.NDArray[np.bool_]
    episodes: IntArray


class EpisodeChunks:
    """The frames of some episodes in memory, ``4 (S + E + A)`` bytes each, and the chunks of actions that start at them.

    ::

        chunks = EpisodeChunks(read_episodes(RUN, where="success", split="train", with_pictures=False), horizon=16)
        for batch in chunks.batches(256, seed=0, epoch=epoch):
            ...

    Args:
        episodes: Episodes with the same features.
        horizon: Number of actions H of a chunk.

    Attributes:
        features: The features of the episodes.
        horizon: The argument.
        states: (F, S) float32.
        environment_states: (F, E) float32.
        actions: (F, A) float32.
        episodes: Number of the episode of each frame, (F,) int64.
        instructions: Instruction of each episode.

    Raises:
        ConfigError: There is no episode (``episode_unknown``), or the horizon is less than 1 (``setting_invalid``).
        EpisodeError: The episodes have different features (``episodes_mixed``).
    """

    def __init__(self, episodes: Iterable[Episode], horizon: int) -> None:
        if horizon < 1:
            raise ConfigError(f"horizon is {horizon}, expected at least 1 action", "setting_invalid")
        found, arrays, instructions = None, list[tuple[FloatArray32, FloatArray32, FloatArray32]](), list[str]()
        for episode in episodes:
            found = found or episode.features
            found.check_same(episode.features, episode.episode_id)
            arrays.append((episode.states, episode.environment_states, episode.actions))
            instructions.append(episode.instruction)
        if found is None:
            raise ConfigError("no episode is selected, expected at least one; change the condition", "episode_unknown")
        self.features, self.horizon, self.instructions = found, horizon, tuple(instructions)
        self.states, self.environment_states, self.actions = (np.concatenate(of_kind) for of_kind in zip(*arrays, strict=True))
        counts = [len(actions) for _, _, actions in arrays]
        self.episodes: IntArray = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
        self._last = np.cumsum(counts, dtype=np.int64)[self.episodes] - 1  # last frame of the episode of each frame

    def __len__(self) -> int:
        """Number of frames F."""
        return len(self.actions)

    def batch(self, frames: IntArray) -> ChunkBatch:
        """Returns some frames with their chunks.

        Args:
            frames: Numbers of frames, (B,) int64.
        """
        places = frames[:, None] + np.arange(self.horizon)  # (B, H)
        last = self._last[frames][:, None]
        return ChunkBatch(
            states=self.states[frames],
            environment_states=self.environment_states[frames],
            actions=self.actions[np.minimum(places, last)],
            is_padding=places > last,
            episodes=self.episodes[frames],
        )

    def batches(self, size: int, *, seed: int, epoch: int = 0) -> Iterator[ChunkBatch]:
        """Yields every frame once, in an order that depends on the seed and the epoch alone; the last batch may be smaller."""
        order = np.random.default_rng((seed, epoch)).permutation(len(self))
        for start in range(0, len(order), size):
            yield self.batch(order[start : start + size])
