"""The demonstrate job: episodes of a scripted expert in the scenes of a run, as the table ``episodes``."""

from collections import Counter
from functools import cached_property
from typing import Any

from pipelines.demonstrate.episodes_job import EpisodesJob
from pipelines.demonstrate.report import write_demonstrate_report
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.demonstrate.shard import DemonstrateStep
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import run_job
from stable_data.storage.run_folder import RunFolder


def demonstrate(
    scenes: str, out: str, settings: DemonstrateSettings, workers: WorkerPool, *, where: str = "", report: bool = True
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_job(DemonstrateJob(scenes, settings, where), out, workers, report=report)


class DemonstrateJob(EpisodesJob):
    """Records episodes of the scripted expert in the scenes of a run; the arguments are those of :class:`EpisodesJob`."""

    name = "demonstrate"
    settings: DemonstrateSettings

    def step(self) -> DemonstrateStep:
        """The step that records episodes."""
        return DemonstrateStep(self.scenes.run, self.settings)

    def inputs(self) -> dict[str, Any]:
        """Hashes of the tables, and the condition."""
        return self.scenes.inputs() | ({"lead": self._lead} if self.settings.lead else {})

    @cached_property
    def _lead(self) -> str:
        """Fingerprint of the policy that acts first."""
        from models.policy.chunk_policy import open_policy  # takes seconds to import

        return open_policy(self.settings.lead).fingerprint

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
