"""Meshes of a run's own tables, for jobs that see the run folder and not the dataset that it was made of."""

import os
from pathlib import Path

import pyarrow as pa

from stable_data.errors import ConfigError
from stable_data.shards import RunFolder, unwritable
from stable_data.table_files import TableFiles


class TableAssets:
    """An :class:`~stable_data.assets.AssetSource` over the table ``meshes``: its GLBs as files, named by their content.

    Files that are there already, such as another process's, are used. Of the table no more than a row group is held at a time.

    Args:
        run: The run folder.
        files: Local folder for the files.

    Raises:
        ConfigError: The run has no table ``meshes``, it cannot be read, or the files cannot be written.
    """

    def __init__(self, run: RunFolder, files: Path) -> None:
        self._paths: dict[str, Path] = {}
        table = TableFiles(run.uri, "meshes", ["asset_id", "glb", "sha256"])
        try:
            files.mkdir(parents=True, exist_ok=True)
            for group in range(len(table.groups)):
                rows = table.read([group])
                for asset_id, glb, sha256 in zip(*(rows[name] for name in ("asset_id", "glb", "sha256")), strict=True):
                    self._paths[asset_id.as_py()] = _placed(files, sha256.as_py(), glb)
        except OSError as error:
            raise unwritable(str(files), error) from error

    def asset_path(self, asset_id: str) -> Path | None:
        """The asset's repaired mesh as a GLB file, or None where the run has none."""
        return self._paths.get(asset_id)


def _placed(files: Path, sha256: str, glb: pa.Scalar) -> Path:
    """The file of a mesh, written in one step where it is not there yet."""
    if not (len(sha256) == 64 and sha256.isalnum()):
        raise ConfigError(
            f"meshes: sha256 is {sha256!r}, expected 64 hex digits; preprocess the dataset again", "table_invalid"
        )
    path = files / f"{sha256}.glb"
    if not path.exists():
        aside = files / f".{sha256}.{os.getpid()}"
        aside.write_bytes(glb.as_buffer())
        aside.replace(path)
    return path
