"""Exports scenes of a run to another format, into a folder of their own; an interrupted export continues when it is run again."""

import errno
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from stable_data.assets.annotation import AssetAnnotation
from stable_data.assets.licences import attribution_text
from stable_data.assets.run_assets import run_annotations
from stable_data.assets.store import AssetStore
from stable_data.atomic_files import write_file_atomically
from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, StableDataError, cannot_write, failure_line, plain_markdown
from stable_data.export.formats import ExportFormat, format_named
from stable_data.export.scene_cache import SceneCache
from stable_data.mesatask import write_annotations
from stable_data.mesatask.library import ANNOTATION_FILE
from stable_data.scene import Scene
from stable_data.simulation.run_reader import NEEDED, RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import scene_from_row
from stable_data.supports import join_scenes

MANIFEST_FILE, ATTRIBUTION_FILE = "export.json", "ATTRIBUTION.md"

_OF_A_NAME = (errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ)  # errors of a file system that does not take a name
Progress: TypeAlias = Callable[[int, int, int], None]
"""Called after every scene with the numbers of finished scenes, of all scenes, and of scenes that could not be exported."""


@dataclass(frozen=True, slots=True)
class ExportResult:
    """The result of an export.

    Attributes:
        num_written: Scenes that were written.
        num_existing: Scenes that existed already.
        num_boxes: Objects of the written scenes without a mesh, exported as boxes.
        failures: A line for each scene that could not be exported.
        num_cached: Written scenes whose files an earlier export had made.
        warning: What is odd about the export as a whole, or None.
    """

    num_written: int
    num_existing: int
    num_boxes: int
    failures: tuple[str, ...]
    num_cached: int = 0
    warning: str | None = None

    @property
    def total(self) -> int:
        """All selected scenes."""
        return self.num_written + self.num_existing + len(self.failures)


def export_run(
    run: RunFolder,
    out: Path,
    name: str,
    choice: SceneSelection,
    progress: Progress | None = None,
    *,
    is_cached: bool = False,
) -> ExportResult:
    """Writes scenes of a run in another format; run again, it writes the missing scenes.

    The folder also gets README.md, ATTRIBUTION.md, Asset_annotation.json with category, licence and source of every asset in use,
    and export.json with the run and the settings of the export.

    Args:
        run: The run.
        out: Local folder.
        name: Name of the format, see :data:`stable_data.export.formats.FORMATS`.
        choice: Selection of the scenes.
        progress: Called after every scene.
        is_cached: Scenes that an earlier cached export of any run made, and that did not change, are copied from the user's cache
            (:class:`stable_data.export.scene_cache.SceneCache`); others are added to it.

    Raises:
        ConfigError: The export cannot start: the format, a table or a scene is not known, no scene is selected, or the folder
            contains other files.
    """
    chosen = format_named(name)
    target = RunFolder(str(out))
    scenes = RunScenes(run, choice)
    if choice.joined and (name == "mesatask" or choice.settled):
        raise ConfigError(
            "--join makes scenes with several surfaces, which mesatask and --settled do not know; leave it out", "usage"
        )
    pieces = scenes.pieces() if choice.joined else None
    total = len(scenes) if pieces is None else len(pieces)
    if not total:
        what = "no scene is selected" if pieces is None else "no selected scene stands on a support"
        raise ConfigError(f"{run.uri}: {what}, expected at least one; change --where, --scene or --limit", "scene_unknown")
    annotations = run_annotations(run)
    with target.locked():
        _check_same(target, run, name, choice)
        try:
            shown = scenes.rows() if pieces is None else pieces
            cache = SceneCache(name, chosen, scenes.store) if is_cached else None
            return _export(scenes, shown, total, annotations, out, chosen, progress, cache)
        except OSError as error:
            raise cannot_write(str(out), error) from error


def _joined(rows: Sequence[Row], store: AssetStore) -> Scene:
    """The scenes on one piece of furniture as one scene."""
    piece = [scene_from_row(row) for row in rows]
    frame = piece[0].frame
    assert frame is not None
    if frame.asset_id is None:
        low = high = np.array(frame.origin)
    else:
        mesh = store.asset(frame.asset_id).mesh
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return join_scenes(piece, low, high)


def _export(
    scenes: RunScenes,
    shown: Iterable[Row] | Iterable[Sequence[Row]],
    total: int,
    annotations: Mapping[str, AssetAnnotation],
    out: Path,
    chosen: ExportFormat,
    progress: Progress | None,
    cache: SceneCache | None,
) -> ExportResult:
    written, existing, cached, boxes, failures, used = 0, 0, 0, 0, list[str](), set[str]()
    for item in shown:
        name = item["scene_id"] if isinstance(item, dict) else item[0]["surface"]["support"]
        try:
            row, scene = (item, scene_from_row(item)) if isinstance(item, dict) else (None, _joined(item, scenes.store))
            if chosen.scene_path(scene, out).exists():
                existing += 1
            else:
                is_old, num_boxes = _write_scene(scenes, scene, row, out, chosen, cache)
                written, cached, boxes = written + 1, cached + is_old, boxes + num_boxes
            # Assets of existing scenes too: the list of licences covers the whole folder.
            support = None if scene.frame is None else scene.frame.asset_id  # the fixed objects are parts of it
            own = scene.objects if support is None else scene.movable
            used |= {support or "", *(o.asset_id or "" for o in own)} & annotations.keys()
        except OSError as error:
            if error.errno not in _OF_A_NAME:
                raise  # a full or lost disk ends the export
            failures.append(failure_line(name, f"{error.strerror}: a name in it cannot be the name of a file here; rename it"))
        except StableDataError as error:
            if isinstance(error, ConfigError) and error.code != "uid_path_traversal":
                raise  # the run or the folder is unusable
            failures.append(failure_line(name, str(error)))
        except Exception as error:  # noqa: BLE001 - an unexpected error loses one scene only
            failures.append(failure_line(name, f"unexpected {type(error).__name__}: {error}; please report it"))
        if progress is not None:
            progress(written + existing + len(failures), total, len(failures))
    finish: Callable[[Path], str | None] | None = getattr(chosen, "finish", None)
    warning = None if finish is None else finish(out)
    write_annotations(out, {asset_id: annotations[asset_id] for asset_id in used})
    assets = [annotations[asset_id] for asset_id in sorted(used)]
    write_file_atomically(out / "README.md", _readme(chosen, written + existing, assets).encode())
    write_file_atomically(out / ATTRIBUTION_FILE, attribution_text(assets).encode())
    return ExportResult(written, existing, boxes, tuple(failures), cached, warning)


def _write_scene(
    scenes: RunScenes, scene: Scene, row: Row | None, out: Path, chosen: ExportFormat, cache: SceneCache | None
) -> tuple[bool, int]:
    """Writes a scene with its row; returns whether its files were in the cache, and its number of objects that are boxes."""

    def export(folder: Path) -> int:
        geometry = scenes.geometry(scene, row)
        chosen.export_scene(geometry, folder)
        return sum(mesh is None and geometry.is_seen(k) for k, mesh in enumerate(geometry.meshes))

    key = None if cache is None else cache.key(scene, row, scenes.rest(scene))
    if cache is None or key is None:
        return False, export(out)
    found = cache.place(key, out)
    if found is not None:
        return True, found.num_boxes
    cache.make(key, scene, export)
    found = cache.place(key, out)
    return False, export(out) if found is None else found.num_boxes


def _readme(chosen: ExportFormat, num_scenes: int, assets: Sequence[AssetAnnotation]) -> str:
    licences = Counter((a.licence or "not known", a.source or "not known") for a in assets)
    rows = [
        f"| {plain_markdown(licence)} | {plain_markdown(source)} | {count} |"
        for (licence, source), count in sorted(licences.items())
    ]
    return "\n".join(
        [
            f"# {num_scenes} tabletop scenes",
            "",
            chosen.ABOUT,
            "",
            "Frame: the table top is z = 0 with its near-left corner at the origin, +x right, +y away from the viewer, z up; metres, "
            "kilograms, radians. An object without a mesh is a box.",
            "",
            f"{MANIFEST_FILE} names the run and the settings of the export. {ANNOTATION_FILE} gives category, source and licence of "
            f"each asset, and {ATTRIBUTION_FILE} what their licences ask for. Assets by licence and source:",
            "",
            "| licence | source | assets |",
            "|---|---|---|",
            *rows,
            "",
        ]
    )


def _check_same(target: RunFolder, run: RunFolder, name: str, choice: SceneSelection) -> None:
    """Writes the manifest, or refuses a folder that contains another export."""
    settings: dict[str, Any] = {
        "format": name,
        "run": run.root if run.is_local else run.uri,
        "input_fingerprint": content_id({table: sorted(run.shard_ids(table)) for table in (*NEEDED, "settled")}),
        "where": choice.where,
        "scenes": sorted(choice.scene_ids),
        "limit": choice.limit,
        "settled": choice.settled,
        "joined": choice.joined,
    }
    try:
        document = target.read_document(MANIFEST_FILE)
        previous = None if document is None else dict(document)
    except ConfigError:
        raise
    except (ValueError, TypeError):
        previous = {}  # a damaged manifest matches no settings
    if previous is None:
        if any(path.name != ".lock" for path in Path(target.root).iterdir()):
            raise ConfigError(
                f"{target.uri}: contains other files, expected an empty folder or this export; choose a new folder",
                "output_not_empty",
            )
        text = json.dumps(settings | {"code_version": code_version()}, indent=2, sort_keys=True, ensure_ascii=False)
        target.write_bytes(MANIFEST_FILE, (text + "\n").encode())
        return
    refuse_changed(target.uri, {key: previous.get(key) for key in settings}, settings)
