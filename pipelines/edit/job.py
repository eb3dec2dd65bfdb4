"""Edit: scenes and instructions that change them become changed scenes, all that was not named where it was."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from models.physics_corrector.learned_flow import NONE, load_flow, weights_fingerprint
from models.semantic_reasoner.factory import shaping_of_proposals
from pipelines.correct.job import carry_assets, places, settled_here, write_dataset, write_notices
from pipelines.correct.scene_shard import SceneShard
from pipelines.edit.report import write_edit_report
from pipelines.edit.settings import EditSettings
from pipelines.edit.shard import EditWork
from pipelines.execution.ray_executor import WorkerPool
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
from pipelines.sources.edits import EditFile, EditRequest, read_edits
from pipelines.sources.scenes import FolderSource, SceneSource, scene_source
from stable_data.config_diff import flat
from stable_data.content_id import content_id
from stable_data.mesatask.library import ANNOTATION_FILE


def edit(
    scenes: str,
    edits: Path,
    out: str,
    settings: EditSettings,
    workers: WorkerPool,
    *,
    report: bool = True,
) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        scenes: A folder in the MesaTask-10K format, or a run with a table ``scenes``; every node of a cluster must see it.
        edits: File with one edit a line, see :func:`pipelines.sources.edits.read_edits`.
        out: Local folder, likewise, or object-store URI.
        settings: What shapes the rows, the reasoner included, which only edits without a reply need.
        workers: Who runs the shards.
        report: Whether to write the report page.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    where, folder = places(scenes, out)
    source = scene_source(where)
    settings = settled_here(source, settings, workers)
    weights = _weights(settings)
    if settings.correct:
        load_flow(settings.weights, settings.steps)  # what cannot be used is refused before anything is written
    with folder.locked():
        found, inputs = _read(source, edits, settings)
        asks = _reasoner(found, settings)
        inputs |= {"weights": weights, **asks}
        fingerprint = content_id(inputs)
        manifest = new_manifest(
            "edit",
            source.name,
            fingerprint,
            inputs=inputs,
            settings=asdict(settings),
            engine=settings.engine.engine if asks else NONE,
            num_edits=len(found.ids),
        )
        check_resume(folder, manifest, settings.shaping())
        write_manifest(folder, manifest)
        write_notices(folder, found.failures, ())
        shards = _shards(found.edits, settings, fingerprint)
        work = EditWork(where, folder.root if folder.is_local else out, settings, fingerprint)
        run_missing(folder, manifest, shards, lambda _: EditWork.TABLES, work, workers, "edit", "edit")
        ids = {shard.shard_id for shard in shards}
        check_shards(folder, {t: ids | {OF_DATASET} if t in ("warnings", "failures") else ids for t in EditWork.TABLES})
        carried = carry_assets(source, folder)
        failed = count_items(folder, "scenes", "scene_id", found.ids)
        kinds = Counter(folder.table("edits", ["kind"])["kind"].to_pylist())
        counts = {
            **count_rows(folder, (*EditWork.TABLES, *carried)),
            "failed_edits": failed,
            "by_kind": dict(sorted(kinds.items())),
        }
        manifest |= {"status": "complete", "counts": counts}
        write_manifest(folder, manifest)
        if settings.write_dataset and isinstance(source, FolderSource) and folder.is_local:
            write_dataset(source, folder)
        if report:
            write_edit_report(folder, manifest, source.store, settings.num_pictures)
    return manifest


def _weights(settings: EditSettings) -> str:
    return weights_fingerprint(settings.weights) if settings.correct else NONE


def _read(source: SceneSource, edits: Path, settings: EditSettings) -> tuple[EditFile, dict[str, Any]]:
    """The edits, and the content of all inputs by their kind."""
    parts, of_scenes = source.parts(settings.scene_settings(), settings.scenes_per_shard)
    scene_ids = {scene_id for part in parts for scene_id in part.scene_ids}
    found = read_edits(edits, scene_ids)
    asked = [asdict(edit) for edit in found.edits], [asdict(notice) for notice in found.failures]
    inputs: dict[str, Any] = {**of_scenes, "edits": content_id(asked)}
    if isinstance(source, FolderSource):  # assets that no scene uses yet may be put into one
        path = source.dataset.root / ANNOTATION_FILE
        inputs |= {"library": content_id(path.read_text("utf-8") if path.is_file() else "")}
    return found, inputs


def _reasoner(found: EditFile, settings: EditSettings) -> dict[str, Any]:
    """What the replies depend on; nothing where each edit has its reply.

    Raises:
        ConfigError: Edits need a reasoner, and there is none.
    """
    if all(edit.reply is not None for edit in found.edits):
        return {}
    return flat(shaping_of_proposals(settings.engine, settings.reasoner), "reasoner.")


def _shards(edits: tuple[EditRequest, ...], settings: EditSettings, fingerprint: str) -> list[SceneShard[EditRequest]]:
    """The edits in order, cut by a fixed rule; at least one shard, so that every table is there."""
    size = settings.scenes_per_shard
    groups = [edits[start : start + size] for start in range(0, len(edits), size)] or [()]
    return [SceneShard(content_id("edit", settings.shaping(), fingerprint, [asdict(e) for e in g]), tuple(g)) for g in groups]


def describe_edits(scenes: str, edits: Path, settings: EditSettings) -> dict[str, Any]:
    """What a run would do: settings and counts, for ``--dry-run``."""
    source = scene_source(scenes if "://" in scenes else str(Path(scenes).expanduser().resolve()))
    settings = settings.settled(source)
    found, inputs = _read(source, edits, settings)
    inputs |= {"weights": _weights(settings), **_reasoner(found, settings)}
    return {
        "settings": asdict(settings),
        "inputs": inputs,
        "num_edits": len(found.edits),
        "num_unusable": len(found.failures),
        "num_shards": len(_shards(found.edits, settings, content_id(inputs))),
    }
