"""Imports scene files into a run with the tables ``scenes``, ``assets`` and ``meshes``, which every other job reads."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from tqdm import tqdm

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import IsolatedProcess
from pipelines.execution.resume import check_resume, new_manifest
from pipelines.preprocess.asset import AssetSettings, AssetUse, preprocess_asset
from pipelines.preprocess.plan import file_digest
from pipelines.scene_files.folder import call_for_file
from pipelines.scene_files.repair import RepairOptions, put_upright
from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, Notice, StableDataError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.layouts import ImportedScene, scene_source, scenes_of_file
from stable_data.importers.scenes.lint import no_scene_error, scene_candidates
from stable_data.importers.scenes.opening import read_scene_file
from stable_data.importers.scenes.scene_assets import SceneAssets
from stable_data.mesatask.asset_uses import AssetUseCount
from stable_data.metrics.audit import audit_scene
from stable_data.storage.manifest import COMPLETE, PLANNED, PlannedItems, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import card_row, notice_row, scene_row


@dataclass(frozen=True, slots=True)
class ImportCounts:
    """The result of an import.

    Attributes:
        num_files: Scene files that were read.
        num_scenes: Their scenes: one for each surface on which free bodies stand.
        num_assets: Their assets.
        failures: Files that could not be used.
    """

    num_files: int
    num_scenes: int
    num_assets: int
    failures: tuple[Notice, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _ReadFile:
    """What a process sends back about a file."""

    scenes: tuple[ImportedScene, ...]
    notices: tuple[Notice, ...]
    files: tuple[str, ...]


def import_scenes(
    root: Path, paths: Sequence[str] | None, out: str, options: RepairOptions, *, progress: bool = False
) -> ImportCounts:
    """Imports scene files.

    Args:
        root: The source folder; nothing outside of it is read.
        paths: The files, relative to it; None: all scene files in it.
        out: Folder or URI of the run.
        options: What the user says about the files; with ``upright`` other than ``keep``, what has fallen is put upright.
        progress: Whether to show a progress bar.

    Raises:
        ConfigError: The folder does not exist or holds no scene, or the run cannot be written or belongs to another import.
    """
    found = scene_candidates(root) if paths is None else list(paths)
    assets, read, failures, used = SceneAssets(), list[ImportedScene](), list[Notice](), set[str]()
    warnings: list[Notice] = []
    files = list[str]()
    with IsolatedProcess() as process:
        for path in tqdm(found, desc="import", unit="file", disable=not progress):
            try:
                result = call_for_file(process if paths is None else None, path, _read, root, path, options)
            except StableDataError as error:
                failures.append(Notice(path, "read", error.code, str(error)))
                continue
            files.append(path)
            read += _with_own_ids(result.scenes, path, {one.scene.scene_id for one in read})
            warnings += result.notices
            used |= set(result.files) - {path}
            assets.add(result.scenes)
    if paths is None:  # a part of a scene is no scene
        failures = [n for n in failures if n.code != "no_free_body" and n.item_id not in used]
    if not read and not failures:
        raise no_scene_error(root, len(found))
    return _write_run(root, RunFolder(out), options, assets, read, warnings, failures, files)


def _with_own_ids(scenes: Sequence[ImportedScene], path: str, taken: set[str]) -> list[ImportedScene]:
    """Scenes of a file; where another file of the same name in another format has taken an identifier, the suffix is added."""
    suffix = PurePosixPath(path).suffix.lower().lstrip(".")
    return [
        replace(one, scene=replace(one.scene, scene_id=f"{one.scene.scene_id}__{suffix}"))
        if one.scene.scene_id in taken
        else one
        for one in scenes
    ]


def _read(root: Path, path: str, options: RepairOptions) -> _ReadFile:
    source = read_scene_file(Boundary(root), path, options.key)
    scenes = scenes_of_file(source.file, options.table)
    notices = list(source.file.notices)
    if options.upright != "keep":
        at_rest = {name: motion.is_at_rest for name, motion in source.watch().items()}
        for k, one in enumerate(scenes):
            scene, reasons = put_upright(one, source.file, options.upright, at_rest)
            scenes[k] = replace(one, scene=scene)
            notices += [
                Notice(scene.scene_id, "upright", "uprighted", f"{scene.scene_id}: {instance} was turned: {reason}")
                for instance, reason in reasons.items()
            ]
    return _ReadFile(tuple(scenes), tuple(notices), source.paths)


def _write_run(
    root: Path,
    folder: RunFolder,
    options: RepairOptions,
    assets: SceneAssets,
    read: Sequence[ImportedScene],
    warnings: Sequence[Notice],
    failures: Sequence[Notice],
    files: Sequence[str],
) -> ImportCounts:
    if folder.is_local and root.resolve() in (Path(folder.root).resolve(), *Path(folder.root).resolve().parents):
        raise ConfigError(f"{folder.uri}: is inside the folder of the scene files, expected another folder", "output_invalid")
    settings = asdict(options)
    inputs = {"scenes": content_id([(s.scene.scene_id, scene_source(s.scene)["sha256"]) for s in read])}
    shard = content_id("import scenes", settings, inputs)
    store = AssetStore(assets)
    with folder.locked():
        manifest = new_manifest("import scenes", root.name, inputs, settings=settings, work=[])
        check_resume(folder, manifest, settings)
        write_manifest(folder, manifest)
        found = list(warnings)
        rows = [_scene_rows(one, store, root.name, found) for one in read]
        uses = _asset_uses(read)
        asset_rows = [_asset_rows(asset_id, assets, use, store, root.name) for asset_id, use in sorted(uses.items())]
        folder.write_shard("warnings", shard, [notice_row(n) for n in found])
        folder.write_shard("failures", shard, [notice_row(n) for n in failures])
        folder.write_shard("meshes", shard, [mesh for _, mesh in asset_rows])
        folder.write_shard("assets", shard, [asset for asset, _ in asset_rows])
        folder.write_shard("scenes", shard, rows)
        counts = {"scenes": len(rows), "assets": len(asset_rows), "warnings": len(found), "failures": len(failures)}
        planned = [asdict(PlannedItems.of("scenes", "layout_path", [*files, *(n.item_id for n in failures)]))]
        write_manifest(folder, manifest | {"status": COMPLETE, "counts": counts, PLANNED: planned})
    return ImportCounts(len(files), len(rows), len(asset_rows), tuple(failures))


def _scene_rows(imported: ImportedScene, store: AssetStore, dataset: str, warnings: list[Notice]) -> Row:
    scene, shapes, notices = store.resolved(imported.scene)
    audit = audit_scene(scene, shapes)
    warnings += [*notices, *audit.notices]
    source = scene_source(scene)
    origin = {
        "source": dataset,
        "split": None,
        "layout_path": source["file"],
        "layout_sha256": source["sha256"],
        "duplicate_group": None,
    }
    return {**scene_row(scene), **card_row(audit.card()), **audit.rows(), **origin}


def _asset_uses(read: Sequence[ImportedScene]) -> dict[str, AssetUseCount]:
    uses: dict[str, AssetUseCount] = {}
    for one in read:
        for o in one.scene.objects:
            uses.setdefault(o.asset_id or "", AssetUseCount()).add(o.scale, o.tilt_quat_xyzw)
    return uses


def _asset_rows(asset_id: str, assets: SceneAssets, use: AssetUseCount, store: AssetStore, dataset: str) -> tuple[Row, Row]:
    """The rows of ``assets`` and ``meshes`` of an asset: its shape, and the mass and friction that the file states."""
    asset, path = assets.assets[asset_id], assets.asset_path(asset_id)
    assert path is not None
    body = asset.body
    annotation = AssetAnnotation(
        asset.asset_id, category=asset.category, description=body.name, source=dataset, mass=body.mass, on_table=body.is_free
    )
    item = AssetUse(asset_id, file_digest(path), use.typical_scale(), (), tuple(use.most_tilts()))
    made = preprocess_asset(item, annotation, store, AssetSettings(decomposes=False), ItemProgress("mesh"))
    given: dict[str, Any] = {
        "is_static": not body.is_free,
        "scale_source": "given",
        "scale_inferred": False,
        "source_set": dataset,
    }
    if body.mass is not None:
        given["mass_source"] = "given"
    if body.center_of_mass is not None:
        given["center_of_mass"] = [c - m for c, m in zip(body.center_of_mass, asset.center, strict=True)]
    if body.inertia is not None:
        given["inertia"] = body.inertia.ravel().tolist()
    if body.friction is not None:
        given["friction"] = list(body.friction)
    assert given.keys() <= set(SCHEMAS["assets"].names)
    return made.asset | given, made.mesh | {"parts_source": "given"}
