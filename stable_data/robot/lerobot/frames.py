"""The frames of episodes as a LeRobotDataset describes and stores them: features, and rows of Arrow."""

import json
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from stable_data.robot.episodes import Episode, EpisodeFeatures

PICTURE = "observation.images."
_ARROW = {
    "float32": pa.float32(),
    "int64": pa.int64(),
    "bool": pa.bool_(),
    "image": pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
}


def describe_features(features: EpisodeFeatures, *, is_video: bool) -> dict[str, dict[str, Any]]:
    """Returns the features of a dataset, as ``meta/info.json`` states them.

    Args:
        features: Those of its episodes.
        is_video: Whether pictures are in video files; else each one is in its frame.
    """
    found: dict[str, dict[str, Any]] = {"observation.state": _numbers(features.state_names)}
    if features.environment_state_names:
        found["observation.environment_state"] = _numbers(features.environment_state_names)
    for camera in features.cameras:
        assert features.image_size is not None
        found[PICTURE + camera] = {
            "dtype": "video" if is_video else "image",
            "shape": [*features.image_size, 3],
            "names": ["height", "width", "channels"],
        }
    found["action"] = _numbers(features.action_names)
    types = {"next.reward": "float32", "next.success": "bool", "next.done": "bool", "timestamp": "float32"}
    types |= dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    return found | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in types.items()}


def _numbers(names: tuple[str, ...]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": list(names)}


def frame_schema(described: dict[str, dict[str, Any]]) -> pa.Schema:
    """Returns the schema of the frames, with the metadata that Hugging Face ``datasets`` reads; videos are not in it."""
    columns, known = [], {}
    for name, feature in described.items():
        dtype, size = feature["dtype"], feature["shape"][0]
        if dtype == "video":
            continue
        type_ = _ARROW[dtype]
        value = {"_type": "Image"} if dtype == "image" else {"dtype": dtype, "_type": "Value"}
        if dtype != "image" and size > 1:
            type_, value = pa.list_(type_, size), {"feature": value, "length": size, "_type": "Sequence"}
        columns.append(pa.field(name, type_))
        known[name] = value
    return pa.schema(columns, {"huggingface": json.dumps({"info": {"features": known}})})


def frame_arrays(episode: Episode, episode_index: int, first_index: int, task_index: int) -> dict[str, npt.NDArray[Any]]:
    """Returns the numbers of the frames of an episode: feature -> (T, D).

    Args:
        episode: The episode.
        episode_index: Its number in the dataset.
        first_index: Number of its first frame in the dataset.
        task_index: Number of its instruction in the dataset.
    """
    num_steps = episode.num_steps
    steps = np.arange(num_steps, dtype=np.int64)
    is_last = steps == num_steps - 1
    found: dict[str, npt.NDArray[Any]] = {
        "observation.state": episode.states,
        "observation.environment_state": episode.environment_states,
        "action": episode.actions,
        "next.reward": episode.rewards,
        "next.success": is_last & episode.success,
        "next.done": is_last,
        "timestamp": (steps / episode.fps).astype(np.float32),
        "frame_index": steps,
        "episode_index": np.full(num_steps, episode_index, np.int64),
        "index": first_index + steps,
        "task_index": np.full(num_steps, task_index, np.int64),
    }
    if not episode.environment_state_names:
        del found["observation.environment_state"]
    return {name: values.reshape(num_steps, -1) for name, values in found.items()}


def frame_table(episode: Episode, arrays: dict[str, npt.NDArray[Any]], schema: pa.Schema) -> pa.Table:
    """Returns the frames of an episode.

    Args:
        episode: The episode.
        arrays: Its numbers, from :func:`frame_arrays`.
        schema: The schema of the frames.
    """
    columns = []
    for column in schema:
        if column.name.startswith(PICTURE):
            files = pa.array(episode.pictures[column.name.removeprefix(PICTURE)], pa.binary())
            paths = pa.array([f"frame-{k:06d}.png" for k in range(episode.num_steps)])
            columns.append(pa.StructArray.from_arrays([files, paths], names=["bytes", "path"]))
            continue
        values = pa.array(arrays[column.name].ravel())
        is_list = pa.types.is_fixed_size_list(column.type)
        columns.append(pa.FixedSizeListArray.from_arrays(values, column.type.list_size) if is_list else values)
    return pa.Table.from_arrays(columns, schema=schema)
