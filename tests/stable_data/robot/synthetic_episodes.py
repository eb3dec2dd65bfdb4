"""Episodes of smooth random arrays and small pictures, for tests of how episodes are stored and read."""

import io
from typing import Any

import numpy as np
import numpy.typing as npt

from stable_data.content_id import content_id
from stable_data.random_seeds import named_seed
from stable_data.robot.episodes import Episode, episode_row
from stable_data.storage.run_folder import RunFolder

JOINTS = tuple(f"joint_{k}" for k in range(7))


def smooth(rng: np.random.Generator, steps: int, width: int) -> npt.NDArray[np.float64]:
    """Sums of three waves, (steps, width)."""
    time = np.linspace(0, 1, steps)[:, None, None]
    amplitude, phase = rng.normal(0, 0.3, (width, 3)), rng.uniform(0, 2 * np.pi, (width, 3))
    return np.asarray((amplitude * np.sin(2 * np.pi * np.arange(1, 4) * time + phase)).sum(axis=2))


def png(pixels: npt.NDArray[np.uint8]) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


def pictures(rng: np.random.Generator, steps: int, size: tuple[int, int]) -> tuple[bytes, ...]:
    """A square that moves over a gradient with noise, whose blue tells the frame and the episode."""
    height, width = size
    rows, columns = np.mgrid[:height, :width]
    ground = np.stack([rows * 255 / height, columns * 255 / width, np.zeros(size)], axis=2)
    found, first = [], int(rng.integers(200))
    for k in range(steps):
        frame = ground + rng.normal(0, 4, (height, width, 1))
        frame[..., 2] += 20 + (first + 47 * k) % 200
        left = int(k / steps * width * 0.7)
        frame[height // 3 : height // 2, left : left + width // 4] = (200, 30, 40)
        found.append(png(frame.clip(0, 255).astype(np.uint8)))
    return tuple(found)


def episode(
    scene_id: str = "scene-000",
    number: int = 0,
    *,
    steps: int = 12,
    cameras: tuple[str, ...] = (),
    size: tuple[int, int] = (64, 80),
    environment: int = 6,
    objects: int = 2,
    **changes: Any,
) -> Episode:
    rng = np.random.default_rng(named_seed(scene_id, number))
    success = number % 3 != 2
    poses = np.zeros((steps + 1, objects, 7))
    poses[..., :3] = smooth(rng, steps + 1, objects * 3).reshape(steps + 1, objects, 3)
    poses[..., 3:] = (rotation := rng.normal(size=(steps + 1, objects, 4))) / np.linalg.norm(rotation, axis=2, keepdims=True)
    values: dict[str, Any] = {
        "episode_id": f"{scene_id}/{number}",
        "scene_id": scene_id,
        "seed": named_seed("episode", scene_id, number),
        "number": number,
        "robot": "panda",
        "task_kind": "pick" if number % 2 else "place_on",
        "instruction": f"Pick the {'cup' if number % 2 else 'plate'}.",
        "success": success,
        "reason": None if success else "the object was not lifted",
        "fps": 20.0,
        "control": "joint",
        "state_names": JOINTS,
        "environment_state_names": tuple(f"object_{k}" for k in range(environment)),
        "action_names": (*JOINTS, "gripper"),
        "states": smooth(rng, steps, 7),
        "environment_states": smooth(rng, steps, environment),
        "actions": smooth(rng, steps, 8),
        "rewards": np.arange(steps) == steps - 1,
        "instances": tuple(f"{k}_cup_0" for k in range(objects)),
        "object_poses": poses,
        "pictures": {camera: pictures(rng, steps, size) for camera in cameras},
        "image_size": size if cameras else None,
        "randomization": '{"friction": 0.9}' if number else None,
        "split": "train",
    }
    return Episode(**values | changes)


def write_run(root: object, episodes: list[Episode], per_shard: int = 5) -> RunFolder:
    """A run with the table ``episodes`` alone."""
    folder = RunFolder(str(root))
    for start in range(0, len(episodes), per_shard):
        part = episodes[start : start + per_shard]
        name = f"{start:06d}{content_id([e.episode_id for e in part])[:8]}"
        folder.write_shard("episodes", name, [episode_row(e) for e in part])
    return folder
