"""What a LeRobotDataset says of itself: ``meta/info.json``, ``meta/tasks.parquet``, and the columns of ``meta/episodes``."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from stable_data.robot.lerobot.chunked_files import FILE_NAME
from stable_data.robot.lerobot.statistics import NAMES
from stable_data.robot.lerobot.videos import CODEC, PIXEL_FORMAT

VERSION = "v3.0"

DETAILS = {
    "episode_id": pa.string(),
    "scene_id": pa.string(),
    "split": pa.string(),
    "number": pa.int64(),
    "seed": pa.int64(),
    "task_kind": pa.string(),
    "control": pa.string(),
    "success": pa.bool_(),
}
"""Columns of ``meta/episodes`` that LeRobot does not know, and keeps: attributes of an episode, and their types."""


def episode_schema(described: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    """Returns the columns of ``meta/episodes``.

    Args:
        described: The features of the dataset.
    """
    whole, real = pa.int64(), pa.float64()
    columns = [("episode_index", whole), ("tasks", pa.list_(pa.string())), ("length", whole)]
    columns += [(name, whole) for name in ("data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index")]
    for name, feature in described.items():
        if feature["dtype"] == "video":
            columns += [(f"videos/{name}/{key}", whole) for key in ("chunk_index", "file_index")]
            columns += [(f"videos/{name}/{key}", real) for key in ("from_timestamp", "to_timestamp")]
    for name, feature in described.items():
        own = {"int64": whole, "bool": pa.bool_()}.get(feature["dtype"], real)
        depth = 3 if feature["dtype"] in ("image", "video") else 1
        for key in NAMES:
            type_ = _nested(own if key in ("min", "max") else real, depth)
            columns.append((f"stats/{name}/{key}", pa.list_(whole) if key == "count" else type_))
    columns += [("meta/episodes/chunk_index", whole), ("meta/episodes/file_index", whole), *DETAILS.items()]
    return pa.schema(columns)


def _nested(type_: pa.DataType, depth: int) -> pa.DataType:
    return type_ if depth == 0 else pa.list_(_nested(type_, depth - 1))


def describe_dataset(
    described: Mapping[str, Mapping[str, Any]],
    robot: str,
    fps: int,
    counts: tuple[int, int, int],
    chunk_files: int,
) -> dict[str, Any]:
    """Returns the content of ``meta/info.json``.

    Args:
        described: The features of the dataset.
        robot: Name of the robot.
        fps: Actions a second.
        counts: Number of episodes, of frames and of tasks.
        chunk_files: Maximum number of files of a folder.
    """
    features = {name: dict(feature) for name, feature in described.items()}
    videos = [feature for feature in features.values() if feature["dtype"] == "video"]
    for feature in videos:
        height, width, channels = feature["shape"]
        feature["info"] = {
            "video.height": height,
            "video.width": width,
            "video.codec": CODEC,
            "video.pix_fmt": PIXEL_FORMAT,
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": channels,
            "has_audio": False,
        }
    return {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": counts[0],
        "total_frames": counts[1],
        "total_tasks": counts[2],
        "chunks_size": chunk_files,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 100,
        "fps": fps,
        "splits": {"train": f"0:{counts[0]}"},
        "data_path": f"data/{FILE_NAME}.parquet",
        "video_path": f"videos/{{video_key}}/{FILE_NAME}.mp4" if videos else None,
        "features": features,
    }


def write_json(path: Path, content: object) -> None:
    """Writes a JSON file.

    Raises:
        OSError: The file cannot be written.
    """
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False), "utf-8")


def write_tasks(path: Path, instructions: Iterable[str]) -> None:
    """Writes ``meta/tasks.parquet``: instructions with their numbers, as pandas writes a table whose index is the instruction.

    Raises:
        OSError: The file cannot be written.
    """
    names = list(instructions)
    index = "__index_level_0__"  # what pandas calls an index without a name
    of_text = {"pandas_type": "unicode", "numpy_type": "object"}
    described = {
        "index_columns": [index],
        "column_indexes": [{"name": None, "field_name": None, **of_text, "metadata": {"encoding": "UTF-8"}}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": None},
            {"name": None, "field_name": index, **of_text, "metadata": None},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    schema = pa.schema([("task_index", pa.int64()), (index, pa.string())], {"pandas": json.dumps(described)})
    columns = [pa.array(range(len(names)), pa.int64()), pa.array(names, pa.string())]
    pq.write_table(pa.Table.from_arrays(columns, schema=schema), path)


def describe_in_words(num_episodes: int, num_frames: int) -> str:
    """Returns the content of ``README.md``, with the head that Hugging Face reads."""
    return f"""---
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {num_episodes} episodes, {num_frames} frames

A LeRobotDataset {VERSION}:

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("local/episodes", root="this folder")
```

`next.done` is true in the last frame of an episode alone, and so is `next.success` if the task was done. The files in `meta/episodes`
also say of each episode where it comes from: {", ".join(f"`{name}`" for name in DETAILS)}.
"""
