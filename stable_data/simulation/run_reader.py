"""Reads selected scenes of a run, in order, with the geometry that they need."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyarrow as pa

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.run_assets import run_annotations, run_store
from stable_data.assets.store import AssetStore
from stable_data.errors import ConfigError, SceneError
from stable_data.json_text import quote_value
from stable_data.scene import Scene
from stable_data.simulation.scene_geometry import RestPose, SceneGeometry
from stable_data.storage.row_groups import TableFiles, row_slices
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_index import SceneIndex
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import card_columns, scene_from_row

NEEDED = ("scenes", "assets", "meshes")
"""Tables that a run must have so that its scenes can be built."""

_LEAST_NORM = 1e-6  # of a quaternion that is a rotation


@dataclass(frozen=True, slots=True)
class SceneSelection:
    """A selection of scenes of a run.

    Attributes:
        where: A condition on ``scenes``, see :mod:`stable_data.storage.filter_expression`; None: all.
        scene_ids: Only these scenes; all if empty.
        limit: The number of first scenes that are used; None: all.
        settled: Objects are at their poses after settling (table ``settled``); else at their poses in the scene.
        joined: Scenes that stand on surfaces of one support are used together (:meth:`RunScenes.pieces`), others are left out.
    """

    where: str | None = None
    scene_ids: tuple[str, ...] = ()
    limit: int | None = None
    settled: bool = False
    joined: bool = False


class RunScenes:
    """The scenes of a run with their geometry, read on demand; at most one row group of each table is in memory.

    Args:
        run: The run, with the tables of ``NEEDED``.
        choice: The selection of its scenes.
        store: Its meshes, if they are open already.

    Attributes:
        store: The meshes of the run.

    Raises:
        ConfigError: A table is missing (``table_missing``) or cannot be read; ``where`` is no condition; or a scene of
            ``scene_ids`` does not exist (``scene_unknown``).
    """

    def __init__(self, run: RunFolder, choice: SceneSelection = SceneSelection(), store: AssetStore | None = None) -> None:
        _check_tables(run, settled=choice.settled)
        places = SceneIndex(run).places(choice.scene_ids) if choice.scene_ids else None
        self._scenes = TableFiles(run.uri, "scenes", None, where=choice.where, places=places)
        self._uri, self._choice, self._places = run.uri, choice, places
        if choice.scene_ids:
            self._check_known()
        self.store = store or run_store(run.uri)
        self._run = run
        self._settled = SettledPoses(run) if choice.settled else None
        self._read: tuple[int, pa.Table] | None = None
        self._opened: RunScenes | None = None

    def select(self, choice: SceneSelection) -> "RunScenes":
        """Returns other scenes of the run, with the same meshes and annotations, which are not read again.

        Raises:
            ConfigError: As for the class.
        """
        found = RunScenes(self._run, choice, self.store)
        found._opened = self._opened or self
        return found

    def __len__(self) -> int:
        limit = self._choice.limit
        return len(self._scenes) if limit is None else min(len(self._scenes), limit)

    def __iter__(self) -> Iterator[Scene]:
        """The scenes, in the order of the run's files."""
        return map(scene_from_row, self.rows())

    def rows(self) -> Iterator[Row]:
        """The rows of the scenes, with all columns, in the order of the run's files."""
        left = len(self)
        for group in range(len(self._scenes.groups)):
            if not left:
                return
            for part in row_slices(self._scenes.read([group])):
                for row in part.slice(0, left).to_pylist():
                    left -= 1
                    yield row

    def row(self, number: int) -> Row:
        """Returns the row of one of the scenes, with all columns.

        Args:
            number: From 0, in the order of the run's files.

        Raises:
            ConfigError: There is no such scene (``scene_unknown``), or a file was changed or removed in the meantime.
        """
        if not 0 <= number < len(self):
            raise ConfigError(
                f"{self._uri}: scene number is {number}, expected 0 to {len(self) - 1} of the selected scenes", "scene_unknown"
            )
        starts = self._scenes.starts
        group = int(np.searchsorted(starts, number, side="right")) - 1
        if self._read is None or self._read[0] != group:
            self._read = group, self._scenes.read([group])
        return dict(self._read[1].slice(number - int(starts[group]), 1).to_pylist()[0])

    def number_of(self, scene_id: str) -> int:
        """Returns the number of a scene; see :meth:`row`.

        Raises:
            ConfigError: The scene is not one of the selected ones (``scene_unknown``).
        """
        place = {(group.path, group.index): k for k, group in enumerate(self._scenes.groups)}
        places = SceneIndex(self._uri).places([scene_id])
        for group in TableFiles(self._uri, "scenes", ["scene_id"], where=self._choice.where, places=places).groups:
            k = place[group.path, group.index]
            chosen, row = self._scenes.groups[k].chosen, 0 if group.chosen is None else int(group.chosen[0])
            number = int(self._scenes.starts[k]) + (row if chosen is None else int(np.searchsorted(chosen, row)))
            if number < len(self):
                return number
        found = quote_value(scene_id)
        raise ConfigError(f"{self._uri}: scene {found} is not among the {len(self)} selected scenes", "scene_unknown")

    def pieces(self) -> "ScenePieces":
        """The scenes that stand on supports, together for each piece."""
        surfaces = TableFiles(self._uri, "scenes", ["surface"], where=self._choice.where, places=self._places)
        return ScenePieces(self._scenes, surfaces, self._choice.limit)

    def geometry(self, scene: Scene, row: Row | None = None) -> SceneGeometry:
        """Returns one of the scenes with its geometry.

        Args:
            scene: The scene.
            row: Its row, for its verdicts; None leaves them out. They are those of the poses in the scene, and are also left out
                with poses after settling.

        Raises:
            SceneError: The scene was never settled, but settled poses are selected.
        """
        verdicts = {} if row is None or self._settled is not None else card_columns(row)
        return replace(SceneGeometry.of(scene, self.store, self.rest(scene)), annotations=self.annotations, verdicts=verdicts)

    @cached_property
    def annotations(self) -> Mapping[str, AssetAnnotation]:
        """What is known of the assets of the run, by id."""
        return run_annotations(self._run) if self._opened is None else self._opened.annotations

    def rest(self, scene: Scene) -> dict[str, RestPose] | None:
        """The poses of a scene's objects after settling, by instance; None if the poses of the scene are selected."""
        return None if self._settled is None else self._settled.of(scene.scene_id)

    def _check_known(self) -> None:
        """Refuses scenes that the run does not have, or that the condition excludes."""
        choice = self._choice
        ids = TableFiles(self._uri, "scenes", ["scene_id"], where=choice.where, places=self._places)
        found = {name for group in range(len(ids.groups)) for name in ids.read([group])["scene_id"].to_pylist()}
        missing = sorted(set(choice.scene_ids) - found)
        if missing:
            condition = f" where {choice.where}" if choice.where else ""
            raise ConfigError(
                f"{self._uri}: the run has no scenes {missing[:5]}{condition}, expected ids of its table scenes",
                "scene_unknown",
            )


class ScenePieces:
    """The rows of scenes of a run by the piece of furniture on which they stand, read on demand, the highest surface first.

    Args:
        scenes: Selected rows of the table ``scenes``, with all columns.
        surfaces: The column ``surface`` of the same rows.
        limit: The number of first pieces that are used; None: all.
    """

    def __init__(self, scenes: TableFiles, surfaces: TableFiles, limit: int | None) -> None:
        self._scenes = scenes
        places: dict[str, list[tuple[float, int, int]]] = {}  # minus the height
        for group in range(len(surfaces.groups)):
            for row, surface in enumerate(surfaces.read([group])["surface"].to_pylist()):
                if surface is not None and surface["support"] is not None:
                    height = (surface["origin"] or [None])[-1] or 0.0  # one that states none cannot be read
                    places.setdefault(surface["support"], []).append((-height, group, row))
        self._places = [sorted(places[name]) for name in sorted(places)][:limit]

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[list[Row]]:
        """The rows of each piece, with all columns."""
        read: tuple[int, pa.Table] | None = None
        for piece in self._places:
            found = {}
            for order, group, row in sorted(piece, key=lambda place: place[1:]):
                if read is None or read[0] != group:
                    read = group, self._scenes.read([group])
                found[order, group, row] = read[1].slice(row, 1).to_pylist()[0]
            yield [found[place] for place in piece]


class SettledPoses:
    """The table ``settled`` of a run, read on demand."""

    def __init__(self, run: RunFolder) -> None:
        self._index = SceneIndex(run, "settled")

    def of(self, scene_id: str) -> dict[str, RestPose]:
        """The poses of a scene's objects after settling, by instance; empty if it was never settled.

        Raises:
            SceneError: A pose is missing or none (``row_invalid``). A run may come from anywhere.
        """
        row = self._index.row(scene_id, ["poses"])
        try:
            return dict(map(_rest_pose, () if row is None else row["poses"]))
        except (TypeError, ValueError) as error:
            found = f"{quote_value(scene_id)}: its poses after settling cannot be used ({error!s:.200})"
            raise SceneError(f"{found}, expected what a job writes; make the run again", "row_invalid") from error


def _rest_pose(pose: Row) -> tuple[str, RestPose]:
    """The instance and the pose of an entry of ``poses``.

    Raises:
        TypeError, ValueError: It is no pose.
    """
    (x, y, z), (a, b, c, d) = pose["position"], pose["quat_xyzw"]
    if not math.isfinite(x + y + z) or not _LEAST_NORM < math.hypot(a, b, c, d) < math.inf:
        raise ValueError("a number is not finite, or a quaternion is zero")
    return pose["instance"], ((x, y, z), (a, b, c, d))


def _check_tables(run: RunFolder, *, settled: bool = False) -> None:
    """Refuses a run without the tables that an export needs (``table_missing``)."""
    for table in NEEDED:
        if not run.files(table):
            raise ConfigError(
                f"{run.uri}: the run has no table {table}, expected {', '.join(NEEDED)}; preprocess the dataset, or pass the run of a job",
                "table_missing",
            )
    if settled and not (run.files("settled") and run.num_rows("settled")):
        raise ConfigError(
            f"{run.uri}: the run stores no settled poses, expected rows of the table settled; "
            "generate with --set keep_settled=true, or export the scenes without --settled",
            "table_missing",
        )
