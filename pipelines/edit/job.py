"""The edit job: instructions change scenes; objects that an instruction does not mention stay in place."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
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
from pipelines.execution.engine_pool import refuse_without_workers
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.sources.asset_copies import CopyAssets, asset_shards
from pipelines.sources.assets import AssetLibraries, absolute_places
from pipelines.sources.edits import EditRequest, read_edits
from pipelines.sources.scenes import TableSource
from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.store import AssetStore
from stable_data.config_diff import flatten_config
from stable_data.content_id import content_id
from stable_data.errors import Notice
from stable_data.storage.run_folder import RunFolder


def edit(
    scenes: str,
    edits: Path,
    out: str,
    settings: EditSettings,
    workers: WorkerPool,
    assets: Sequence[str] = (),
    *,
    report: bool = True,
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    check_place(scenes, out)
    refuse_without_workers("correctors", settings.correctors, workers)
    return run_job(EditJob(scenes, edits, settings, workers, assets), out, workers, report=report)


class EditJob(SceneJob[EditSettings]):
    """Changes scenes by instructions.

    Args:
        scenes: A folder in the MesaTask-10K format, or a run with a table ``scenes``; every node of a cluster must see it.
        edits: File with one edit in each line, see :func:`pipelines.sources.edits.read_edits`.
        settings: The job's settings; those of the reasoner matter only for edits without a reply.
        workers: The workers that run the shards.
        assets: Asset libraries that are searched after that of the scenes, see :class:`pipelines.sources.assets.AssetLibraries`;
            every node of a cluster must see them.
    """

    name = "edit"

    def __init__(
        self, scenes: str, edits: Path, settings: EditSettings, workers: WorkerPool, assets: Sequence[str] = ()
    ) -> None:
        super().__init__(scenes, settings, workers)
        self.assets = absolute_places(assets)
        self.found = read_edits(edits, set(self.source.scene_ids))
        self.settings = self.settings.of_items(len(self.found.edits))

    @cached_property
    def _libraries(self) -> AssetLibraries:
        return AssetLibraries(self.assets, scenes=self.where)

    @cached_property
    def _inputs(self) -> dict[str, Any]:
        settings, weights = self.settings, NONE
        if settings.correct:
            weights = weights_fingerprint(settings.weights)
            load_flow(settings.weights, settings.steps)
        _, of_scenes = self.source.parts(settings.scene_settings(), settings.scenes_per_shard)
        asked = [asdict(edit) for edit in self.found.edits], [asdict(notice) for notice in self.found.failures]
        inputs: dict[str, Any] = {**of_scenes, "edits": content_id(asked)}
        inputs |= {f"assets.{library}": found for library, found in self._libraries.fingerprints.items()}
        inputs |= {"weights": weights}
        return inputs | (flatten_config(proposal_config(settings.engine, settings.reasoner), "reasoner.") if self._asks else {})

    @property
    def _asks(self) -> bool:
        """Whether at least one edit has no reply, so that the reasoner is asked."""
        return any(edit.reply is None for edit in self.found.edits)

    def inputs(self) -> dict[str, Any]:
        """Hashes of the scenes, the edits, the libraries, the weights, and the configuration of the reasoner."""
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
        return [StepShards(EditWork(self.where, self.settings, fingerprint, self.assets), shards)]

    def later_plans(self, folder: RunFolder) -> Iterator[Sequence[StepShards[Any]]]:
        """The step that copies the assets of the edited scenes, except those of an input run, which are copied with its tables."""
        libraries = content_id(self._libraries.fingerprints)
        # Decomposing meshes takes longer than editing, and most edited scenes are neither simulated nor exported.
        copies = CopyAssets(self.assets, libraries, self.settings.seconds_per_item, self.where, decomposes=False)
        there = set()
        if isinstance(self.source, TableSource):
            there = set(self.source.folder.table("assets", ["asset_id"])["asset_id"].to_pylist())
        yield [StepShards(copies, asset_shards(folder, ("scenes",), libraries, there))]

    def other_assets(self, folder: RunFolder) -> Mapping[str, tuple[AssetAnnotation, Path]]:
        """Annotations and meshes of the assets of other libraries."""
        shelf = self._libraries
        used = folder.table("assets", ["asset_id"])["asset_id"].to_pylist()
        paths = {a: shelf.asset_path(a) for a in used if not shelf.is_of_first(a)}
        return {a: (shelf.annotation(a), path) for a, path in paths.items() if path is not None}

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
        write_edit_report(folder, manifest, AssetStore(self._libraries), self.settings)
