"""Key frames of demonstrations: those in which the hand begins to close or to open, and the last one."""

import numpy as np

from stable_data.robot.episode_chunks import EpisodeChunks
from stable_data.scene import IntArray

_CLOSED = 0.002  # a commanded opening below this closes the hand, metres


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
