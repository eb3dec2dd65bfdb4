"""The scenes of a run that a job works on."""

from functools import cached_property
from pathlib import Path
from typing import Any

from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder


class ScenesOfRun:
    """The scenes of a run that fulfil a condition.

    Args:
        run: The run, with the tables ``scenes``, ``assets`` and ``meshes``.
        where: A condition on ``scenes``; empty: all of them.
        settled: Whether objects start where they settled, which needs the table ``settled``.

    Attributes:
        run: The run as workers open it: an absolute path or a URI.
        name: Name of the run.

    Raises:
        ConfigError: The run lacks a table, or the condition is none or selects nothing (``source_empty``).
    """

    def __init__(self, run: str, where: str = "", *, settled: bool = False) -> None:
        self._where, self._settled, self._folder = where, settled, RunFolder(run)
        self.run = str(self._folder.root if self._folder.is_local else self._folder.uri)
        self.name = Path(self._folder.root).name
        RunScenes(self._folder, SceneSelection(settled=settled))  # refuses what is missing
        if not self.ids:
            condition = f" where {where}" if where else ""
            raise ConfigError(
                f"{run}: has no scenes{condition}, expected some; choose another run or condition", "source_empty"
            )

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Ids of the scenes, in the order of the files."""
        rows = TableFiles(self._folder.uri, "scenes", ["scene_id"], where=self._where or None)
        return tuple(name for group in range(len(rows.groups)) for name in rows.read([group])["scene_id"].to_pylist())

    def inputs(self) -> dict[str, Any]:
        """Hashes of the tables, and the condition."""
        tables = ("scenes", "meshes", "assets", *(("settled",) if self._settled else ()))
        found: dict[str, Any] = {name: content_id(sorted(self._folder.shard_ids(name))) for name in tables}
        return found | {"where": self._where}
