"""The hand in demonstrations: what it was told before, and the key frames, in which it begins to close or to open, and the last one."""

import numpy as np

from stable_data.robot.episode_chunks import EpisodeChunks
from stable_data.robot.episodes import FloatArray32
from stable_data.scene import IntArray

_CLOSED = 0.002  # a commanded opening below this closes the hand, metres
_LONG = 16  # actions after which it does not matter when the hand was told something else


class HandMemory:
    """What a policy remembers: whether the hand was told to close, and for how long.

    Without it, a hand that is about to close and one that has just closed on nothing look alike.
    """

    def __init__(self) -> None:
        self._is_closed, self._since = False, _LONG

    @property
    def values(self) -> tuple[float, float]:
        """What the network sees of it: 1 if the hand was told to close, and the share of the longest time since it is told so."""
        return float(self._is_closed), self._since / _LONG

    def told(self, opening: float) -> None:
        """Remembers a commanded opening, metres."""
        is_closed = opening < _CLOSED
        self._since = 1 if is_closed != self._is_closed else min(self._since + 1, _LONG)
        self._is_closed = is_closed


def hand_memories(chunks: EpisodeChunks) -> FloatArray32:
    """Returns what a policy would remember in each frame of demonstrations, (F, 2) float32."""
    found, memory, former = [], HandMemory(), -1
    for episode, opening in zip(chunks.episodes.tolist(), chunks.actions[:, -1].tolist(), strict=True):
        if episode != former:
            memory, former = HandMemory(), episode
        found.append(memory.values)
        memory.told(opening)
    return np.array(found, np.float32)


def next_key_frames(chunks: EpisodeChunks) -> IntArray:
    """Returns for each frame the number of the next key frame of its episode, which may be the frame itself, (F,) int64.

    Args:
        chunks: The demonstrations; the last number of an action is the opening of the hand.
    """
    is_closed = chunks.actions[:, -1] < _CLOSED
    starts = np.append(True, chunks.episodes[1:] != chunks.episodes[:-1])
    is_key = np.append(False, is_closed[1:] != is_closed[:-1]) & ~starts
    is_key[np.append(starts[1:], True)] = True  # the last frames
    numbers = np.where(is_key, np.arange(len(chunks)), len(chunks))
    return np.minimum.accumulate(numbers[::-1])[::-1].astype(np.int64)


def opening_before(chunks: EpisodeChunks, frames: IntArray) -> FloatArray32:
    """Returns the commanded opening of the hand on the way to key frames, (F,) float32, metres: that of the frame before each one.

    Args:
        chunks: The demonstrations.
        frames: Numbers of key frames, (F,).
    """
    before = np.maximum(frames - 1, 0)
    before = np.where(chunks.episodes[before] == chunks.episodes[frames], before, frames)
    return np.asarray(chunks.actions[before, -1])
