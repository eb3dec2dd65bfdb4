"""Correct: scenes of a dataset or of a run become scenes that are exactly clean.

Repair of other people's datasets, and rearrangement.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from models.physics_corrector.learned_flow import load_flow, weights_fingerprint
from pipelines.correct.report import write_correct_report
from pipelines.correct.scene_shard import SceneShard
from pipelines.correct.settings import CorrectSettings
from pipelines.correct.shard import CorrectWork
from pipelines.execution.ray_executor import ProcessFailure, WorkerPool, alone
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
from pipelines.sources.scenes import FolderSource, SceneSource, TableSource, scene_source
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice, unwritable
from stable_data.mesatask import write_annotations, write_scene
from stable_data.mesatask.library import LIBRARY_FOLDER
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

S = TypeVar("S", bound=CorrectSettings)

CARRIED_TABLES = ("assets", "meshes", "sdf", "features")
"""Tables of the input run that the output carries, so that it can be trained on and exported as it is."""


def correct(scenes: str, out: str, settings: CorrectSettings, workers: WorkerPool, *, report: bool = True) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        scenes: A folder in the MesaTask-10K format, or a run with a table ``scenes``; every node of a cluster must see it.
        out: Local folder, likewise, or object-store URI.
        settings: What shapes the rows.
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
    weights = weights_fingerprint(settings.weights)
    load_flow(settings.weights, settings.steps)  # what cannot be used is refused before anything is written
    with folder.locked():
        parts, inputs = source.parts(settings.scene_settings(), settings.scenes_per_shard)
        inputs |= {"weights": weights}
        shards = [SceneShard(content_id("correct", settings.shaping(), weights, p.content), p.scene_ids) for p in parts]
        scene_ids = [scene_id for shard in shards for scene_id in shard.items]
        fingerprint = content_id(inputs)
        manifest = new_manifest(
            "correct", source.name, fingerprint, inputs=inputs, settings=asdict(settings), num_scenes=len(scene_ids)
        )
        check_resume(folder, manifest, settings.shaping())
        write_manifest(folder, manifest)
        lost = [n for n in source.notices if n.code == "layout_missing"]
        write_notices(folder, lost, [n for n in source.notices if n.code != "layout_missing"])
        work = CorrectWork(where, folder.root if folder.is_local else out, settings, fingerprint)
        run_missing(folder, manifest, shards, lambda _: CorrectWork.TABLES, work, workers, "correct", "scene")
        ids = {shard.shard_id for shard in shards}
        check_shards(folder, {t: ids | {OF_DATASET} if t in ("warnings", "failures") else ids for t in CorrectWork.TABLES})
        carried = carry_assets(source, folder)
        failed = count_items(folder, "scenes", "scene_id", [*scene_ids, *(n.item_id for n in lost)])
        status = Counter(folder.table("corrections", ["status"])["status"].to_pylist())
        counts = {**count_rows(folder, (*CorrectWork.TABLES, *carried)), "failed_scenes": failed, "by_status": dict(status)}
        manifest |= {"status": "complete", "counts": counts}
        write_manifest(folder, manifest)
        if settings.write_dataset and isinstance(source, FolderSource) and folder.is_local:
            write_dataset(source, folder)
        if report:
            write_correct_report(folder, manifest, source.store, settings.num_pictures)
    return manifest


def places(scenes: str, out: str) -> tuple[str, RunFolder]:
    """Where scenes are, as every worker can read it, and the run's folder.

    Raises:
        ConfigError: The folder lies in the scenes (``output_invalid``).
    """
    where = scenes if "://" in scenes else str(Path(scenes).expanduser().resolve())
    folder = RunFolder(out)
    if "://" not in scenes and folder.is_local and Path(where) in (Path(folder.root), *Path(folder.root).parents):
        raise ConfigError(f"{out}: lies in the scenes that are read, expected another folder", "output_invalid")
    return where, folder


def settled_here(source: SceneSource, settings: S, workers: WorkerPool) -> S:
    """The settings with ``auto`` replaced, by a process of its own where workers are: a mesh must not end the run's."""
    if settings.position_convention != "auto" or workers.are_this_process or isinstance(source, TableSource):
        return settings.settled(source)
    settled = alone(settings.settled, source, seconds=64 * settings.seconds_per_item)
    if isinstance(settled, ProcessFailure):
        raise ConfigError(
            f"{source.name}: the check of what positions mean {str(settled).replace('_', ' ')} over a layout or mesh; set "
            "position_convention to box_centre or mesh_centre",
            "convention_unknown",
        )
    return settled


def write_notices(folder: RunFolder, lost: Sequence[Notice], odd: Sequence[Notice]) -> None:
    """Rows that belong to no shard: scene folders without a layout, and what is odd about the source as a whole."""
    for table, found in (("failures", lost), ("warnings", odd)):
        if OF_DATASET not in folder.shard_ids(table):
            folder.write_shard(table, OF_DATASET, [schemas.notice_row(n) for n in found])


def carry_assets(source: SceneSource, folder: RunFolder) -> list[str]:
    """Copies the tables of assets of a run, file by file, and gives their names; a dataset has none."""
    carried = []
    if isinstance(source, TableSource):
        for table in CARRIED_TABLES:
            files, there = ({Path(path).name for path in run.files(table)} for run in (source.folder, folder))
            # The first file of a shard, which has no number, last: where it exists, the others do.
            for file in sorted(files - there, key=lambda name: (-name.count("-"), name)):
                content = source.folder.read_bytes(f"{table}/{file}")
                assert content is not None  # it was just listed
                folder.write_bytes(f"{table}/{file}", content)
            carried += [table] if files else []
    return carried


def describe_correction(scenes: str, settings: CorrectSettings) -> dict[str, Any]:
    """What a run would do: settings and counts, for ``--dry-run``."""
    source = scene_source(scenes if "://" in scenes else str(Path(scenes).expanduser().resolve()))
    settings = settings.settled(source)
    parts, inputs = source.parts(settings.scene_settings(), settings.scenes_per_shard)
    inputs |= {"weights": weights_fingerprint(settings.weights)}
    num_scenes = sum(len(part.scene_ids) for part in parts)
    return {"settings": asdict(settings), "inputs": inputs, "num_shards": len(parts), "num_scenes": num_scenes}


def write_dataset(source: FolderSource, folder: RunFolder) -> Path:
    """Writes the corrected scenes in the format that they came in, to ``dataset/`` in the run's folder.

    Layouts hold everything that the files held, poses changed; the meshes are those of the source, linked.

    Returns:
        Where it is: ``stable-data lint`` and ``preprocess`` take it.

    Raises:
        ConfigError: It cannot be written.
    """
    root = Path(folder.root) / "dataset"
    dataset = source.dataset
    try:
        root.mkdir(exist_ok=True)
        if dataset.annotations:
            write_annotations(root, dataset.annotations)
        library = root / LIBRARY_FOLDER
        if not library.is_symlink() and (dataset.root / LIBRARY_FOLDER).is_dir():
            library.symlink_to((dataset.root / LIBRARY_FOLDER).resolve(), target_is_directory=True)
        for batch in folder.batches("scenes"):
            for row in batch.to_pylist():
                write_scene(root, schemas.scene_from_row(row), annotations=dataset.annotations)
    except OSError as error:
        raise unwritable(str(root), error) from error
    return root
