"""Scenes of a run as a Lance dataset, whose rows are read by number and by condition without an index of their own."""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa

from stable_data.atomic_files import temporary_path
from stable_data.errors import ConfigError, cannot_write
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_index import SceneIndex
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_scan import TableScan

LANCE_FOLDER = "scenes.lance"


def write_lance(
    run: RunFolder, out: Path, where: str | None = None, scene_ids: Sequence[str] = (), limit: int | None = None
) -> int:
    """Writes rows of the table ``scenes`` to ``scenes.lance``, in the order of the run, with the metadata of the columns.

    Rows are written as they are read. The dataset appears when it is complete.

    Args:
        run: The run.
        out: Local folder for the dataset.
        where: A condition, see :mod:`stable_data.storage.filter_expression`; None: all scenes.
        scene_ids: Only these scenes; all if empty.
        limit: The number of first scenes that are used; None: all.

    Returns:
        Number of rows.

    Raises:
        ConfigError: The condition or a scene is not known, no scene is selected, or the folder has a dataset already or cannot be
            written.
        ModuleNotFoundError: The extra ``lance`` is not installed.
    """
    import lance

    target = out / LANCE_FOLDER
    if target.exists():
        raise ConfigError(f"{target}: exists already, expected a folder without it; choose a new folder", "output_not_empty")
    batches = _batches(run, where, scene_ids, limit)
    first = next(batches, None)
    if first is None:
        raise ConfigError(f"{run.uri}: no scene is selected, expected at least one; change the selection", "scene_unknown")

    def rest() -> Iterator[pa.RecordBatch]:
        yield first
        yield from batches

    aside = temporary_path(target)
    try:
        out.mkdir(parents=True, exist_ok=True)
        written = lance.write_dataset(pa.RecordBatchReader.from_batches(SCHEMAS["scenes"], rest()), str(aside))
        count = int(written.count_rows())
        aside.replace(target)
    except OSError as error:
        raise cannot_write(str(out), error) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return count


def _batches(run: RunFolder, where: str | None, scene_ids: Sequence[str], limit: int | None) -> Iterator[pa.RecordBatch]:
    """The selected rows."""
    left = limit
    for table in _tables(run, where, scene_ids):
        part = table if left is None else table.slice(0, left)
        left = None if left is None else left - part.num_rows
        yield from (batch for batch in part.to_batches() if batch.num_rows)
        if left == 0:
            return


def _tables(run: RunFolder, where: str | None, scene_ids: Sequence[str]) -> Iterator[pa.Table]:
    if where is not None and not scene_ids:
        yield from TableScan(run, "scenes", where).tables()
        return
    index = SceneIndex(run) if scene_ids else None
    if index is not None and (unknown := index.unknown(scene_ids)):
        raise ConfigError(f"{run.uri}: the run has no scenes {unknown[:5]}, expected ids of its table scenes", "scene_unknown")
    files = TableFiles(run.uri, "scenes", None, where=where, places=None if index is None else index.places(scene_ids))
    for group in range(len(files.groups)):
        yield files.read([group])
