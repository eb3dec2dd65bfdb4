"""A small run whose scenes are known, for the tests of loading."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stable_data.metrics.card import MetricCard
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Stage, Tabletop, TaskInfo
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import card_row, scene_row
from stable_data.storage.torch_dataset import TableStream

SHARDS = (7, 1, 12, 0, 9, 8)
NUM_ROWS = sum(SHARDS)
CARD = MetricCard(2, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, True)


def scene(number: int) -> Scene:
    stages = [None, *Stage]
    objects = tuple(
        SceneObject(
            instance=f"{k}_cup_0",
            category="cup",
            position=(0.1 * k + 0.001 * number, 0.2, 0.05),
            yaw=0.3 * k,
            size=(0.1, 0.1, 0.1 + 0.01 * k),
            asset_id=None if k == 2 else f"asset{k}",
            scale=(1.0, 1.0, 2.0) if k % 2 else None,
            tilt_quat_xyzw=(0.6, 0.0, 0.0, 0.8) if k == 1 else (0.0, 0.0, 0.0, 1.0),
            stage=stages[(number + k) % 4],
            support="table",
            source={"k": k},
        )
        for k in range(number % 5)
    )
    task = TaskInfo("An office.", f"Do {number}.", task_objects=("0_cup_0",)) if number % 3 else None
    relations = (Relation("0_cup_0", RelationKind.ON, "table"),) * (number % 2)
    zone = (0.0, 0.1, 0.0, 0.2) if number % 4 == 1 else None
    return Scene(f"scene-{number:03}", Tabletop("office_table", (1.2, 0.6), zone), objects, task, relations, {"n": number})


SCENES = [scene(number) for number in range(NUM_ROWS)]
IDS = [s.scene_id for s in SCENES]


def split_of(scene: Scene) -> str:
    """Every fifth scene is held out, and so is the one of the shard that holds no other; three are of unseen kinds."""
    number = int(scene.scene_id[-3:])
    return "unseen" if number in (0, 4, 8) else "validation" if number % 5 == 2 else "train"


def write(folder: RunFolder, suffix: str = "") -> None:
    """The scenes, with that at the end of their names."""
    blank = dict.fromkeys(SCHEMAS["scenes"].names) | {"source": "test", "pairs": [], "verdicts": []} | card_row(CARD)
    rest = iter(SCENES)
    for number, size in enumerate(SHARDS):
        rows = [
            blank | scene_row(scene) | {"scene_id": f"{scene.scene_id}{suffix}", "split": split_of(scene)}
            for scene in itertools.islice(rest, size)
        ]
        folder.write_shard("scenes", f"{number:016x}", rows)


def write_run(root: Path, suffix: str = "") -> str:
    """A run with the scenes and a table of features; gives its URI."""
    folder = RunFolder(str(root))
    write(folder, suffix)
    rows = [
        dict.fromkeys(SCHEMAS["features"].names)
        | {"asset_id": f"asset{i}", "feature": [float(i)] * 64, "log_extents": [0.0, 1.0, 2.0]}
        for i in range(5)
    ]
    folder.write_shard("features", "00", rows)
    return folder.uri


def stream(run: str | Sequence[str], **settings: Any) -> TableStream:
    return TableStream(run, **{"shuffle_seed": 5, "window_rows": 10, **settings})


def ids(items: Any) -> list[str]:
    """Scene ids of scenes, lists of scenes or batches, in order."""
    found = [[i.scene_id] if isinstance(i, Scene) else i["scene_ids"] if isinstance(i, dict) else ids(i) for i in items]
    return [name for names in found for name in names]


def scene_id(row: Row) -> str:
    return str(row["scene_id"])
