"""The edit job: instructions change scenes; objects that an instruction does not mention stay in place."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

from models.physics_corrector.learned_flow import NONE, load_flow, weights_fingerprint
from models.semantic_reasoner.factory import proposal_config
from pipelines.correct.job import SceneJob, check_place
from pipelines.edit.report import write_edit_report
from pipelines.edit.settings import EditSettings
from pipelines.edit.shard import EditWork
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.sources.edits import EditRequest, read_edits
from pipelines.sources.scenes import FolderSource
from stable_data.config_diff import flatten_config
from stable_data.content_id import content_id
from stable_data.errors import Notice
from stable_data.mesatask.library import ANNOTATION_FILE
from stable_data.storage.run_folder import RunFolder


def edit(
    scenes: str, edits: Path, out: str, settings: EditSettings, workers: WorkerPool, *, report: bool = True
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    check_place(scenes, out)
    return run_job(EditJob(scenes, edits, settings, workers), out, workers, report=report)


class EditJob(SceneJob[EditSettings]):
    """Changes scenes by instructions.

    Args:
        scenes: A folder in the MesaTask-10K format, or a run with a table ``scenes``; every node of a cluster must see it.
        edits: File with one edit in each line, see :func:`pipelines.sources.edits.read_edits`.
        settings: The job's settings; those of the reasoner matter only for edits without a reply.
        workers: The workers that run the shards.
    """

    name = "edit"

    def __init__(self, scenes: str, edits: Path, settings: EditSettings, workers: WorkerPool) -> None:
        super().__init__(scenes, settings, workers)
        self.found = read_edits(edits, set(self.source.scene_ids))
        self.settings = self.settings.of_items(len(self.found.edits))

    @cached_property
    def _inputs(self) -> dict[str, Any]:
        settings, weights = self.settings, NONE
        if settings.correct:
            weights = weights_fingerprint(settings.weights)
            load_flow(settings.weights, settings.steps)
        _, of_scenes = self.source.parts(settings.scene_settings(), settings.scenes_per_shard)
        asked = [asdict(edit) for edit in self.found.edits], [asdict(notice) for notice in self.found.failures]
        inputs: dict[str, Any] = {**of_scenes, "edits": content_id(asked)}
        if isinstance(self.source, FolderSource):  # an edit may add assets that no scene uses yet
            path = self.source.dataset.root / ANNOTATION_FILE
            inputs |= {"library": content_id(path.read_text("utf-8") if path.is_file() else "")}
        inputs |= {"weights": weights}
        return inputs | (flatten_config(proposal_config(settings.engine, settings.reasoner), "reasoner.") if self._asks else {})

    @property
    def _asks(self) -> bool:
        """Whether at least one edit has no reply, so that the reasoner is asked."""
        return any(edit.reply is None for edit in self.found.edits)

    def inputs(self) -> dict[str, Any]:
        """Hashes of the scenes, the edits, the weights, and the configuration of the reasoner."""
        return self._inputs

    def about(self) -> dict[str, Any]:
        """The number of edits and the name of the engine."""
        return {"engine": self.settings.engine.engine if self._asks else NONE, "num_edits": len(self.found.ids)}

    def plan(self) -> Sequence[StepShards[Any]]:
        """One step over the edits in order; at least one shard, so that every table exists."""
        fingerprint = content_id(self._inputs)
        parts: list[Sequence[EditRequest]] = [*split_groups(self.found.edits, self.settings.scenes_per_shard)] or [()]
        named = "edit", self.settings.shaping(), fingerprint
        shards = [Shard(content_id(*named, [asdict(e) for e in part]), tuple(part)) for part in parts]
        return [StepShards(EditWork(self.where, self.settings, fingerprint), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All edits."""
        return [ExpectedItems("scenes", "scene_id", self.found.ids, "failed_edits")]

    def lost(self) -> Sequence[Notice]:
        """The invalid lines."""
        return self.found.failures

    def kinds(self, folder: RunFolder) -> dict[str, Any]:
        """The number of edits by kind."""
        return {"by_kind": dict(sorted(Counter(folder.table("edits", ["kind"])["kind"].to_pylist()).items()))}

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_edit_report(folder, manifest, self.source.store, self.settings.num_pictures)
