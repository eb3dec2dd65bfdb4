"""The reach job: the scenes of a run with what a robot reaches and holds in them, as columns of ``scenes`` and the table ``grasps``."""

from collections.abc import Sequence
from typing import Any

import stable_data
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.reach.report import write_reach_report
from pipelines.reach.settings import ReachSettings
from pipelines.reach.shard import ReachStep
from pipelines.sources.carried_tables import CARRIED_TABLES, carry_tables, refuse_links_out
from pipelines.sources.run_scenes import ScenesOfRun
from stable_data.content_id import content_id
from stable_data.metrics.reach_columns import GRASPABLE, REACHABLE
from stable_data.robot.arm.robots import robot_named
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

_CARRIED = (*CARRIED_TABLES, "settled")


def reach(scenes: str, out: str, settings: ReachSettings, workers: WorkerPool, *, report: bool = True) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_job(ReachJob(scenes, settings), out, workers, report=report)


class ReachJob(ShardJob):
    """Surveys the scenes of a run.

    Args:
        scenes: The run, with the tables ``scenes``, ``assets`` and ``meshes``; every node of a cluster must see it.
        settings: The job's settings.

    Raises:
        ConfigError: The run lacks a table, or has no scenes; or the files of the robot are missing (``robot_missing``); or
            a table that it copies has a link out of the run (``link_leaves``).
    """

    name = "reach"
    settings: ReachSettings

    def __init__(self, scenes: str, settings: ReachSettings) -> None:
        robot_named(settings.robot)
        self.settings, self._scenes = settings, ScenesOfRun(scenes)
        self.dataset = self._scenes.name
        refuse_links_out(RunFolder(self._scenes.run), _CARRIED)

    def inputs(self) -> dict[str, Any]:
        """Hashes of the tables."""
        return self._scenes.inputs()

    def about(self) -> dict[str, Any]:
        """The number of scenes."""
        return {"num_scenes": len(self._scenes.ids)}

    def plan(self) -> Sequence[StepShards[Any]]:
        """One step over the scenes."""
        shaping = self.settings.shaping() | {"table_version": schemas.TABLE_VERSION, "code": stable_data.__version__}
        groups, tables = split_groups(self._scenes.ids, self.settings.shard_size(len(self._scenes.ids))), self.inputs()
        shards = [Shard(content_id("reach", shaping, tables, list(group)), tuple(group)) for group in groups]
        return [StepShards(ReachStep(self._scenes.run, self.settings), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All scenes."""
        return [ExpectedItems("scenes", "scene_id", self._scenes.ids, "failed_scenes")]

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Copies the tables of assets, and of the poses after settling; counts the scenes by verdict."""
        carried = carry_tables(RunFolder(self._scenes.run), folder, _CARRIED)
        rows = folder.table("scenes", [REACHABLE, GRASPABLE])
        counts = {table: folder.num_rows(table) for table in carried}
        return counts | {name: rows[name].to_pylist().count(True) for name in (REACHABLE, GRASPABLE)}

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_reach_report(folder, manifest)
