"""A job of one's own: how full the tables of a run's scenes are. ``python -m examples.own_step RUN OUT``; it resumes."""

import sys
from functools import cached_property

import pyarrow as pa

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import ItemStep, Rows, Shard, StepShards
from pipelines.sources.scenes import TableSource
from stable_data.content_id import content_id
from stable_data.errors import SceneError
from stable_data.storage.table_rows import scene_from_row


class DensityStep(ItemStep[str]):
    TABLES = ("failures", "density")
    SCHEMAS = {"density": pa.schema([("scene_id", pa.string()), ("objects_per_m2", pa.float64())])}

    def __init__(self, run: str) -> None:
        self.run = run

    @cached_property
    def source(self) -> TableSource:
        return TableSource(self.run)  # opened by each worker

    def item_rows(self, item: str, progress: ItemProgress) -> Rows:
        scene = scene_from_row(self.source.row(item))
        if not scene.objects:
            raise SceneError(f"{item}: has no object, expected at least one; leave it out", "empty")
        width, depth = scene.table.size_xy
        return {"density": [{"scene_id": item, "objects_per_m2": len(scene.objects) / (width * depth)}]}


class DensityJob(ShardJob):
    name = "density"

    def __init__(self, run: str) -> None:
        self.source = TableSource(run)
        self.run, self.dataset = run, self.source.name

    def inputs(self) -> dict[str, str]:
        return {"scenes": content_id(sorted(self.source.folder.shard_ids("scenes")))}

    def plan(self) -> list[StepShards[str]]:
        cut = split_groups(self.source.scene_ids, 32)
        return [StepShards(DensityStep(self.run), [Shard(content_id(self.inputs(), part), tuple(part)) for part in cut])]

    def expected(self) -> list[ExpectedItems]:
        return [ExpectedItems("density", "scene_id", self.source.scene_ids, "failed_scenes")]


if __name__ == "__main__":
    run_job(DensityJob(sys.argv[1]), sys.argv[2], WorkerPool())
