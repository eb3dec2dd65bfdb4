"""Exports the scenes of a run back into the scene files from which they were imported."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from stable_data.errors import ConfigError, SceneError, StableDataError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.copies import CopyWriter
from stable_data.importers.scenes.layouts import moved_bodies, scene_source
from stable_data.importers.scenes.opening import read_scene_file
from stable_data.scene import Scene
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder


@dataclass(frozen=True, slots=True)
class OriginalsResult:
    """The result of an export.

    Attributes:
        num_written: Scene files that were written.
        num_moved: Bodies with new poses in them.
        failures: A line for each file that could not be written.
    """

    num_written: int
    num_moved: int
    failures: tuple[str, ...]


def export_originals(run: RunFolder, originals: Path, out: Path, choice: SceneSelection) -> OriginalsResult:
    """Writes copies of scene files with the poses of a run; everything else in them stays as it is.

    Args:
        run: A run of scenes that ``import scenes`` read, or that a job made of such scenes.
        originals: The folder of the scene files.
        out: Folder of the copies; each scene with all its files.
        choice: Selection of the scenes.

    Raises:
        ConfigError: The run or a folder cannot be used, or no scene is selected (``scene_unknown``).
    """
    of_file: dict[str, list[Scene]] = defaultdict(list)
    failures: list[str] = []
    for scene in RunScenes(run, choice):
        try:
            of_file[str(scene_source(scene)["file"])].append(scene)
        except SceneError as error:
            failures.append(str(error))
    if not of_file and not failures:
        raise ConfigError(f"{run.uri}: no scene is selected, expected at least one; change the selection", "scene_unknown")
    writer = CopyWriter(originals, out)
    written = moved = 0
    for path, scenes in sorted(of_file.items()):
        try:
            files, changed, count = _patched(Boundary(originals), path, scenes)
            writer.write(path, files, changed)
        except ConfigError:
            raise
        except StableDataError as error:
            failures.append(str(error))
            continue
        written, moved = written + 1, moved + count
    return OriginalsResult(written, moved, tuple(failures))


def _patched(boundary: Boundary, path: str, scenes: Sequence[Scene]) -> tuple[Sequence[str], Mapping[str, bytes], int]:
    """All files of a scene file, its changed files, and the number of bodies that moved."""
    poses = moved_bodies(scenes)
    source = scene_source(scenes[0])
    opened = read_scene_file(boundary, path, source["pose_of"])
    if opened.file.sha256 != source["sha256"]:
        raise SceneError(
            f"{path}: is another file than the one that was imported, expected the same content; import it again",
            "original_differs",
        )
    return opened.paths, opened.moved(poses)[0] if poses else {}, len(poses)
