"""The scenes of a run with all that is needed to build them: chosen, in order, with the meshes that they use."""

from collections.abc import Iterator
from dataclasses import dataclass

import pyarrow as pa

from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import RestPose, SceneGeometry
from stable_data.storage.row_groups import TableFiles, row_slices
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import scene_from_row

NEEDED = ("scenes", "assets", "meshes")
"""Tables that a run must have for its scenes to be built."""


@dataclass(frozen=True, slots=True)
class SceneSelection:
    """Which scenes of a run, and how.

    Attributes:
        where: A condition on ``scenes``, see :mod:`stable_data.storage.filter_expression`; None: all.
        scene_ids: These alone; all where empty.
        limit: The first so many of them; None: all.
        settled: Objects lie where the physics engine left them (table ``settled``); else where the scene has them.
    """

    where: str | None = None
    scene_ids: tuple[str, ...] = ()
    limit: int | None = None
    settled: bool = False

    @property
    def condition(self) -> str | None:
        """The condition that ``where`` and ``scene_ids`` make."""
        parts = ([f"({self.where})"] if self.where else []) + (
            [f"scene_id in {sorted(self.scene_ids)!r}"] if self.scene_ids else []
        )
        return " and ".join(parts) or None


class RunScenes:
    """The scenes of a run with their geometry, read as they are asked for; of each table no more than a row group is held.

    Args:
        run: The run, with the tables of ``NEEDED``.
        choice: Which of its scenes.
        store: Its meshes, where they are opened already.

    Attributes:
        store: The meshes of the run.

    Raises:
        ConfigError: A table is missing (``table_missing``) or cannot be read; ``where`` is no condition; or a scene of
            ``scene_ids`` is not there (``scene_unknown``).
    """

    def __init__(self, run: RunFolder, choice: SceneSelection = SceneSelection(), store: AssetStore | None = None) -> None:
        check_tables(run, settled=choice.settled)
        self._scenes = TableFiles(run.uri, "scenes", None, where=choice.condition)
        self._limit = choice.limit
        if choice.scene_ids:
            _check_known(run, choice)
        self.store = store or run_store(run.uri)
        self._settled = SettledPoses(run) if choice.settled else None

    def __len__(self) -> int:
        """How many there are."""
        return len(self._scenes) if self._limit is None else min(len(self._scenes), self._limit)

    def __iter__(self) -> Iterator[Scene]:
        """The scenes, in the order of the run's files."""
        left = len(self)
        for group in range(len(self._scenes.groups)):
            if not left:
                return
            for part in row_slices(self._scenes.read([group])):
                for row in part.slice(0, left).to_pylist():
                    left -= 1
                    yield scene_from_row(row)

    def solid(self, scene: Scene) -> SceneGeometry:
        """One of them with its geometry.

        Raises:
            SceneError: It was never settled, and that is asked for.
        """
        return SceneGeometry.of(scene, self.store, None if self._settled is None else self._settled.of(scene.scene_id))


class SettledPoses:
    """The table ``settled`` of a run.

    Args:
        run: The run.
    """

    def __init__(self, run: RunFolder) -> None:
        ids = TableFiles(run.uri, "settled", ["scene_id"])
        self._rows = TableFiles(run.uri, "settled", None)
        self._place = {
            name: (group, row)
            for group in range(len(ids.groups))
            for row, name in enumerate(ids.read([group])["scene_id"].to_pylist())
        }
        self._read: tuple[int, pa.Table] | None = None

    def of(self, scene_id: str) -> dict[str, RestPose]:
        """Where its objects came to rest, by instance; empty where it was never settled."""
        if scene_id not in self._place:
            return {}
        group, row = self._place[scene_id]
        if self._read is None or self._read[0] != group:
            self._read = group, self._rows.read([group])
        poses = self._read[1]["poses"][row].as_py()
        return {pose["instance"]: (tuple(pose["position"]), tuple(pose["quat_xyzw"])) for pose in poses}


def check_tables(run: RunFolder, *, settled: bool = False) -> None:
    """Refuses a run that lacks what an export needs.

    Raises:
        ConfigError: ``table_missing``.
    """
    for table in NEEDED:
        if not run.files(table):
            raise ConfigError(
                f"{run.uri}: the run has no table {table}, expected {', '.join(NEEDED)}; preprocess the dataset, or name the run of a job",
                "table_missing",
            )
    if settled and not (run.files("settled") and run.num_rows("settled")):
        raise ConfigError(
            f"{run.uri}: the run keeps no settled poses, expected rows of the table settled; "
            "generate with --set keep_settled=true, or export the scenes without --settled",
            "table_missing",
        )


def _check_known(run: RunFolder, choice: SceneSelection) -> None:
    """Refuses scenes that the run does not have, or that the condition does not take."""
    ids = TableFiles(run.uri, "scenes", ["scene_id"], where=choice.condition)
    have = {name for group in range(len(ids.groups)) for name in ids.read([group])["scene_id"].to_pylist()}
    missing = sorted(set(choice.scene_ids) - have)
    if missing:
        those = f" where {choice.where}" if choice.where else ""
        raise ConfigError(
            f"{run.uri}: the run has no scenes {missing[:5]}{those}, expected ids of its table scenes", "scene_unknown"
        )
