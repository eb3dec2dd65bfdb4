"""The views job: pictures of the scenes of a run and their features, in the table ``views``."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from models.picture_features import FeatureExtractor, extractor_named
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.sources.run_scenes import ScenesOfRun
from pipelines.views.report import write_views_report
from pipelines.views.settings import ViewsSettings
from pipelines.views.shard import ViewsStep
from stable_data.content_id import content_id
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder


def draw_views(
    scenes: str, out: str, settings: ViewsSettings, workers: WorkerPool, *, where: str = "", report: bool = True
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_job(ViewsJob(scenes, settings, where), out, workers, report=report)


class ViewsJob(ShardJob):
    """Draws the scenes of a run.

    Args:
        scenes: The run, with the tables ``scenes``, ``assets`` and ``meshes``; every node of a cluster must see it.
        settings: The job's settings.
        where: A condition on ``scenes``; empty: all.

    Raises:
        ConfigError: The run lacks a table, or has no such scenes; or the weights of the features are missing (``weights_missing``).
    """

    name = "views"
    settings: ViewsSettings

    def __init__(self, scenes: str, settings: ViewsSettings, where: str = "") -> None:
        self.settings, self._scenes = settings.resolved(), ScenesOfRun(scenes, where)
        self.dataset = self._scenes.name

    @cached_property
    def extractor(self) -> FeatureExtractor:
        """What computes the features."""
        return extractor_named(self.settings.features, self.settings.device)

    def inputs(self) -> dict[str, Any]:
        """Hashes of the tables and of the extractor."""
        return self._scenes.inputs() | {"extractor": self.extractor.fingerprint}

    def about(self) -> dict[str, Any]:
        """The number of scenes, and what distances of the features are called."""
        return {
            "num_scenes": len(self._scenes.ids),
            "features": self.extractor.name,
            "distance": self.extractor.distance_name,
            "kernel_distance": self.extractor.kernel_distance_name,
        }

    def plan(self) -> Sequence[StepShards[Any]]:
        """One step over the scenes."""
        shaping = self.settings.shaping() | {"table_version": schemas.TABLE_VERSION}
        groups, inputs = split_groups(self._scenes.ids, self.settings.shard_size(len(self._scenes.ids))), self.inputs()
        shards = [Shard(content_id("views", shaping, inputs, list(group)), tuple(group)) for group in groups]
        return [StepShards(ViewsStep(self._scenes.run, self.settings), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All scenes."""
        return [ExpectedItems("views", "scene_id", self._scenes.ids, "failed_scenes")]

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_views_report(folder, manifest)
