"""The demonstrate job: episodes of a scripted expert in the scenes of a run, as the table ``episodes``."""

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import stable_data
from pipelines.demonstrate.environments import EpisodeRef
from pipelines.demonstrate.report import write_demonstrate_report
from pipelines.demonstrate.run_scenes import ScenesOfRun
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.demonstrate.shard import DemonstrateStep
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from stable_data.content_id import content_id
from stable_data.robot.arm.robots import robot_named
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder


def demonstrate(
    scenes: str, out: str, settings: DemonstrateSettings, workers: WorkerPool, *, where: str = "", report: bool = True
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_job(DemonstrateJob(scenes, settings, where), out, workers, report=report)


class DemonstrateJob(ShardJob):
    """Records episodes in the scenes of a run.

    Args:
        scenes: The run, with the tables ``scenes``, ``assets`` and ``meshes``; every node of a cluster must see it.
        settings: The job's settings.
        where: A condition on ``scenes``; empty: all of them.

    Raises:
        ConfigError: The run lacks a table, the condition is none or selects nothing, or the files of the robot are missing.
    """

    name = "demonstrate"
    settings: DemonstrateSettings

    def __init__(self, scenes: str, settings: DemonstrateSettings, where: str = "") -> None:
        robot_named(settings.robot)
        self.settings, self._scenes = settings, ScenesOfRun(scenes, where, settled=settings.settled)
        self.dataset = self._scenes.name

    def inputs(self) -> dict[str, Any]:
        """Hashes of the tables, and the condition."""
        return self._scenes.inputs() | ({"lead": self._lead} if self.settings.lead else {})

    @cached_property
    def _lead(self) -> str:
        """Fingerprint of the policy that acts first."""
        from models.policy.chunk_policy import open_policy  # takes seconds to import

        return open_policy(self.settings.lead).fingerprint

    def about(self) -> dict[str, Any]:
        """The number of scenes and of episodes."""
        return {"num_scenes": len(self._scenes.ids), "num_episodes": len(self._scenes.ids) * self.settings.episodes}

    def plan(self) -> Sequence[StepShards[Any]]:
        """The step of all episodes; those of a scene are in one shard."""
        shaping = self.settings.shaping() | {"table_version": schemas.TABLE_VERSION, "code": stable_data.__version__}
        groups = split_groups(self._scenes.ids, self.settings.shard_size(len(self._scenes.ids)))
        tables = self.inputs()
        shards = [
            Shard(
                content_id("demonstrate", shaping, tables, list(group)),
                tuple(EpisodeRef(scene_id, number) for scene_id in group for number in range(self.settings.episodes)),
            )
            for group in groups
        ]
        return [StepShards(DemonstrateStep(self._scenes.run, self.settings), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All episodes."""
        ids = [str(EpisodeRef(s, n)) for s in self._scenes.ids for n in range(self.settings.episodes)]
        return [ExpectedItems("episodes", "episode_id", ids, "failed_episodes")]

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Counts episodes by kind of task and by result."""
        rows = folder.table("episodes", ["task_kind", "success", "reason"]).to_pylist()
        kinds = Counter(row["task_kind"] for row in rows)
        done = Counter(row["task_kind"] for row in rows if row["success"])
        reasons = Counter(str(row["reason"]).partition(":")[0] for row in rows if not row["success"])
        return {
            "successes": sum(done.values()),
            "by_task": {kind: [done[kind], kinds[kind]] for kind in sorted(kinds)},
            "by_reason": dict(sorted(reasons.items())),
        }

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_demonstrate_report(folder, manifest, self.settings.num_pictures)
