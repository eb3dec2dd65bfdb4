"""Generate: tasks become simulation-ready scenes, by Algorithm 1, in this process or on a Ray cluster."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from models.physics_corrector.learned import load_flow, weights_fingerprint
from models.semantic_reasoner.assembly import shaping_of_proposals
from models.semantic_reasoner.staged import LayoutTask
from pipelines.asset_shelf import AssetShelf
from pipelines.correct import OF_DATASET, write_notices
from pipelines.generate_settings import GenerateSettings
from pipelines.generate_step import GenerateWork
from pipelines.job import check_resume, check_shards, count_items, count_rows, new_manifest, run_missing, write_manifest
from pipelines.runner import Workers
from pipelines.scene_work import SceneShard
from stable_data.errors import ConfigError, Notice
from stable_data.shards import RunFolder, content_id


def generate(
    tasks: Sequence[LayoutTask | Notice],
    out: str,
    settings: GenerateSettings,
    workers: Workers,
    assets: Sequence[str] = (),
    name: str = "tasks",
) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        tasks: What is to be laid out, and what could not be read as that.
        out: Local folder that every worker can write, or object-store URI.
        settings: What shapes the rows.
        workers: Who runs the shards.
        assets: Where assets are taken from, see :class:`pipelines.asset_shelf.AssetShelf`; every node of a cluster must see them.
        name: Of where the tasks come from.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    folder = RunFolder(out)
    asked = [task for task in tasks if isinstance(task, LayoutTask)]
    lost = [task for task in tasks if isinstance(task, Notice)]
    if not asked:
        raise ConfigError(f"{name}: holds no task that can be used, expected one at least", "tasks_invalid")
    places = tuple(place if "://" in place else str(Path(place).expanduser().resolve()) for place in assets)
    shelf = AssetShelf(places)
    weights = weights_fingerprint(settings.weights)
    load_flow(settings.weights, settings.steps)  # what cannot be used is refused before anything is written
    inputs = {"tasks": content_id([asdict(task) for task in tasks]), "weights": weights}
    inputs |= {"reasoner": content_id(shaping_of_proposals(settings.engine, settings.reasoner))}
    inputs |= {f"assets.{library}": found for library, found in shelf.fingerprints.items()}
    shaping = settings.shaping()
    made_of = {key: value for key, value in inputs.items() if key != "tasks"}
    with folder.locked():
        shards = [
            SceneShard(content_id("generate", shaping, made_of, [asdict(task) for task in part]), part)
            for part in _parts(asked, settings.scenes_per_shard)
        ]
        fingerprint = content_id(inputs)
        manifest = new_manifest(
            "generate", name, fingerprint, inputs=inputs, settings=asdict(settings) | shaping, num_tasks=len(tasks)
        )
        check_resume(folder, manifest, shaping)
        write_manifest(folder, manifest)
        write_notices(folder, lost, [])
        work = GenerateWork(folder.root if folder.is_local else out, places, settings, fingerprint)
        run_missing(folder, shards, lambda _: GenerateWork.TABLES, work, workers, "generate", "scene")
        ids = {shard.shard_id for shard in shards}
        both = ("warnings", "failures")
        check_shards(folder, {table: ids | {OF_DATASET} if table in both else ids for table in GenerateWork.TABLES})
        failed = count_items(folder, "scenes", "scene_id", [*(t.scene_id for t in asked), *(n.item_id for n in lost)])
        manifest |= {"status": "complete", "counts": {**count_rows(folder, GenerateWork.TABLES), "failed_scenes": failed}}
        write_manifest(folder, manifest)
    return manifest


def _parts(tasks: Sequence[LayoutTask], size: int) -> Iterator[tuple[LayoutTask, ...]]:
    rest = iter(tasks)
    while part := tuple(itertools.islice(rest, size)):
        yield part
