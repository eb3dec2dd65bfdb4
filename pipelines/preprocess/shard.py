"""Preprocess: a folder of scenes in the MesaTask-10K format becomes staged, geometry-complete tables.

A shard whose tables are all in place is done. Workers write their own shards, so nothing large travels.
"""

import importlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import ProcessFailure, WorkerPool, alone, limited
from pipelines.execution.shard_job import (
    OF_DATASET,
    Rows,
    check_resume,
    check_shards,
    count_items,
    count_rows,
    new_manifest,
    rows_alone,
    rows_or_failure,
    run_missing,
    write_manifest,
)
from pipelines.preprocess.asset import AssetSettings, AssetUse, TextFeature, preprocess_asset
from pipelines.preprocess.features import AUTO, NONE, FeatureUse, encoder_of, feature_rows, fingerprint_of
from pipelines.preprocess.plan import DatasetShard, PreprocessPlan, PreprocessSettings, plan_run, text_features
from pipelines.preprocess.report import write_report
from pipelines.preprocess.scene import CachedTaskWriter, preprocess_scene
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

if TYPE_CHECKING:
    from models.point_encoder import PointEncoder

SCENE_TABLES = ("warnings", "failures", "samples", "scenes")
"""Tables of a scene shard, in the order in which they are put in place."""
ASSET_TABLES = ("warnings", "failures", "sdf", "meshes", "assets")
"""Tables of an asset shard, likewise."""
FEATURE_TABLES = ("failures", "features")
"""Tables of a shard of point features, likewise."""
TABLES = tuple(dict.fromkeys((*ASSET_TABLES, *SCENE_TABLES)))
"""Tables of a run; one with an encoder has ``features`` too."""

Item: TypeAlias = str | AssetUse | FeatureUse
"""A scene's id, an asset, or an asset whose features are made."""

_NO_ASSETS = content_id("no assets")


@dataclass(frozen=True, slots=True)
class PreprocessShard:
    """The work of one shard; sent to the workers.

    Attributes:
        data: Root of the dataset, which every worker can read: an absolute path, for each worker has a folder of its own.
        out: The run's folder, which every worker can write, likewise.
        settings: The job's settings.
        fingerprint: Content of the dataset: what a process keeps of one is not used for another in the same place.
        encoder: Fingerprint of the encoder of the point features; None where none are made.
    """

    data: str
    out: str
    settings: PreprocessSettings
    fingerprint: str = ""
    encoder: str | None = None

    def __call__(self, shard: DatasetShard, *, isolated: bool = False) -> tuple[int, int]:
        """Does the shard and puts its tables in place; gives its items and how many of them failed."""
        rows: dict[str, list[schemas.Row]] = defaultdict(list)
        items: tuple[Item, ...] = (*shard.assets, *shard.features, *shard.scenes)
        for item in items:
            for table, new in (self._alone(item) if isolated else self._limited(item)).items():
                rows[table] += new
        out = RunFolder(self.out)
        for table in _tables_of(shard):
            out.write_shard(table, shard.shard_id, rows[table])
        return len(shard), len(rows["failures"])

    def item(self, item: Item) -> Rows:
        """Rows of one scene or asset, by table; a failure is a row too."""
        progress = ItemProgress("read")
        return rows_or_failure(_id_of(item), progress, lambda: self._rows(item, progress))

    def _rows(self, item: Item, progress: ItemProgress) -> Rows:
        dataset, store = self._open()
        if isinstance(item, str):
            writer = _writer(self.settings)
            scene = preprocess_scene(dataset, item, store, self.settings.scene_settings(), progress, writer)
            found = {"scenes": [scene.scene], "samples": list(scene.samples)}
            notices = scene.notices
        elif isinstance(item, FeatureUse):
            return {"features": feature_rows(item, store, self._encoder(), progress)}
        else:
            embedding = _text_features(self.data, self.fingerprint).get(item.asset_id)
            shaping = AssetSettings(self.settings.num_points)
            asset = preprocess_asset(item, dataset.annotation(item.asset_id), store, shaping, progress, embedding)
            found = {"assets": [asset.asset], "meshes": [asset.mesh], "sdf": list(asset.grids)}
            notices = asset.notices
        return found | {"warnings": [schemas.notice_row(n) for n in notices]}

    def _open(self) -> tuple[MesaTaskDataset, AssetStore]:
        return _opened(self.data, self.fingerprint)

    def _encoder(self) -> "PointEncoder":
        assert self.encoder is not None
        return encoder_of(self.settings.features, self.encoder)

    def _prepare(self, item: Item) -> None:
        """Opens what an item needs, outside of the time of the first one."""
        self._open()
        if isinstance(item, FeatureUse):
            self._encoder()
        else:
            _text_features(self.data, self.fingerprint)

    def _limited(self, item: Item) -> Rows:
        self._prepare(item)
        with limited(self.settings.seconds_per_item):
            return self.item(item)

    def _alone(self, item: Item) -> Rows:
        seconds = self.settings.seconds_per_item
        return rows_alone(self.item, item, _id_of(item), seconds=seconds, prepare=partial(self._prepare, item))


def _tables_of(shard: DatasetShard) -> tuple[str, ...]:
    return ASSET_TABLES if shard.assets else FEATURE_TABLES if shard.features else SCENE_TABLES


def _tables_of_run(plan: PreprocessPlan) -> tuple[str, ...]:
    return TABLES if plan.encoder is None else (*TABLES, "features")


def _id_of(item: Item) -> str:
    return item if isinstance(item, str) else item.asset_id


@lru_cache(maxsize=2)
def _opened(data: str, fingerprint: str) -> tuple[MesaTaskDataset, AssetStore]:
    dataset = MesaTaskDataset(Path(data))
    return dataset, AssetStore(dataset)


@lru_cache(maxsize=2)
def _text_features(data: str, fingerprint: str) -> dict[str, TextFeature]:
    return text_features(Path(data))


@lru_cache(maxsize=2)
def _writer(settings: PreprocessSettings) -> CachedTaskWriter | None:
    if not settings.task_writer:
        return None
    module, _, name = settings.task_writer.partition(":")
    try:
        write: Callable[..., Any] = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"setting task_writer is {settings.task_writer} ({error}), expected module:function", "config_invalid"
        ) from error
    return CachedTaskWriter(write, settings.task_cache, settings.task_writer)


def preprocess(
    data: str, out: str, settings: PreprocessSettings, workers: WorkerPool, *, report: bool = True
) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        data: Root of a dataset in the MesaTask-10K format; every node of a cluster must see it in this place.
        out: Local folder, likewise, or object-store URI.
        settings: What shapes the rows.
        workers: Who runs the shards.
        report: Whether to write the report page.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    dataset = MesaTaskDataset(_absolute(data))
    folder = RunFolder(out)
    settings = _settled(dataset, settings, workers)
    placed = replace(settings, task_cache=str(_absolute(settings.task_cache)), features=_placed(settings.features))
    _writer(placed)
    with folder.locked():
        plan = plan_run(dataset, settings, fingerprint_of(placed.features))
        manifest = _manifest(dataset, plan, settings)
        check_resume(folder, manifest, settings.shaping(), may_be_added=("encoder",))
        write_manifest(folder, manifest)
        _write_whole_tables(folder, plan)
        work = PreprocessShard(
            str(dataset.root), folder.root if folder.is_local else out, placed, plan.fingerprint, plan.encoder
        )
        run_missing(folder, manifest, plan.shards, _tables_of, work, workers, "preprocess")
        check_shards(folder, _planned(plan))
        manifest |= {"status": "complete", "counts": _counts(folder, plan)}
        write_manifest(folder, manifest)
        if report:
            write_report(folder, manifest, AssetStore(dataset), settings.num_pictures)
    return manifest


def describe_plan(data: str, settings: PreprocessSettings) -> dict[str, Any]:
    """What a run would do: settings and counts, for ``--dry-run``."""
    dataset = MesaTaskDataset(_absolute(data))
    settings = settings.settled(dataset)
    plan = plan_run(dataset, settings, fingerprint_of(_placed(settings.features)))
    described = {
        "settings": asdict(settings),
        "input_fingerprint": plan.fingerprint,
        "encoder": plan.encoder,
        "num_shards": len(plan.shards),
    }
    return described | plan.counts()


def _absolute(path: str) -> Path:
    return Path(path).expanduser().resolve()


def _placed(features: str) -> str:
    """The setting ``features`` with its file as an absolute path, for workers have folders of their own."""
    if features in (AUTO, NONE):
        return features
    kind, colon, file = features.rpartition(":")
    return f"{kind}{colon}{_absolute(file)}"


def _settled(dataset: MesaTaskDataset, settings: PreprocessSettings, workers: WorkerPool) -> PreprocessSettings:
    """The settings with ``auto`` replaced, by a process of its own where workers are: a mesh must not end the run's."""
    if settings.position_convention != "auto" or workers.are_this_process:
        return settings.settled(dataset)
    settled = alone(settings.settled, dataset, seconds=64 * settings.seconds_per_item)
    if isinstance(settled, ProcessFailure):
        raise ConfigError(
            f"{dataset.root}: the check of what positions mean {str(settled).replace('_', ' ')} over a layout or mesh; "
            "set position_convention to box_centre or mesh_centre",
            "convention_unknown",
        )
    return settled


def _write_whole_tables(folder: RunFolder, plan: PreprocessPlan) -> None:
    """Rows that belong to no shard: what is odd about the dataset, and tables without rows, which are still tables."""
    lost = [
        n for n in plan.notices if n.code == "layout_missing"
    ]  # a scene folder without a layout is a failure like any other
    odd = [n for n in plan.notices if n.code != "layout_missing"]
    for table, notices in (("failures", lost), ("warnings", odd)):
        if OF_DATASET not in folder.shard_ids(table):
            folder.write_shard(table, OF_DATASET, [schemas.notice_row(n) for n in notices])
    if not plan.asset_ids:
        for table in ASSET_TABLES:
            folder.write_shard(table, _NO_ASSETS, [])
    if plan.encoder is not None and not plan.counts()["num_features"]:
        folder.write_shard("features", _NO_ASSETS, [])


def _planned(plan: PreprocessPlan) -> dict[str, set[str]]:
    """Shards of each table."""
    planned: dict[str, set[str]] = {table: set() for table in (*TABLES, "features")}
    for table in ("warnings", "failures"):
        planned[table].add(OF_DATASET)
    for table in ASSET_TABLES if not plan.asset_ids else ():
        planned[table].add(_NO_ASSETS)
    if plan.encoder is not None and not plan.counts()["num_features"]:
        planned["features"].add(_NO_ASSETS)
    for shard in plan.shards:
        for table in _tables_of(shard):
            planned[table].add(shard.shard_id)
    return planned


def _manifest(dataset: MesaTaskDataset, plan: PreprocessPlan, settings: PreprocessSettings) -> dict[str, Any]:
    return new_manifest(
        "preprocess",
        dataset.root.name,
        plan.fingerprint,
        inputs=dict(plan.inputs),
        encoder=plan.encoder,
        settings=asdict(settings),
        **plan.counts(),
    )


def _counts(folder: RunFolder, plan: PreprocessPlan) -> dict[str, Any]:
    return {
        **count_rows(folder, _tables_of_run(plan)),
        "failed_scenes": count_items(folder, "scenes", "scene_id", plan.scene_ids),
        "failed_assets": count_items(folder, "assets", "asset_id", plan.asset_ids),
    }
