"""The scene sources of a job: a folder in the MesaTask-10K format, or the tables of a run."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeAlias, cast

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_size import split_groups
from pipelines.preprocess.convention import ConventionChoice
from pipelines.preprocess.plan import plan_run
from pipelines.preprocess.scene import SceneSettings, origin_of, prepare_scene
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetSource, AssetStore
from stable_data.cache_folder import user_cache
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset, PositionConvention
from stable_data.mesatask.convention_detection import position_convention
from stable_data.mesatask.writing import scene_folder
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.verdicts import Audit
from stable_data.scene import Scene
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import VARIANT_COLUMNS, scene_from_row

ORIGIN_COLUMNS = ("source", "split", "layout_path", "layout_sha256", "duplicate_group", *VARIANT_COLUMNS)
"""Columns of ``scenes`` that state the origin of a scene."""

_MAX_TILT_SCENES = 2000  # scenes of a folder from which the resting tilts of its assets are taken

Containers: TypeAlias = Mapping[str, bool | None]
"""Whether an object is a container, by instance; None or missing if unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceScene:
    """A scene that was read from a source.

    Attributes:
        scene: The scene with supports, task and stages; its relations are those that its task requires.
        shapes: The geometry of its objects, in order.
        audit: Its audit.
        containers: Which of its objects are containers.
        origin: The values of ORIGIN_COLUMNS.
        notices: Warnings about it.
    """

    scene: Scene
    shapes: Sequence[Shape]
    audit: Audit
    containers: Containers
    origin: schemas.Row
    notices: tuple[Notice, ...]


@dataclass(frozen=True, slots=True)
class SceneChunk:
    """Scenes of a source that are processed together.

    Attributes:
        content: A hash of the scenes and of the meshes that they use.
        scene_ids: The scenes.
    """

    content: str
    scene_ids: tuple[str, ...]


class SceneSource(Protocol):
    """A source of scenes."""

    name: str
    store: AssetStore
    scene_ids: tuple[str, ...]
    notices: tuple[Notice, ...]

    def position_convention(self) -> PositionConvention:
        """The point of a tilted object that the source uses as its position."""
        ...

    def parts(self, settings: SceneSettings, scenes_per_part: int) -> tuple[list[SceneChunk], dict[str, str]]:
        """All scenes, split by a fixed rule, and the hashes of all inputs by kind."""
        ...

    def take(self, scene_id: str, settings: SceneSettings, progress: ItemProgress) -> SourceScene:
        """Reads and audits one scene.

        Raises:
            SceneError: The scene cannot be used.
        """
        ...

    def containers(self, scene: Scene) -> Containers:
        """Which objects of a scene are containers, according to their assets."""
        ...


class FolderSource:
    """A folder in the MesaTask-10K format.

    Args:
        root: The folder.
        assets: Its meshes and those of further libraries; by default its own.

    Raises:
        ConfigError: It is not a dataset.
    """

    def __init__(self, root: Path, assets: AssetSource | None = None) -> None:
        self.dataset = MesaTaskDataset(root)
        self.name = root.name
        self.store = AssetStore(self.dataset if assets is None else assets)
        self.scene_ids = tuple(self.dataset.scene_ids)
        self.notices = self.dataset.notices

    def position_convention(self) -> PositionConvention:
        """The convention that a few of its scenes show."""
        return position_convention(self.dataset, self.store)

    def parts(self, settings: SceneSettings, scenes_per_part: int) -> tuple[list[SceneChunk], dict[str, str]]:
        """All scenes in the order of their names; see the protocol."""
        plan = plan_run(
            self.dataset,
            PreprocessSettings(
                all_assets=False,
                scenes_per_shard=scenes_per_part,
                position_convention=cast(ConventionChoice, str(settings.position_convention)),
            ),
        )
        return [SceneChunk(shard.shard_id, shard.items) for shard in plan.scenes], dict(plan.inputs)

    def take(self, scene_id: str, settings: SceneSettings, progress: ItemProgress) -> SourceScene:
        """Reads and audits one scene and gives it a task and stages, as preprocess does, but without relations.

        Raises:
            SceneError: It cannot be read, or no folder of the corrected scenes could have its name (``scene_id_invalid``).
        """
        found = prepare_scene(self.dataset, scene_id, self.store, settings, progress)
        scene_folder(self.dataset.root, found.scene)  # a bad name fails here alone, not the whole job when it writes dataset/
        scene = replace(found.scene, relations=())  # a layout states no relations, and those that hold in it may be errors
        origin = origin_of(self.dataset, scene, settings)
        return SourceScene(scene, found.posed.shapes, found.audit, self.containers(scene), origin, found.notices)

    def containers(self, scene: Scene) -> Containers:
        """Which objects are containers according to the annotations."""
        return {o.instance: self.dataset.annotation(o.asset_id).is_container if o.asset_id else None for o in scene.objects}

    def first_scenes(self) -> Iterator[Scene]:
        """The first readable scenes, for the resting tilts of assets."""
        for scene_id in self.dataset.scene_ids[:_MAX_TILT_SCENES]:
            with suppress(SceneError):
                yield self.dataset.read(scene_id)[0]


class TableSource:
    """The tables of a run that preprocess or another job wrote: ``scenes``, ``meshes`` and ``assets``.

    Args:
        uri: The run's folder.
        assets: Its meshes and those of further libraries; by default its own.

    Raises:
        ConfigError: The run lacks these tables, or they have another version.
    """

    notices: tuple[Notice, ...] = ()

    def __init__(self, uri: str, assets: AssetSource | None = None) -> None:
        self.folder = RunFolder(uri)
        self.name = Path(self.folder.root).name
        self.store = AssetStore(RunAssets(self.folder, mesh_cache()) if assets is None else assets)
        rows = self.folder.table("assets", ["asset_id", "is_container"])
        self._is_container = dict(zip(rows["asset_id"].to_pylist(), rows["is_container"].to_pylist(), strict=True))
        self._ids = _ids_by_file(self.folder)
        self._file_of = {scene_id: path for path, scene_ids in self._ids.items() for scene_id in scene_ids}
        self.scene_ids = tuple(self._file_of)
        self._read: tuple[str, dict[str, schemas.Row]] = ("", {})

    def position_convention(self) -> PositionConvention:
        """The convention of all tables: the centre of the box."""
        return PositionConvention.BOX_CENTRE

    def parts(self, settings: SceneSettings, scenes_per_part: int) -> tuple[list[SceneChunk], dict[str, str]]:
        """All scenes file by file, large files split; the names of files are hashes of their content."""
        inputs = {table: content_id(sorted(self.folder.shard_ids(table))) for table in ("scenes", "meshes", "assets")}
        meshes = inputs["meshes"], inputs["assets"]
        parts = []
        for path, ids in self._ids.items():
            for some in split_groups(ids, scenes_per_part):
                named = (Path(path).name, *meshes) if len(ids) <= scenes_per_part else (Path(path).name, *meshes, some)
                parts.append(SceneChunk(content_id(*named), tuple(some)))
        return parts, inputs

    def take(self, scene_id: str, settings: SceneSettings, progress: ItemProgress) -> SourceScene:
        """Reads one scene from its row and audits it again."""
        progress.step = "read"
        row = self.row(scene_id)
        scene = scene_from_row(row)
        progress.step = "mesh"
        scene, shapes, notices = self.store.resolved(scene)
        progress.step = "audit"
        audit = audit_scene(scene, shapes)
        origin = {column: row[column] for column in ORIGIN_COLUMNS}
        return SourceScene(scene, shapes, audit, self.containers(scene), origin, notices + audit.notices)

    def containers(self, scene: Scene) -> Containers:
        """Which objects are containers according to the table ``assets``."""
        return {o.instance: self._is_container.get(o.asset_id or "") for o in scene.objects}

    def row(self, scene_id: str) -> schemas.Row:
        """A row of ``scenes``; its file stays in memory for the next row."""
        path = self._file_of[scene_id]
        if self._read[0] != path:
            rows = self.folder.read_file("scenes", path).to_pylist()
            self._read = path, {row["scene_id"]: row for row in rows}
        return self._read[1][scene_id]


def mesh_cache() -> Path:
    """The folder of mesh files of all runs, named by content hash and shared by all processes of a user."""
    return user_cache("meshes")


def contact_grid_cache() -> Path:
    """The folder of the grids with which layouts are refined, named by content hash and shared by all processes of a user."""
    return user_cache("contact_grids")


def _ids_by_file(folder: RunFolder) -> dict[str, tuple[str, ...]]:
    """Scene ids by their file of ``scenes``.

    Raises:
        ConfigError: A scene is in the table twice, or the table cannot be read.
    """
    paths = folder.dataset("scenes").files  # refuses another version
    ids = {path: tuple(folder.read_file("scenes", path, ["scene_id"])["scene_id"].to_pylist()) for path in paths}
    counted = Counter(scene_id for scene_ids in ids.values() for scene_id in scene_ids)
    if twice := [scene_id for scene_id, count in counted.items() if count > 1]:
        raise ConfigError(f"{folder.uri}/scenes: {twice[0]} is in the table twice, expected each scene once", "duplicate_scene")
    return ids


def scene_source(uri: str, assets: AssetSource | None = None) -> SceneSource:
    """The source at a path or URI.

    Args:
        uri: The path or URI.
        assets: Its meshes and those of further libraries; by default its own.

    Raises:
        ConfigError: It contains neither a dataset nor a run with scenes.
    """
    if "://" in uri or RunFolder(uri).files("scenes"):
        return TableSource(uri, assets)
    return FolderSource(Path(uri).expanduser().resolve(), assets)
