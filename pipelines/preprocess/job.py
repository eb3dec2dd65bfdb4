"""The preprocess job: a folder of scenes in the MesaTask-10K format becomes tables with stages and geometry."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.preprocess.convention import resolve_convention
from pipelines.preprocess.features import AUTO, NONE, fingerprint_of
from pipelines.preprocess.plan import PreprocessPlan, plan_run
from pipelines.preprocess.report import write_report
from pipelines.preprocess.settings import PreprocessSettings
from pipelines.preprocess.shard import AssetStep, FeatureStep, SceneStep, task_writer
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import Notice
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.run_folder import RunFolder

T = TypeVar("T")


def preprocess(
    data: str, out: str, settings: PreprocessSettings, workers: WorkerPool, *, report: bool = True
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_job(PreprocessJob(data, settings, workers), out, workers, report=report)


class PreprocessJob(ShardJob):
    """Turns a folder of scenes into tables with stages and geometry.

    Args:
        data: Root of a dataset in the MesaTask-10K format; every node of a cluster must see it under this path.
        settings: The job's settings.
        workers: The workers that run the shards.

    Raises:
        ConfigError: The folder is not a dataset, its position convention cannot be determined, or the task writer is missing.
    """

    ADDED = ("encoder",)

    name = "preprocess"
    settings: PreprocessSettings

    def __init__(self, data: str, settings: PreprocessSettings, workers: WorkerPool) -> None:
        self.source = MesaTaskDataset(_absolute(data))
        self.dataset = self.source.root.name
        self.settings = resolve_convention(settings, self.source, str(self.source.root), workers)
        self._absolute_settings = replace(
            self.settings, task_cache=str(_absolute(settings.task_cache)), features=_absolute_features(settings.features)
        )
        task_writer(self._absolute_settings)

    @cached_property
    def _plan(self) -> PreprocessPlan:
        return plan_run(self.source, self.settings, fingerprint_of(self._absolute_settings.features))

    def inputs(self) -> dict[str, Any]:
        """Hashes of the dataset's contents by kind."""
        return dict(self._plan.inputs)

    def about(self) -> dict[str, Any]:
        """The encoder and the numbers of scenes, assets and features."""
        return {"encoder": self._plan.encoder, **self._plan.counts()}

    def plan(self) -> Sequence[StepShards[Any]]:
        """The steps; a step without assets gets an empty shard, so that its tables exist."""
        found, of_step = self._plan, (str(self.source.root), self._absolute_settings, content_id(self.inputs()))
        features = FeatureStep(*of_step, found.encoder or "")
        return [
            StepShards(AssetStep(*of_step), _or_empty(found.assets)),
            StepShards(features, () if found.encoder is None else _or_empty(found.features)),
            StepShards(SceneStep(*of_step), found.scenes),
        ]

    def expected(self) -> Sequence[ExpectedItems]:
        """All scenes, and all assets with a mesh."""
        return [
            ExpectedItems("scenes", "scene_id", self._plan.scene_ids, "failed_scenes"),
            ExpectedItems("assets", "asset_id", self._plan.asset_ids, "failed_assets", with_lost=False),
        ]

    def lost(self) -> Sequence[Notice]:
        """Scene folders without a layout."""
        return [n for n in self._plan.notices if n.code == "layout_missing"]

    def odd(self) -> Sequence[Notice]:
        """All other notices about the dataset."""
        return [n for n in self._plan.notices if n.code != "layout_missing"]

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_report(folder, manifest, AssetStore(self.source), self.settings.num_pictures)


def _or_empty(shards: Sequence[Shard[T]]) -> Sequence[Shard[T]]:
    return shards or (Shard(content_id("no assets"), ()),)


def _absolute(path: str) -> Path:
    return Path(path).expanduser().resolve()


def _absolute_features(features: str) -> str:
    """The setting ``features`` with an absolute path, because workers have other current folders."""
    if features in (AUTO, NONE):
        return features
    kind, colon, file = features.rpartition(":")
    return f"{kind}{colon}{_absolute(file)}"
