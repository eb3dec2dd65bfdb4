"""The rate job: the scenes of a run with their ratings, as the table ``ratings``."""

from collections.abc import Sequence
from typing import Any

import stable_data
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.rate.report import summary_counts, write_rate_report
from pipelines.rate.settings import RateSettings
from pipelines.rate.shard import RateStep
from pipelines.sources.run_scenes import ScenesOfRun
from stable_data.content_id import content_id
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder


def rate(
    scenes: str, out: str, settings: RateSettings, workers: WorkerPool, *, where: str = "", report: bool = True
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_job(RateJob(scenes, settings, where), out, workers, report=report)


class RateJob(ShardJob):
    """Rates the scenes of a run.

    Args:
        scenes: The run, with the tables ``scenes``, ``assets`` and ``meshes``; every node of a cluster must see it.
        settings: The job's settings.
        where: A condition on ``scenes``; empty: all of them.

    Raises:
        ConfigError: The run lacks a table, or has no such scenes; or the key of the endpoint is missing (``key_missing``).
    """

    name = "rate"
    settings: RateSettings

    def __init__(self, scenes: str, settings: RateSettings, where: str = "") -> None:
        self.settings, self._scenes = settings.settled(), ScenesOfRun(scenes, where)
        self.dataset = self._scenes.name
        self._shaping = self.settings.shaping()

    def inputs(self) -> dict[str, Any]:
        """Hashes of the tables."""
        return self._scenes.inputs()

    def about(self) -> dict[str, Any]:
        """The number of scenes."""
        return {"num_scenes": len(self._scenes.ids)}

    def plan(self) -> Sequence[StepShards[Any]]:
        """One step over the scenes."""
        shaping = self._shaping | {"table_version": schemas.TABLE_VERSION, "code": stable_data.__version__}
        groups, tables = split_groups(self._scenes.ids, self.settings.shard_size(len(self._scenes.ids))), self.inputs()
        shards = [Shard(content_id("rate", shaping, tables, list(group)), tuple(group)) for group in groups]
        return [StepShards(RateStep(self._scenes.run, self.settings), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All scenes."""
        return [ExpectedItems("ratings", "scene_id", self._scenes.ids, "failed_scenes")]

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Computes the averages."""
        return summary_counts(folder)

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_rate_report(folder, manifest)
