"""Targets: episodes of others, which training of policies, exports and verification read."""

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.targets.results import check_finite
from benchmarks.fuzzing.watching import FalsePass
from stable_data.robot.episode_chunks import EpisodeChunks
from stable_data.robot.episodes import Episode, episode_row, read_episodes
from stable_data.robot.lerobot.dataset_writer import EpisodeSelection, write_lerobot
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import arrow_table
from stable_data.verification.verifier import VerifyOptions, verify_run

_HEIGHT, _WIDTH = 4, 6
_STEPS, _HORIZON = 3, 2
_FILE = "episodes/part-00.parquet"
_WORDS = (
    "episode_id",
    "states",
    "actions",
    "pictures",
    "image_size",
    "num_steps",
    "state_names",
    "object_poses",
    "pick",
    "test",
)


def _picture(number: int) -> bytes:
    sink = io.BytesIO()
    Image.fromarray(np.full((_HEIGHT, _WIDTH, 3), 40 * number, np.uint8)).save(sink, "PNG")
    return sink.getvalue()


def _episode(number: int, *, has_pictures: bool) -> Episode:
    rng = np.random.default_rng(number)
    poses = np.zeros((_STEPS + 1, 2, 7), np.float32)
    poses[..., :3] = rng.random(poses[..., :3].shape)
    poses[..., 6] = 1.0
    pictures = {"front": tuple(map(_picture, range(_STEPS)))} if has_pictures else {}
    return Episode(
        episode_id=f"scene-0/{number}",
        scene_id="scene-0",
        seed=number,
        number=number,
        robot="panda",
        task_kind="pick",
        instruction="pick the mug",
        success=number == 0,
        reason=None if number == 0 else "timeout",
        fps=20.0,
        control="joint",
        state_names=("a", "b"),
        environment_state_names=("c",),
        action_names=("a", "b"),
        states=rng.random((_STEPS, 2), np.float32),
        environment_states=rng.random((_STEPS, 1), np.float32),
        actions=rng.random((_STEPS, 2), np.float32),
        rewards=np.zeros(_STEPS, np.float32),
        instances=("1_mug_0", "2_plate_0"),
        object_poses=poses,
        pictures=pictures,
        image_size=(_HEIGHT, _WIDTH) if pictures else None,
        randomization='{"light": 1.0}',
        split="train",
        asset_ids=("mug", "plate"),
        subjects=("1_mug_0",),
    )


def _runs() -> Sequence[Base]:
    found = []
    for name, has_pictures in (("numbers", False), ("pictures", True)):
        sink = io.BytesIO()
        rows = [episode_row(_episode(number, has_pictures=has_pictures)) for number in range(2)]
        pq.write_table(arrow_table("episodes", rows), sink, compression="zstd")
        found.append(Base(name, {_FILE: sink.getvalue()}, {_FILE: 1.0}))
    return found


def _read(folder: Path, base: str) -> bool:
    run = RunFolder(str(folder))
    verify_run(run, lambda _: None, VerifyOptions(1, verdicts="none"))
    for episode in (episodes := list(read_episodes(run.uri, where="success or not success"))):
        check_finite("episode", episode.states, episode.environment_states, episode.actions, episode.object_poses)
        for camera in episode.pictures:
            for number in range(episode.num_steps):
                if episode.decoded_picture(camera, number).shape[:2] != episode.image_size:
                    raise FalsePass(f"picture {number} of {camera} has not the size {episode.image_size} of its episode")
    chunks = EpisodeChunks(episodes, _HORIZON)
    chunks.batch(np.arange(len(chunks)))
    done = write_lerobot(run, Path(tempfile.gettempdir(), "lerobot"), EpisodeSelection(with_failures=True))
    return done.num_frames == len(chunks)


TARGETS = (Target("run_episodes", 5, _runs, _read, _WORDS, block=50),)
"""The targets of this module."""
