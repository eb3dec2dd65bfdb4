"""The correct job: makes the scenes of a dataset or run exactly clean, to repair a dataset or rearrange its scenes."""

from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

from models.physics_corrector.learned_flow import load_flow, weights_fingerprint
from pipelines.correct.report import write_correct_report
from pipelines.correct.settings import CorrectSettings
from pipelines.correct.shard import CorrectWork
from pipelines.execution.engine_pool import refuse_without_workers
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.preprocess.convention import resolve_convention
from pipelines.sources.carried_tables import CARRIED_TABLES, carry_tables, refuse_links_out
from pipelines.sources.scenes import FolderSource, SceneChunk, SceneSource, TableSource, scene_source
from stable_data.assets.annotation import AssetAnnotation
from stable_data.atomic_files import write_file_atomically
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice, cannot_write
from stable_data.mesatask import MesaTaskDataset, write_annotations, write_scene
from stable_data.mesatask.library import LIBRARY_FOLDER
from stable_data.storage.run_folder import RunFolder, absolute_uri
from stable_data.storage.table_rows import scene_from_row

S = TypeVar("S", bound=CorrectSettings)


def correct(scenes: str, out: str, settings: CorrectSettings, workers: WorkerPool, *, report: bool = True) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    check_place(scenes, out)
    refuse_without_workers("correctors", settings.correctors, workers)
    return run_job(CorrectJob(scenes, settings, workers), out, workers, report=report)


class SceneJob(ShardJob, Generic[S]):
    """A job that changes scenes; the results use the same assets.

    Args:
        scenes: A folder in the MesaTask-10K format, or a run with a table ``scenes``; every node of a cluster must see it.
        settings: The job's settings.
        workers: The workers that run the shards.

    Raises:
        ConfigError: There are no such scenes, or their position convention cannot be determined.
    """

    settings: S

    def __init__(self, scenes: str, settings: S, workers: WorkerPool) -> None:
        self.where = absolute_uri(scenes)
        self.source: SceneSource = scene_source(self.where)
        if isinstance(self.source, TableSource):  # a run states its convention; nothing is measured
            refuse_links_out(self.source.folder)
            self.settings = settings.settled(self.source)
        else:
            self.settings = resolve_convention(settings, self.source, self.source.name, workers)
        self.dataset = self.source.name

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Copies the tables of assets; also writes the scenes in the MesaTask-10K format if they came from a folder."""
        carried = carry_tables(self.source.folder, folder) if isinstance(self.source, TableSource) else []
        if self.settings.write_dataset and isinstance(self.source, FolderSource) and folder.is_local:
            write_dataset(self.source, folder, self.other_assets(folder))
        return {table: folder.num_rows(table) for table in carried} | self.kinds(folder)

    def carried(self) -> Mapping[str, Set[str]]:
        """The shards of the tables of assets of an input run."""
        source = self.source
        return {t: source.folder.shard_ids(t) for t in CARRIED_TABLES} if isinstance(source, TableSource) else {}

    def other_assets(self, folder: RunFolder) -> Mapping[str, tuple[AssetAnnotation, Path]]:
        """Annotations and meshes of the assets of its scenes that the input folder does not have."""
        return {}

    @abstractmethod
    def kinds(self, folder: RunFolder) -> dict[str, Any]:
        """The number of scenes of each kind, for the manifest."""


class CorrectJob(SceneJob[CorrectSettings]):
    """Makes scenes exactly clean."""

    name = "correct"

    def __init__(self, scenes: str, settings: CorrectSettings, workers: WorkerPool) -> None:
        super().__init__(scenes, settings, workers)
        self.settings = self.settings.of_items(len(self.source.scene_ids))

    @cached_property
    def _read(self) -> tuple[list[SceneChunk], dict[str, str]]:
        return self.source.parts(self.settings.scene_settings(), self.settings.scenes_per_shard)

    @cached_property
    def _weights(self) -> str:
        fingerprint = weights_fingerprint(self.settings.weights)
        load_flow(self.settings.weights, self.settings.steps)
        return fingerprint

    def inputs(self) -> dict[str, Any]:
        """Hashes of the scenes, their meshes and the corrector's weights."""
        return self._read[1] | {"weights": self._weights}

    def about(self) -> dict[str, Any]:
        """The number of scenes."""
        return {"num_scenes": len(self.source.scene_ids)}

    def plan(self) -> Sequence[StepShards[Any]]:
        """One step over the scenes."""
        named = "correct", self.settings.shaping(), self._weights
        shards = [Shard(content_id(*named, part.content), part.scene_ids) for part in self._read[0]]
        return [StepShards(CorrectWork(self.where, self.settings, content_id(self.inputs())), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All scenes."""
        ids = [*self.source.scene_ids, *(notice.item_id for notice in self.lost())]
        return [ExpectedItems("scenes", "scene_id", ids, "failed_scenes")]

    def lost(self) -> Sequence[Notice]:
        """Scene folders without a layout."""
        return [n for n in self.source.notices if n.code == "layout_missing"]

    def odd(self) -> Sequence[Notice]:
        """All other notices of the reader."""
        return [n for n in self.source.notices if n.code != "layout_missing"]

    def kinds(self, folder: RunFolder) -> dict[str, Any]:
        """The number of corrections by status."""
        return {"by_status": dict(Counter(folder.table("corrections", ["status"])["status"].to_pylist()))}

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_correct_report(folder, manifest, self.source.store, self.settings)


def check_place(scenes: str, out: str) -> None:
    """Refuses an output folder inside the input folder.

    Raises:
        ConfigError: The output is inside the input (``output_invalid``).
    """
    folder, where = RunFolder(out), Path(absolute_uri(scenes))
    if "://" not in scenes and folder.is_local and where in (Path(folder.root), *Path(folder.root).parents):
        raise ConfigError(f"{out}: is inside the folder of the input scenes, expected another folder", "output_invalid")


def write_dataset(source: FolderSource, folder: RunFolder, others: Mapping[str, tuple[AssetAnnotation, Path]]) -> Path:
    """Writes the corrected scenes in the MesaTask-10K format to ``dataset/`` in the run's folder.

    Layouts keep all entries of the input files except poses. The asset library is a link to that of the source, or contains its
    files and those of other assets.

    Args:
        source: The source of the scenes.
        folder: The run.
        others: Annotation and mesh of assets that the source does not have.

    Returns:
        The folder, which ``stable-data lint`` and ``preprocess`` accept.

    Raises:
        ConfigError: The folder cannot be written.
    """
    root = Path(folder.root) / "dataset"
    dataset = source.dataset
    try:
        root.mkdir(exist_ok=True)
        annotations = {**dataset.annotations, **{asset_id: annotation for asset_id, (annotation, _) in others.items()}}
        if annotations:
            write_annotations(root, annotations)
        _write_library(dataset, root / LIBRARY_FOLDER, {f"{asset_id}.glb": path for asset_id, (_, path) in others.items()})
        for batch in folder.batches("scenes"):
            for row in batch.to_pylist():
                write_scene(root, scene_from_row(row), annotations=annotations)
    except OSError as error:
        raise cannot_write(str(root), error) from error
    return root


def _write_library(dataset: MesaTaskDataset, library: Path, others: Mapping[str, Path]) -> None:
    """Links to the meshes of a dataset; if there are other ones too, by file name, it links or copies file by file."""
    own = dataset.root / LIBRARY_FOLDER
    if not others:
        if own.is_dir() and not (library.is_symlink() or library.is_dir()):
            library.symlink_to(own.resolve(), target_is_directory=True)
        return
    if library.is_symlink():
        library.unlink()  # else the other meshes would be written to the source
    library.mkdir(exist_ok=True)
    paths = [path for asset_id in dataset.asset_ids if (path := dataset.asset_path(asset_id)) is not None]
    for name, path in ({path.name: path for path in paths} | dict(others)).items():
        if not (library / name).exists():
            _link_file(path.resolve(), library / name)


def _link_file(path: Path, link: Path) -> None:
    """Makes a hard link, because a reader refuses other links that leave the library; a copy where there can be none."""
    try:
        link.hardlink_to(path)
    except OSError:
        write_file_atomically(link, path.read_bytes())
