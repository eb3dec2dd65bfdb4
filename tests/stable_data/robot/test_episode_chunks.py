"""Chunks of actions: each frame once an epoch, with the actions that follow it, and none of another episode."""

from pathlib import Path

import numpy as np
import pytest

from stable_data.errors import ConfigError
from stable_data.robot.episode_chunks import EpisodeChunks
from stable_data.robot.episodes import EpisodeError, read_episodes
from tests.stable_data.robot.synthetic_episodes import episode, write_run

EPISODES = [episode(f"scene-{k}", k % 2, steps=3 + 4 * k) for k in range(4)]


def test_a_chunk_has_the_actions_that_follow(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", EPISODES)
    chunks = EpisodeChunks(read_episodes(run.uri, with_pictures=False), horizon=5)
    assert len(chunks) == sum(e.num_steps for e in EPISODES)
    batch, frame = chunks.batch(np.arange(len(chunks))), 0
    for number, one in enumerate(EPISODES):
        for step in range(one.num_steps):
            places = step + np.arange(5)
            assert np.array_equal(batch["states"][frame], one.states[step])
            assert np.array_equal(batch["environment_states"][frame], one.environment_states[step])
            assert np.array_equal(batch["actions"][frame], one.actions[np.minimum(places, one.num_steps - 1)])
            assert np.array_equal(batch["is_padding"][frame], places >= one.num_steps)
            assert chunks.instructions[batch["episodes"][frame]] == EPISODES[number].instruction
            frame += 1


def test_an_epoch_has_each_frame_once_in_an_order_of_its_own() -> None:
    chunks = EpisodeChunks(EPISODES, horizon=2)

    def order(seed: int, epoch: int) -> list[float]:
        return [float(state) for batch in chunks.batches(7, seed=seed, epoch=epoch) for state in batch["states"][:, 0]]

    first = order(0, 0)
    assert sorted(first) == sorted(chunks.states[:, 0].tolist())
    assert first == order(0, 0)
    assert len({tuple(order(s, e)) for s in range(2) for e in range(2)}) == 4
    assert [len(batch["actions"]) for batch in chunks.batches(7, seed=0)] == [7] * 5 + [1]


def test_what_cannot_be_used_is_refused() -> None:
    with pytest.raises(ConfigError, match="no episode is selected"):
        EpisodeChunks([], horizon=2)
    with pytest.raises(ConfigError, match="horizon is 0"):
        EpisodeChunks(EPISODES, horizon=0)
    with pytest.raises(EpisodeError, match=r"scene-9/0: fps is 10.0, expected 20.0 as in the first episode"):
        EpisodeChunks([*EPISODES, episode("scene-9", fps=10.0)], horizon=2)
