"""Prepares supports: finds their surfaces and writes each as an empty scene, on which ``generate --supports`` lays out tasks."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow.compute as pc
from tqdm import tqdm

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure
from pipelines.execution.resume import check_resume, new_manifest
from pipelines.preprocess.asset import AssetSettings, AssetUse, preprocess_asset
from pipelines.preprocess.plan import file_digest
from pipelines.sources.asset_copies import CopyAssets
from pipelines.sources.assets import AssetLibraries, absolute_places
from pipelines.supports import SECONDS_PER_ITEM
from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.embedded_world.plans import TABLES, UNSEEN_TABLES
from stable_data.errors import ConfigError, Notice, SceneError, StableDataError, short_line
from stable_data.geometry.mesh import Mesh
from stable_data.importers.scenes.layouts import ImportedScene, fixed_scene
from stable_data.importers.scenes.scene_assets import SceneAssets
from stable_data.metrics.audit import audit_scene
from stable_data.scene import UPRIGHT
from stable_data.storage.manifest import COMPLETE, PLANNED, PlannedItems, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import card_row, notice_row, scene_row
from stable_data.supports import SupportLimits, SupportSurface, as_tabletop, find_obstacles, find_surfaces, seen_from_open_side

_KINDS = {
    "desk": "office_table",
    "workbench": "office_table",
    "counter": "kitchen_counter",
    "worktop": "kitchen_counter",
    "vanity": "bathroom_vanity",
    "dresser": "dressing_table",
    "sideboard": "tv_stand",
}
"""Table types for the last word of other categories."""


@dataclass(frozen=True, slots=True)
class SupportOptions:
    """What a user says about supports.

    Attributes:
        table: Table type of the surfaces; empty: by the category of the support.
        surfaces: Names of the surfaces to take; empty: all.
        limits: What counts as a surface.
    """

    table: str = ""
    surfaces: tuple[str, ...] = ()
    limits: SupportLimits = field(default_factory=SupportLimits)


OBSTACLES = "supports"
"""The source of assets that are bodies in the way on a support, made of its mesh."""

_DEFAULT = SupportOptions()
_TABLES = ("warnings", "textures", "meshes", "assets", "scenes")


@dataclass(frozen=True, slots=True, eq=False)
class PreparedSupport:
    """A support with its surfaces.

    Attributes:
        asset_id: The support.
        mesh: Its mesh, metres, z up.
        surfaces: Its surfaces that were taken.
        scenes: An empty scene on each surface, with what is in the way there.
        rows: Table -> its rows of this support, without those of what is in the way.
        obstacles: What is in the way -> its rows of ``assets`` and ``meshes``.
    """

    asset_id: str
    mesh: Mesh
    surfaces: tuple[SupportSurface, ...]
    scenes: tuple[ImportedScene, ...]
    rows: Mapping[str, Sequence[Row]]
    obstacles: Mapping[str, tuple[Row, Row]]


@dataclass(frozen=True, slots=True)
class SupportCounts:
    """The result of the job.

    Attributes:
        supports: The supports that have surfaces.
        failures: Assets that could not be used.
        num_left_out: Assets of the library that were not looked at.
    """

    supports: tuple[PreparedSupport, ...]
    failures: tuple[Notice, ...]
    num_left_out: int = 0


def prepare_supports(
    library: str,
    asset_ids: Sequence[str],
    out: str,
    options: SupportOptions = _DEFAULT,
    *,
    seconds_per_item: float = SECONDS_PER_ITEM,
    progress: bool = False,
) -> SupportCounts:
    """Finds the surfaces of assets and writes a run; each asset is read in a separate process, because it may be hostile.

    Its table ``scenes`` has an empty scene for each surface, ``assets``, ``meshes`` and ``textures`` the supports and what is in the
    way on them.

    Args:
        library: Place of the library, see :class:`~pipelines.sources.assets.AssetLibraries`.
        asset_ids: Its assets; empty: all that are fixed furniture, or all if none is.
        out: Folder or URI of the run.
        options: What the user says about them.
        seconds_per_item: Time limit of an asset, seconds.
        progress: Whether to show a progress bar.

    Raises:
        ConfigError: The library cannot be read or lacks an asset (``asset_unknown``), no asset has a surface (``no_surface``), or the
            run cannot be written or belongs to another job.
    """
    (place,) = absolute_places([library])
    shelf = AssetLibraries((), scenes=place)
    known = shelf.asset_ids
    if unknown := [asset_id for asset_id in asset_ids if asset_id not in known]:
        raise ConfigError(f"{library}: has no asset {unknown[0]}, expected one of {_some(known)}", "asset_unknown")
    chosen = list(dict.fromkeys(asset_ids)) or _fixed_furniture(place) or list(known)
    if not chosen:
        raise ConfigError(f"{library}: has no asset, expected furniture; make it with stable-data import", "no_surface")
    folder, settings = RunFolder(out), asdict(options)
    # Another run is refused before the work; what depends on the surfaces is compared when it is written.
    check_resume(folder, new_manifest("supports", library, shelf.fingerprints), settings, grown={"inputs.meshes"})
    found, failures = list[PreparedSupport](), list[Notice]()
    with IsolatedProcess() as process:
        for asset_id in tqdm(chosen, desc="supports", unit="support", disable=not progress):
            made = process.call(_guarded, asset_id, library, place, options, seconds=seconds_per_item)
            if isinstance(made, ProcessFailure):
                message = f"{asset_id}: it {made.told(seconds_per_item)}; is it hostile?"
                failures.append(Notice(asset_id, "isolate", str(made), message))
            elif isinstance(made, Notice):
                failures.append(made)
            else:
                found.append(made)
    if not found:
        raise ConfigError(f"{library}: no asset has a surface, expected at least one; {failures[0].message}", "no_surface")
    _write_run(folder, library, shelf, settings, found, failures)
    return SupportCounts(tuple(found), tuple(failures), len(known) - len(chosen))


def _fixed_furniture(place: str) -> list[str]:
    """The assets of a library that their source says are fixed; none if the library is no run."""
    run = RunFolder(place)
    if not ("://" in place or run.files("assets")):
        return []
    rows = run.table("assets", ["asset_id", "source"], pc.field("is_static")).to_pylist()
    return sorted(row["asset_id"] for row in rows if row["source"] != OBSTACLES)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "")


def table_type_of(category: str) -> str:
    """Returns the table type for a category of furniture: a known one where the words say so, else the category itself."""
    known = {*TABLES, *UNSEEN_TABLES}
    if category in known:
        return category
    return _KINDS.get(category.rpartition("_")[2], category or "table")


def _guarded(asset_id: str, library: str, place: str, options: SupportOptions) -> PreparedSupport | Notice:
    """A support, or why it is none, which loses less on its way through a pipe than a raised error."""
    try:
        return _prepared(asset_id, library, place, options)
    except StableDataError as error:
        return Notice(asset_id, "supports", error.code, str(error))
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - an unexpected error costs one asset
        message = f"{asset_id}: unexpected {type(error).__name__}: {error}; please report it with the asset"
        return Notice(asset_id, "supports", "unexpected", short_line(message))


@lru_cache(maxsize=1)
def _opened(place: str) -> tuple[AssetLibraries, AssetStore]:
    shelf = AssetLibraries((), scenes=place)
    return shelf, AssetStore(shelf)


def _prepared(asset_id: str, library: str, place: str, options: SupportOptions) -> PreparedSupport:
    shelf, store = _opened(place)
    asset, _ = shelf.rows(asset_id) or ({}, {})
    scale = asset.get("typical_scale")
    if scale is None or not np.allclose(scale, 1.0, rtol=0, atol=1e-9):
        raise SceneError(
            f"{asset_id}: its library does not state its size in metres, expected one that stable-data import made; import it first",
            "scale_unknown",
        )
    mesh = store.asset(asset_id).mesh
    surfaces = find_surfaces(mesh, limits=options.limits)
    if missing := set(options.surfaces) - {s.name for s in surfaces}:
        there = ", ".join(s.name for s in surfaces) or "none"
        raise SceneError(f"{asset_id}: has no surface {min(missing)}, expected one of {there}", "surface_unknown")
    taken = tuple(s for s in surfaces if not options.surfaces or s.name in options.surfaces)
    scenes = []
    for surface in taken:
        fit = seen_from_open_side(
            mesh, surface, as_tabletop(surface, options.table or table_type_of(asset.get("category") or ""))
        )
        frame = fit.frame(surface, asset_id, asset_id)
        parts = find_obstacles(mesh, frame, fit.tabletop, limits=options.limits)
        scenes.append(
            fixed_scene(f"{asset_id}__{surface.name}", fit.tabletop, frame, parts, asset.get("category") or "support")
        )
    if not taken:
        raise SceneError(
            f"{asset_id}: has no level surface with room for a disc of {100 * options.limits.width:g} cm, expected one; look at its mesh",
            "no_surface",
        )
    rows, obstacles = _rows_of(asset_id, scenes, library, place)
    return PreparedSupport(asset_id, mesh, taken, tuple(scenes), rows, obstacles)


def _rows_of(
    asset_id: str, scenes: Sequence[ImportedScene], library: str, place: str
) -> tuple[Mapping[str, Sequence[Row]], Mapping[str, tuple[Row, Row]]]:
    """The rows of a support, and those of what is in the way on it."""
    copied = CopyAssets((), "", float("inf"), scenes=place, decomposes=False)
    use = AssetUse(asset_id, "", (1.0, 1.0, 1.0), (), ((UPRIGHT, 1),))
    rows = dict(copied.item_rows(use, ItemProgress("mesh")))
    # Furniture is no object of a scene: it is not offered where things for a table are asked for.
    rows["assets"] = [{**row, "on_table": False, "is_static": True} for row in rows.get("assets", [])]
    obstacles = SceneAssets()
    obstacles.add(scenes)
    store = AssetStore(obstacles)
    rows["scenes"] = [_scene_row(scene, store, library) for scene in scenes]
    return rows, {name: _obstacle_rows(name, obstacles, store) for name in sorted(obstacles.assets)}


def _write_run(
    folder: RunFolder,
    library: str,
    shelf: AssetLibraries,
    options: Mapping[str, Any],
    found: Sequence[PreparedSupport],
    failures: Sequence[Notice],
) -> None:
    settings = {**options, "supports": [s.asset_id for s in found]}
    inputs: Mapping[str, Any] = dict(shelf.fingerprints) | {
        "meshes": content_id([(s.asset_id, _hash_of(s.mesh)) for s in found])
    }
    shard = content_id("supports", settings, inputs)
    rows = {name: [row for support in found for row in support.rows.get(name, ())] for name in _TABLES}
    obstacles = {name: both for support in reversed(found) for name, both in support.obstacles.items()}
    for _, (asset, mesh) in sorted(obstacles.items()):
        rows["assets"].append(asset)
        rows["meshes"].append(mesh)
    with folder.locked():
        manifest = new_manifest("supports", library, inputs, settings=settings, work=[])
        check_resume(folder, manifest, settings)
        write_manifest(folder, manifest)
        folder.write_shard("failures", shard, [notice_row(n) for n in failures])
        for name, content in rows.items():
            folder.write_shard(name, shard, content)
        counts = {name: len(content) for name, content in rows.items()} | {"failures": len(failures)}
        items = [support.asset_id for support in found] + [notice.item_id for notice in failures]
        planned = [asdict(PlannedItems.of("scenes", "surface.support", items))]
        write_manifest(folder, manifest | {"status": COMPLETE, "counts": counts, PLANNED: planned})


def _hash_of(mesh: Mesh) -> str:
    return hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest()


def _scene_row(imported: ImportedScene, store: AssetStore, source: str) -> Row:
    scene, shapes, _ = store.resolved(imported.scene)
    audit = audit_scene(scene, shapes)
    origin = {"source": source, "split": None, "layout_path": None, "layout_sha256": None, "duplicate_group": None}
    return {**scene_row(scene), **card_row(audit.card()), **audit.rows(), **origin}


def _obstacle_rows(asset_id: str, assets: SceneAssets, store: AssetStore) -> tuple[Row, Row]:
    """The rows of ``assets`` and ``meshes`` of a body that is in the way."""
    path = assets.asset_path(asset_id)
    assert path is not None
    asset = assets.assets[asset_id]
    annotation = AssetAnnotation(
        asset_id, category=asset.category, description=asset.body.name, source=OBSTACLES, on_table=False
    )
    item = AssetUse(asset_id, file_digest(path), (1.0, 1.0, 1.0), (), ((UPRIGHT, 1),))
    made = preprocess_asset(item, annotation, store, AssetSettings(decomposes=False), ItemProgress("mesh"))
    given = {"is_static": True, "scale_source": "given", "scale_inferred": False}
    return made.asset | given, made.mesh | {"parts_source": "given"}
