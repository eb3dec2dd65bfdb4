"""Small runs of the edit job."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.edit.settings import EditSettings
from pipelines.execution.ray_executor import WorkerPool
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row

SMALL = EditSettings(weights="none", scenes_per_shard=4, num_pictures=0, position_convention="box_centre")
ALONE = WorkerPool()
EMPTY = '{"remove":[],"objects":[]}'


def file_of(lines: Sequence[Any], path: Path) -> Path:
    path.write_text("".join(f"{line if isinstance(line, str) else json.dumps(line)}\n" for line in lines), "utf-8")
    return path


def rows_of(out: Path, table: str, key: str = "scene_id") -> dict[str, Row]:
    return {row[key]: row for row in RunFolder(str(out)).table(table).to_pylist()}
