"""Edit: scenes and instructions that change them become changed scenes, all that was not named where it was."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from models.physics_corrector.learned import NONE, load_flow, weights_fingerprint
from models.semantic_reasoner.engine import Sampling
from pipelines.correct import OF_DATASET, carry_assets, places, settled_here, write_dataset, write_notices
from pipelines.edit_engine import EngineChoice, engine_choice
from pipelines.edit_file import EditFile, WantedEdit, read_edits
from pipelines.edit_report import write_edit_report
from pipelines.edit_settings import EditSettings
from pipelines.edit_step import EDIT_TABLES, EditShard, EditWork
from pipelines.job import check_resume, check_shards, count_items, count_rows, new_manifest, run_missing, write_manifest
from pipelines.runner import Workers
from pipelines.scene_source import FolderSource, SceneSource, scene_source
from stable_data.errors import ConfigError
from stable_data.mesatask.library import ANNOTATION_FILE
from stable_data.shards import content_id


def edit(
    scenes: str,
    edits: Path,
    out: str,
    settings: EditSettings,
    workers: Workers,
    engine: EngineChoice | str = "embedded",
    *,
    report: bool = True,
) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        scenes: A folder in the MesaTask-10K format, or a run with a table ``scenes``; every node of a cluster must see it.
        edits: File with one edit a line, see :func:`pipelines.edit_file.read_edits`.
        out: Local folder, likewise, or object-store URI.
        settings: What shapes the rows.
        workers: Who runs the shards.
        engine: The reasoner, or the words for one that the command line takes; only edits without a reply need it.
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
        chosen = _engine(found, engine, settings)
        inputs |= {"weights": weights, "engine": NONE if chosen is None else chosen.fingerprint}
        fingerprint = content_id(inputs)
        manifest = new_manifest(
            "edit",
            source.name,
            fingerprint,
            inputs=inputs,
            settings=asdict(settings),
            engine=NONE if chosen is None else chosen.name,
            num_edits=len(found.ids),
        )
        check_resume(folder, manifest, settings.shaping())
        write_manifest(folder, manifest)
        write_notices(folder, found.failures, ())
        shards = _shards(found.edits, settings, fingerprint)
        work = EditWork(where, folder.root if folder.is_local else out, settings, chosen, fingerprint)
        run_missing(folder, shards, lambda _: EDIT_TABLES, work, workers, "edit", "edit")
        ids = {shard.shard_id for shard in shards}
        check_shards(folder, {t: ids | {OF_DATASET} if t in ("warnings", "failures") else ids for t in EDIT_TABLES})
        carried = carry_assets(source, folder)
        failed = count_items(folder, "scenes", "scene_id", found.ids)
        kinds = Counter(folder.table("edits", ["kind"])["kind"].to_pylist())
        counts = {
            **count_rows(folder, (*EDIT_TABLES, *carried)),
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


def _read(source: SceneSource, edits: Path, settings: EditSettings) -> tuple[EditFile, dict[str, str]]:
    """The edits, and the content of all inputs by their kind."""
    parts, inputs = source.parts(settings.scene_settings(), settings.scenes_per_shard)
    scene_ids = {scene_id for part in parts for scene_id in part.scene_ids}
    found = read_edits(edits, scene_ids)
    asked = [asdict(edit) for edit in found.edits], [asdict(notice) for notice in found.failures]
    inputs |= {"edits": content_id(asked)}
    if isinstance(source, FolderSource):  # assets that no scene uses yet may be put into one
        path = source.dataset.root / ANNOTATION_FILE
        inputs |= {"library": content_id(path.read_text("utf-8") if path.is_file() else "")}
    return found, inputs


def _engine(found: EditFile, engine: EngineChoice | str, settings: EditSettings) -> EngineChoice | None:
    """The reasoner; None where no edit needs one.

    Raises:
        ConfigError: Edits need one, and there is none.
    """
    waiting = [edit.edit_id for edit in found.edits if edit.reply is None]
    if not waiting:
        return None
    sampling = Sampling(temperature=settings.temperature, max_tokens=settings.max_tokens)
    chosen = engine_choice(engine, sampling) if isinstance(engine, str) else engine
    if chosen is None:
        raise ConfigError(
            f"{len(waiting)} edits such as {waiting[0]} have no reply and the engine is none; name one, or give each its reply",
            "engine_missing",
        )
    return chosen


def _shards(edits: tuple[WantedEdit, ...], settings: EditSettings, fingerprint: str) -> list[EditShard]:
    """The edits in order, cut by a fixed rule; at least one shard, so that every table is there."""
    size = settings.scenes_per_shard
    groups = [edits[start : start + size] for start in range(0, len(edits), size)] or [()]
    return [EditShard(content_id("edit", settings.shaping(), fingerprint, [asdict(e) for e in g]), tuple(g)) for g in groups]


def describe_edits(scenes: str, edits: Path, settings: EditSettings, engine: str) -> dict[str, Any]:
    """What a run would do: settings and counts, for ``--dry-run``."""
    source = scene_source(scenes if "://" in scenes else str(Path(scenes).expanduser().resolve()))
    settings = settings.settled(source)
    found, inputs = _read(source, edits, settings)
    chosen = _engine(found, engine, settings)
    inputs |= {"weights": _weights(settings), "engine": NONE if chosen is None else chosen.fingerprint}
    return {
        "settings": asdict(settings),
        "inputs": inputs,
        "num_edits": len(found.edits),
        "num_unusable": len(found.failures),
        "num_shards": len(_shards(found.edits, settings, content_id(inputs))),
    }
