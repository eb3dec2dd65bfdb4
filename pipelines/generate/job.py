"""Generate: tasks become simulation-ready scenes, by Algorithm 1, in this process or on a Ray cluster."""

import json
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

import ray

from models.physics_corrector.learned_flow import load_flow, weights_fingerprint
from models.semantic_reasoner.factory import shaping_of_proposals
from pipelines.correct.job import write_notices
from pipelines.correct.scene_shard import SceneShard
from pipelines.execution.engine_pool import PooledEngine, engine_pool
from pipelines.execution.progress_bar import LocalTally, ProgressTally, SharedTally
from pipelines.execution.ray_executor import WorkerPool, connect
from pipelines.execution.shard_job import (
    OF_DATASET,
    check_resume,
    check_shards,
    count_items,
    count_rows,
    new_manifest,
    run_missing,
    write_manifest,
)
from pipelines.generate.assets import CarryWork, asset_shards
from pipelines.generate.report import write_generate_report
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import GenerateWork
from pipelines.preprocess.plan import groups
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import Task, TaskSource
from stable_data.content_id import content_id
from stable_data.embedded_world.library import NAME as EMBEDDED
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder


def generate(
    tasks: TaskSource,
    out: str,
    settings: GenerateSettings,
    workers: WorkerPool,
    assets: Sequence[str] = (),
    *,
    report: bool = True,
) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        tasks: What is asked for.
        out: Local folder that every worker can write, or object-store URI.
        settings: What shapes the rows.
        workers: Who runs the shards.
        assets: Where assets are taken from, see :class:`pipelines.sources.assets.AssetLibraries`; every node of a cluster must
            see them.
        report: Whether to write the report page and the sheet of pictures.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    if settings.engines and workers.are_this_process:
        raise ConfigError(
            f"engines is {settings.engines}, but in this process alone (--workers 0) nobody shares them; take workers, or leave "
            "engines at 0",
            "config_invalid",
        )
    folder, places, settings = RunFolder(out), _absolute(assets), settings.of_tasks(len(tasks.tasks))
    shelf = AssetLibraries(places)
    inputs = _inputs(tasks, settings, shelf)
    fingerprint, shards = content_id(inputs), _shards(tasks.tasks, settings, inputs)
    with folder.locked():
        manifest = new_manifest(
            "generate",
            tasks.name,
            fingerprint,
            inputs=inputs,
            settings=asdict(settings) | settings.shaping(),
            engine=settings.engine.engine,
            num_tasks=len(tasks.tasks) + len(tasks.lost),
        )
        check_resume(folder, manifest, settings.shaping())
        manifest |= {"work": _former_work(folder)}
        write_manifest(folder, manifest)
        write_notices(folder, tasks.lost, [])
        there, began = folder.shard_ids("scenes"), perf_counter()
        place = folder.root if folder.is_local else out
        with _shared(settings, workers, there, shards) as (pool, tally):
            work = GenerateWork(place, places, settings, fingerprint, pool, tally)
            run_missing(folder, manifest, shards, lambda _: work.TABLES, work, workers, "generate", "scene", tally)
        if made := sum(len(shard) for shard in shards if shard.shard_id not in there):
            manifest["work"].append({"seconds": round(perf_counter() - began, 1), "scenes": made})
        libraries = content_id(shelf.fingerprints)
        carried = asset_shards(folder, ("scenes", "rejected"), libraries)
        carry = CarryWork(place, places, libraries, settings.seconds_per_item)
        # Engines are gone by now, and so is what the workers of a Ray of our own had opened.
        run_missing(folder, manifest, carried, lambda _: carry.TABLES, carry, workers, "assets", "asset")
        _check(folder, shards, carried, carry)
        ids = [*(task.scene_id for task in tasks.tasks), *(notice.item_id for notice in tasks.lost)]
        failed = count_items(folder, "scenes", "scene_id", ids)
        names = dict.fromkeys((*work.TABLES, *carry.TABLES))
        manifest |= {"status": "complete", "counts": {**count_rows(folder, names), "failed_scenes": failed}}
        write_manifest(folder, manifest)
        if report:
            write_generate_report(folder, manifest, settings)
    return manifest


@contextmanager
def _shared(
    settings: GenerateSettings, workers: WorkerPool, there: Set[str], shards: Sequence[SceneShard[Task]]
) -> Iterator[tuple[PooledEngine | None, ProgressTally | None]]:
    """What the workers share as long as there is something to do: engines, unless each has its own, and whom they tell of it."""
    if {shard.shard_id for shard in shards} <= there:
        yield None, None
        return
    if workers.are_this_process:
        yield None, LocalTally()
        return
    started = connect(workers)
    try:
        pool = None
        if settings.engines:
            pool = engine_pool(settings.engine, settings.engines, settings.engine_gpus, may_grow=not started)
        yield pool, SharedTally.started()
    finally:
        if started:
            ray.shutdown()


def describe_generation(tasks: TaskSource, settings: GenerateSettings, assets: Sequence[str] = ()) -> dict[str, Any]:
    """What a run would do: settings, inputs and counts, for ``--dry-run``."""
    inputs, settings = _inputs(tasks, settings, AssetLibraries(_absolute(assets))), settings.of_tasks(len(tasks.tasks))
    return {
        "tasks": tasks.name,
        "num_tasks": len(tasks.tasks),
        "num_tasks_lost": len(tasks.lost),
        "num_shards": len(_shards(tasks.tasks, settings, inputs)),
        "inputs": inputs,
        "settings": asdict(settings) | settings.shaping(),
    }


def _absolute(assets: Sequence[str]) -> tuple[str, ...]:
    return tuple(p if "://" in p or p == EMBEDDED else str(Path(p).expanduser().resolve()) for p in assets)


def _inputs(tasks: TaskSource, settings: GenerateSettings, shelf: AssetLibraries) -> dict[str, Any]:
    """Content of all inputs by their kind; what cannot be used is refused here, before anything is written."""
    load_flow(settings.weights, settings.steps)
    return {
        "tasks": content_id([asdict(task) for task in tasks.tasks], [asdict(notice) for notice in tasks.lost]),
        "weights": weights_fingerprint(settings.weights),
        "reasoner": content_id(shaping_of_proposals(settings.engine, settings.reasoner)),
        **{f"assets.{library}": found for library, found in shelf.fingerprints.items()},
    }


def _shards(tasks: Sequence[Task], settings: GenerateSettings, inputs: dict[str, Any]) -> list[SceneShard[Task]]:
    """Tasks in shards, named by what shapes their rows; of the other tasks nothing does."""
    shaping, made_of = settings.shaping(), {key: value for key, value in inputs.items() if key != "tasks"}
    return [
        SceneShard(content_id("generate", shaping, made_of, [asdict(task) for task in part]), tuple(part))
        for part in groups(tasks, settings.scenes_per_shard)
    ]


def _former_work(folder: RunFolder) -> list[dict[str, Any]]:
    """How long the run was at work before it was stopped, as its manifest has it."""
    content = folder.read_bytes("manifest.json")
    return [] if content is None else list(json.loads(content).get("work", []))


def _check(folder: RunFolder, shards: Sequence[Any], carried: Sequence[Any], carry: CarryWork) -> None:
    """Refuses a folder that holds other shards than this run's."""
    made, assets = {shard.shard_id for shard in shards}, {shard.shard_id for shard in carried}
    both = ("warnings", "failures")
    planned = {table: made for table in GenerateWork.TABLES if table not in both}
    planned |= {table: assets for table in carry.TABLES if table not in both}
    check_shards(folder, planned | {table: made | assets | {OF_DATASET} for table in both})
