"""Writes changed scene files: complete copies in a folder, or in place of the originals."""

from collections.abc import Collection, Mapping
from pathlib import Path

from stable_data.atomic_files import write_file_atomically
from stable_data.errors import SceneError, cannot_write
from stable_data.importers.boundary import Boundary


class CopyWriter:
    """Writes scene files with changed poses; files that several scenes share are written once.

    Args:
        root: The source folder.
        out: Folder of the copies, which are complete: each scene with all its files. None: changed files replace the originals.
    """

    def __init__(self, root: Path, out: Path | None) -> None:
        self._root, self._out = root, out
        self._changed: dict[str, bytes] = {}  # files that a scene has changed
        self._kept: set[str] = set()  # files that a scene needs as they are

    def write(self, path: str, files: Collection[str], changed: Mapping[str, bytes]) -> None:
        """Writes the files of a scene.

        Args:
            path: The scene file, for messages.
            files: All its files, relative to the source folder.
            changed: File -> new content.

        Raises:
            SceneError: Another scene needs one of these files with other content (``file_shared``).
            MeshError: A file can no longer be read.
            ConfigError: A file cannot be written.
        """
        kept = set(files) - changed.keys()
        for name in sorted({*kept, *changed}):
            if (name in changed and name in self._kept) or self._changed.get(name, changed.get(name)) != changed.get(name):
                raise SceneError(
                    f"{path}: another scene of the folder needs {name} with other poses, expected scenes that share no free body; "
                    "write this scene alone into another folder",
                    "file_shared",
                )
        boundary = Boundary(self._root)
        try:
            for name in sorted(changed.keys() - self._changed.keys()):
                _write(self._out or self._root, name, changed[name])
            if self._out is not None:
                for name in sorted(kept - self._kept):
                    _write(self._out, name, boundary.read_bytes(name))
        except OSError as error:
            raise cannot_write(str(self._out or self._root), error) from error
        self._kept |= kept
        self._changed |= changed


def _write(folder: Path, path: str, content: bytes) -> None:
    place = folder / path
    place.parent.mkdir(parents=True, exist_ok=True)
    write_file_atomically(place, content)
