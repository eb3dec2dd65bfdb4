"""Where the objects of a scene were before it was corrected, from the tables ``corrections`` or ``turns`` of its run."""

from dataclasses import replace
from typing import Any

from stable_data.scene import Scene
from stable_data.storage.row_groups import TableFiles
from stable_data.storage.run_folder import RunFolder

_COLUMNS = {"corrections": ["scene_id", "start"], "turns": ["scene_id", "turn", "coarse", "code"]}


class EarlierPoses:
    """The poses before the correction, read for one scene at a time.

    A run of ``correct`` gives those of the input. A run of ``generate`` gives the proposal of each object: its pose in the first
    accepted turn that contains it.

    Args:
        run: The run.

    Attributes:
        is_known: Whether the run has one of the tables.
    """

    def __init__(self, run: RunFolder) -> None:
        self._uri = run.uri
        self._tables = [table for table in _COLUMNS if run.files(table)]
        self.is_known = bool(self._tables)

    def scene(self, scene: Scene) -> Scene | None:
        """Returns a scene as it was before the correction; None if the run does not tell.

        An object that no row names keeps its pose.

        Raises:
            ConfigError: A table cannot be read.
        """
        for table in self._tables:
            rows = self._rows(table, scene.scene_id)
            poses = dict[str, dict[str, Any]]()
            for row in sorted(rows, key=lambda row: row.get("turn") or 0):
                for pose in row.get("start") or (row.get("coarse") if not row.get("code") else None) or ():
                    poses.setdefault(pose["instance"], pose)
            if poses:
                moved = (
                    o.moved(tuple(pose["position"]), pose["yaw"]) if (pose := poses.get(o.instance)) is not None else o
                    for o in scene.objects
                )
                return replace(scene, objects=tuple(moved))
        return None

    def _rows(self, table: str, scene_id: str) -> list[dict[str, Any]]:
        files = TableFiles(self._uri, table, _COLUMNS[table], where=f"scene_id == {scene_id!r}")
        return [row for group in range(len(files.groups)) for row in files.read([group]).to_pylist()]
