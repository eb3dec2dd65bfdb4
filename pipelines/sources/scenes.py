"""Where a job takes scenes from: a folder in the MesaTask-10K format, or the tables of a run."""

import os
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
from stable_data.assets.catalog import AssetLibrary, library_of_run
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.geometry.shape import Shape
from stable_data.mesatask import MesaTaskDataset, PositionConvention
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.mesatask.convention_detection import position_convention
from stable_data.metrics.audit import Audit, audit_scene
from stable_data.scene import Scene
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

ORIGIN_COLUMNS = ("source", "split", "layout_path", "layout_sha256", "duplicate_group")
"""Columns of ``scenes`` that say where a scene comes from."""

_LOOKED_AT = 2000  # scenes of a folder that show how its assets rest

Containers: TypeAlias = Mapping[str, bool | None]
"""Whether things can be put into an object, by instance; None or missing where it is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class SourceScene:
    """A scene that was taken from its source.

    Attributes:
        scene: With supports, task and stages; its relations are those that are asked for.
        shapes: The geometry of its objects, in order.
        audit: Every verdict.
        containers: Which of its objects can hold things.
        origin: The ORIGIN_COLUMNS.
        notices: What about it deserves a look.
    """

    scene: Scene
    shapes: Sequence[Shape]
    audit: Audit
    containers: Containers
    origin: schemas.Row
    notices: tuple[Notice, ...]


@dataclass(frozen=True, slots=True)
class SceneChunk:
    """Scenes of a source that are done together.

    Attributes:
        content: Names the content of the scenes and of the meshes that they use.
        scene_ids: The scenes.
    """

    content: str
    scene_ids: tuple[str, ...]


class SceneSource(Protocol):
    """Where scenes are."""

    name: str
    store: AssetStore
    scene_ids: tuple[str, ...]
    notices: tuple[Notice, ...]

    def position_convention(self) -> PositionConvention:
        """Which point of a tilted object its positions are."""
        ...

    def parts(self, settings: SceneSettings, scenes_per_part: int) -> tuple[list[SceneChunk], dict[str, str]]:
        """All scenes, cut by a fixed rule, and the content of all inputs by their kind."""
        ...

    def take(self, scene_id: str, settings: SceneSettings, progress: ItemProgress) -> SourceScene:
        """One scene, judged.

        Raises:
            SceneError: It cannot be used.
        """
        ...

    def containers(self, scene: Scene) -> Containers:
        """Which objects of a scene can hold things, by their assets."""
        ...

    def library(self) -> AssetLibrary:
        """The catalogue of its assets, not encoded."""
        ...


class FolderSource:
    """A folder in the MesaTask-10K format.

    Args:
        root: The folder.

    Raises:
        ConfigError: It is not a dataset.
    """

    def __init__(self, root: Path) -> None:
        self.dataset = MesaTaskDataset(root)
        self.name = root.name
        self.store = AssetStore(self.dataset)
        self.scene_ids = tuple(self.dataset.scene_ids)
        self.notices = self.dataset.notices

    def position_convention(self) -> PositionConvention:
        """Judged on a few of its scenes."""
        return position_convention(self.dataset, self.store)

    def parts(self, settings: SceneSettings, scenes_per_part: int) -> tuple[list[SceneChunk], dict[str, str]]:
        """The scenes in order of their names."""
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
        """One scene: read, judged, tasked and staged as preprocess does, with supports and without relations."""
        found = prepare_scene(self.dataset, scene_id, self.store, settings, progress)
        scene = replace(
            found.scene, relations=()
        )  # a layout says nothing of relations; what it shows may be what is wrong with it
        origin = origin_of(self.dataset, scene, settings)
        return SourceScene(scene, found.posed.shapes, found.audit, self.containers(scene), origin, found.notices)

    def containers(self, scene: Scene) -> Containers:
        """As the annotations have it."""
        return {o.instance: self.dataset.annotation(o.asset_id).is_container if o.asset_id else None for o in scene.objects}

    def library(self) -> AssetLibrary:
        """Its annotated assets; how they rest is what its first scenes show."""
        return library_of_folder(self.dataset.root, self.name, scenes=self.first_scenes())

    def first_scenes(self) -> Iterator[Scene]:
        """Those that show how its assets rest; what cannot be read shows nothing."""
        for scene_id in self.dataset.scene_ids[:_LOOKED_AT]:
            with suppress(SceneError):
                yield self.dataset.read(scene_id)[0]


class TableSource:
    """The tables of a run that preprocess or another job wrote: ``scenes``, ``meshes`` and ``assets``.

    Args:
        uri: The run's folder.
        cache: Local folder for the files of its meshes; by default one of the user's.

    Raises:
        ConfigError: It holds no such tables, or tables of another version.
    """

    notices: tuple[Notice, ...] = ()

    def __init__(self, uri: str, cache: Path | None = None) -> None:
        self.folder = RunFolder(uri)
        self.name = Path(self.folder.root).name
        self.store = AssetStore(RunAssets(self.folder, cache or mesh_cache()))
        rows = self.folder.table("assets", ["asset_id", "is_container"])
        self._is_container = dict(zip(rows["asset_id"].to_pylist(), rows["is_container"].to_pylist(), strict=True))
        self._ids = _ids_by_file(self.folder)
        self._file_of = {scene_id: path for path, scene_ids in self._ids.items() for scene_id in scene_ids}
        self.scene_ids = tuple(self._file_of)
        self._read: tuple[str, dict[str, schemas.Row]] = ("", {})

    def position_convention(self) -> PositionConvention:
        """That of all tables."""
        return PositionConvention.BOX_CENTRE

    def parts(self, settings: SceneSettings, scenes_per_part: int) -> tuple[list[SceneChunk], dict[str, str]]:
        """The scenes file by file, and those of large files cut; files are named by their content."""
        inputs = {table: content_id(sorted(self.folder.shard_ids(table))) for table in ("scenes", "meshes", "assets")}
        meshes = inputs["meshes"], inputs["assets"]
        parts = []
        for path, ids in self._ids.items():
            for some in split_groups(ids, scenes_per_part):
                named = (Path(path).name, *meshes) if len(ids) <= scenes_per_part else (Path(path).name, *meshes, some)
                parts.append(SceneChunk(content_id(*named), tuple(some)))
        return parts, inputs

    def take(self, scene_id: str, settings: SceneSettings, progress: ItemProgress) -> SourceScene:
        """One scene as its row has it, judged anew."""
        progress.step = "read"
        row = self.row(scene_id)
        scene = schemas.scene_from_row(row)
        progress.step = "mesh"
        scene, shapes, notices = self.store.resolved(scene)
        progress.step = "audit"
        audit = audit_scene(scene, shapes)
        origin = {column: row[column] for column in ORIGIN_COLUMNS}
        return SourceScene(scene, shapes, audit, self.containers(scene), origin, notices + audit.notices)

    def containers(self, scene: Scene) -> Containers:
        """As the table ``assets`` has it."""
        return {o.instance: self._is_container.get(o.asset_id or "") for o in scene.objects}

    def library(self) -> AssetLibrary:
        """The table ``assets``."""
        return library_of_run(self.folder, self.name)

    def row(self, scene_id: str) -> schemas.Row:
        """A row of ``scenes``; the file that it is in is kept for the next one."""
        path = self._file_of[scene_id]
        if self._read[0] != path:
            rows = self.folder.read_file("scenes", path).to_pylist()
            self._read = path, {row["scene_id"]: row for row in rows}
        return self._read[1][scene_id]


def mesh_cache() -> Path:
    """Where the meshes of runs lie as files, named by their content: shared by all processes and runs of a user."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "stable-data" / "meshes"


def _ids_by_file(folder: RunFolder) -> dict[str, tuple[str, ...]]:
    """Scene ids by the file of ``scenes`` that they are in.

    Raises:
        ConfigError: A scene is there twice, or the table cannot be read.
    """
    paths = folder.dataset("scenes").files  # refuses another version
    ids = {path: tuple(folder.read_file("scenes", path, ["scene_id"])["scene_id"].to_pylist()) for path in paths}
    counted = Counter(scene_id for scene_ids in ids.values() for scene_id in scene_ids)
    if twice := [scene_id for scene_id, count in counted.items() if count > 1]:
        raise ConfigError(f"{folder.uri}/scenes: {twice[0]} is there twice, expected each scene once", "duplicate_scene")
    return ids


def scene_source(uri: str) -> SceneSource:
    """The source that lies at a path or URI.

    Raises:
        ConfigError: Neither a dataset nor a run with scenes is there.
    """
    if "://" in uri or RunFolder(uri).files("scenes"):
        return TableSource(uri)
    return FolderSource(Path(uri).expanduser().resolve())
