"""Imports what TabletopGen has made as a folder in the MesaTask-10K format."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from pipelines.execution.ray_executor import IsolatedProcess
from pipelines.scene_files.folder import call_for_file
from pipelines.sources.tasks import read_tasks
from stable_data.assets.annotation import AssetAnnotation
from stable_data.errors import ConfigError, Notice, StableDataError, cannot_write
from stable_data.importers.tabletopgen import convert_scene, number_of, scene_folders
from stable_data.json_text import quote_value
from stable_data.mesatask.writing import write_annotations


@dataclass(frozen=True, slots=True)
class ConvertedScenes:
    """What an import has made.

    Attributes:
        num_scenes: Scenes that were written.
        warnings: Remarks on them.
        failures: Scenes that could not be used.
    """

    num_scenes: int
    warnings: tuple[Notice, ...]
    failures: tuple[Notice, ...]


def import_tabletopgen(root: Path, out: Path, tasks: Path | None = None, *, progress: bool = False) -> ConvertedScenes:
    """Writes scenes of TabletopGen and their meshes in the MesaTask-10K format.

    Args:
        root: Its folder ``output_scene``.
        out: The dataset's folder; it must be empty or not exist.
        tasks: A file of tasks: ``scene_K`` gets the identifier of the K-th of them, from 1. None: scenes keep the names of their folders.
        progress: Whether to show a progress bar.

    Raises:
        ConfigError: There is no scene, the file of tasks cannot be read, or the folder has content or cannot be written.
    """
    folders = scene_folders(root)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: has content, expected an empty folder or none; choose another", "output_invalid")
    ids = None if tasks is None else _ids_of(tasks)
    annotations: dict[str, AssetAnnotation] = {}
    warnings, failures = list[Notice](), list[Notice]()
    num_scenes = 0
    with IsolatedProcess() as process:
        for folder in tqdm(folders, desc="import", unit="scene", disable=not progress):
            try:
                scene_id = folder if ids is None else _id_of(folder, ids)
                written = call_for_file(process, folder, convert_scene, root, folder, scene_id, out)
            except StableDataError as error:
                failures.append(Notice(folder, "read", error.code, str(error)))
                continue
            annotations |= written.annotations
            warnings += written.notices
            num_scenes += 1
    try:
        write_annotations(out, annotations)
    except OSError as error:
        raise cannot_write(str(out), error) from error
    return ConvertedScenes(num_scenes, tuple(warnings), tuple(failures))


def _ids_of(tasks: Path) -> Mapping[int, str]:
    """The identifiers of tasks by their numbers.

    Raises:
        ConfigError: A row is no task (``tasks_invalid``), as its number would be another one's.
    """
    found = {}
    for number, task in enumerate(read_tasks(tasks), 1):
        if isinstance(task, Notice):
            raise ConfigError(f"{tasks}: {task.message}; correct the file", "tasks_invalid")
        found[number] = task.scene_id
    return found


def _id_of(folder: str, ids: Mapping[int, str]) -> str:
    number = number_of(folder)
    if number is None or number not in ids:
        expected = f"scene_K with K from 1 to {len(ids)}, the number of a task; rename or remove it"
        raise ConfigError(f"{quote_value(folder)} has the number of no task, expected {expected}", "task_missing")
    return ids[number]
