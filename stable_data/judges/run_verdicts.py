"""Verdicts of judges on the scenes of a stored run, and how far they agree."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import MeshError, SceneError, cannot_write
from stable_data.judges.registry import ask_judges, disagree
from stable_data.metrics.judge_columns import verdict_columns
from stable_data.simulation.run_reader import RunScenes
from stable_data.simulation.settling import SettleResult

SCENE_AND_VERDICTS = tuple[str, Mapping[str, SettleResult]]
"""A scene id and the verdicts on the scene by judge; none if its objects are no bodies for an engine."""

_WORDS = {True: "stable", False: "not stable", None: "unknown"}


def judge_run(scenes: RunScenes, names: Sequence[str], arbiter: str = "") -> Iterator[SCENE_AND_VERDICTS]:
    """Asks judges about scenes of a run, one after the other; see :func:`stable_data.judges.registry.ask_judges`."""
    for scene in scenes:
        try:
            bodies = scenes.geometry(scene).bodies
        except (MeshError, SceneError):
            yield scene.scene_id, {}
        else:
            yield scene.scene_id, ask_judges(names, bodies, scene.table, arbiter)


def agreement(found: Iterable[SCENE_AND_VERDICTS], names: Sequence[str]) -> list[tuple[str, str, int]]:
    """Counts the scenes by the verdicts of each two judges.

    Returns:
        Rows of the two judges, what they say, and the number of scenes, such as ``("mujoco, sapien", "stable, not stable", 3)``.
    """
    rows = []
    found = list(found)
    for first, second in combinations(names, 2):
        pairs = Counter((_word(verdicts, first), _word(verdicts, second)) for _, verdicts in found)
        rows += [(f"{first}, {second}", ", ".join(pair), count) for pair, count in sorted(pairs.items())]
    return rows


def _word(verdicts: Mapping[str, SettleResult], name: str) -> str:
    return _WORDS[verdicts[name].stable] if name in verdicts else "unknown"


def write_verdicts(found: Iterable[SCENE_AND_VERDICTS], names: Sequence[str], path: Path) -> None:
    """Writes verdicts as a Parquet table: ``scene_id``, the columns of each judge as in ``scenes``, and ``NAME_reason``.

    Raises:
        ConfigError: The file cannot be written (``output_unwritable``).
    """
    columns = [pa.field("scene_id", pa.string())]
    for name in names:
        types = (pa.bool_(), pa.float64(), pa.float64())
        columns += [pa.field(column, type_) for column, type_ in zip(verdict_columns(name), types, strict=True)]
        columns.append(pa.field(f"{name}_reason", pa.string()))
    rows = []
    for scene_id, verdicts in found:
        row: dict[str, str | bool | float | None] = {"scene_id": scene_id}
        for name, verdict in verdicts.items():
            values = verdict.stable, verdict.settle_move_max_mm, verdict.settle_turn_max_deg
            row |= dict(zip(verdict_columns(name), values, strict=True)) | {f"{name}_reason": verdict.reason}
        rows.append(row)
    stream = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(rows, schema=pa.schema(columns)), stream)
    try:
        write_file_atomically(path, stream.getvalue().to_pybytes())
    except OSError as error:
        raise cannot_write(str(path), error) from error


def disagreements(found: Iterable[SCENE_AND_VERDICTS]) -> list[SCENE_AND_VERDICTS]:
    """Returns the scenes that one judge finds stable and another one not."""
    return [(scene_id, verdicts) for scene_id, verdicts in found if disagree(verdicts)]
