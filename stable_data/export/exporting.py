"""The scenes of a run in another format, in a folder of their own that can be stopped and gone on with."""

import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import pyarrow as pa

from stable_data import __version__
from stable_data.assets import AssetStore
from stable_data.errors import ConfigError, StableDataError
from stable_data.export.formats import Format, format_named
from stable_data.files import put_file
from stable_data.mesatask import write_annotations
from stable_data.mesatask.library import ANNOTATION_FILE, AssetAnnotation
from stable_data.scene import Scene
from stable_data.shards import RunFolder, content_id, unwritable
from stable_data.solid_scene import RestPose, SolidScene
from stable_data.table_assets import TableAssets, run_annotations
from stable_data.table_files import TableFiles, slices
from stable_data.tables import scene_from_row

MANIFEST_FILE = "export.json"
Progress: TypeAlias = Callable[[int, int, int], None]
"""Told after every scene how many are done, of how many, and how many of them could not be exported."""

NEEDED = ("scenes", "assets", "meshes")
"""Tables that a run must have to be exported."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Which scenes of a run, and how.

    Attributes:
        where: A condition on ``scenes``, see :mod:`stable_data.query`; None: all.
        scene_ids: These alone; all where empty.
        limit: The first so many of them; None: all.
        settled: Objects lie where the physics engine left them (table ``settled``); else where the scene has them.
    """

    where: str | None = None
    scene_ids: tuple[str, ...] = ()
    limit: int | None = None
    settled: bool = False

    @property
    def condition(self) -> str | None:
        """The condition that ``where`` and ``scene_ids`` make."""
        parts = ([f"({self.where})"] if self.where else []) + (
            [f"scene_id in {sorted(self.scene_ids)!r}"] if self.scene_ids else []
        )
        return " and ".join(parts) or None


@dataclass(frozen=True, slots=True)
class Exported:
    """What became of an export.

    Attributes:
        made: Scenes that were written.
        there: Scenes that were there already.
        boxes: Objects of the written scenes for which a box stands in.
        failures: A line for each scene that could not be exported.
    """

    made: int
    there: int
    boxes: int
    failures: tuple[str, ...]

    @property
    def total(self) -> int:
        """All scenes that were asked for."""
        return self.made + self.there + len(self.failures)


class RunScenes:
    """The scenes of a run with their geometry, read as they are asked for; of each table no more than a row group is held.

    Args:
        run: The run, with the tables of ``NEEDED``.
        choice: Which of its scenes.
        files: Local folder for its meshes.

    Attributes:
        store: The meshes of the run.

    Raises:
        ConfigError: A table is missing (``table_missing``) or cannot be read; ``where`` is no condition; or a scene of ``scene_ids``
            is not there (``scene_unknown``).
    """

    def __init__(self, run: RunFolder, choice: Choice, files: Path) -> None:
        check_tables(run, settled=choice.settled)
        self._scenes = TableFiles(run.uri, "scenes", None, where=choice.condition)
        self._limit = choice.limit
        if choice.scene_ids:
            _check_known(run, choice)
        self.store = AssetStore(TableAssets(run, files))
        self._settled = SettledPoses(run) if choice.settled else None

    def __len__(self) -> int:
        """How many there are."""
        return len(self._scenes) if self._limit is None else min(len(self._scenes), self._limit)

    def __iter__(self) -> Iterator[Scene]:
        """The scenes, in the order of the run's files."""
        left = len(self)
        for group in range(len(self._scenes.groups)):
            if not left:
                return
            for part in slices(self._scenes.read([group])):
                for row in part.slice(0, left).to_pylist():
                    left -= 1
                    yield scene_from_row(row)

    def solid(self, scene: Scene) -> SolidScene:
        """One of them with its geometry.

        Raises:
            SceneError: It was never settled, and that is asked for.
        """
        return SolidScene.of(scene, self.store, None if self._settled is None else self._settled.of(scene.scene_id))


class SettledPoses:
    """The table ``settled`` of a run.

    Args:
        run: The run.
    """

    def __init__(self, run: RunFolder) -> None:
        ids = TableFiles(run.uri, "settled", ["scene_id"])
        self._rows = TableFiles(run.uri, "settled", None)
        self._place = {
            name: (group, row)
            for group in range(len(ids.groups))
            for row, name in enumerate(ids.read([group])["scene_id"].to_pylist())
        }
        self._read: tuple[int, pa.Table] | None = None

    def of(self, scene_id: str) -> dict[str, RestPose]:
        """Where its objects came to rest, by instance; empty where it was never settled."""
        if scene_id not in self._place:
            return {}
        group, row = self._place[scene_id]
        if self._read is None or self._read[0] != group:
            self._read = group, self._rows.read([group])
        poses = self._read[1]["poses"][row].as_py()
        return {pose["instance"]: (tuple(pose["position"]), tuple(pose["quat_xyzw"])) for pose in poses}


def check_tables(run: RunFolder, *, settled: bool = False) -> None:
    """Refuses a run that lacks what an export needs.

    Raises:
        ConfigError: ``table_missing``.
    """
    for table in (*NEEDED, *(("settled",) if settled else ())):
        if not run.files(table):
            hint = "export it without --settled" if table == "settled" else "preprocess the dataset, or take the run of a job"
            raise ConfigError(
                f"{run.uri}: the run has no table {table}, expected {', '.join(NEEDED)}"
                f"{' and settled' if settled else ''}; {hint}",
                "table_missing",
            )


def export_run(run: RunFolder, out: Path, name: str, choice: Choice, progress: Progress | None = None) -> Exported:
    """Writes scenes of a run in another format; run again, it writes what is missing.

    Beside the scenes stand README.md, Asset_annotation.json with category, licence and source of every asset that they use, and
    export.json, what they were made from.

    Args:
        run: The run.
        out: Local folder.
        name: Of the format, see :data:`stable_data.export.formats.FORMATS`.
        choice: Which scenes.
        progress: Is told of every scene.

    Returns:
        How many were written, were there and failed.

    Raises:
        ConfigError: It cannot start: the format, a table or a scene is not known, or the folder holds something else.
    """
    chosen = format_named(name)
    target = RunFolder(str(out))
    with tempfile.TemporaryDirectory(prefix="stable-data-") as files:
        scenes = RunScenes(run, choice, Path(files))
        annotations = run_annotations(run)
        with target.locked():
            _check_same(target, run, name, choice)
            try:
                return _export(scenes, annotations, out, chosen, progress)
            except OSError as error:
                raise unwritable(str(out), error) from error


def _export(
    scenes: RunScenes,
    annotations: Mapping[str, AssetAnnotation],
    out: Path,
    chosen: Format,
    progress: Progress | None,
) -> Exported:
    made, there, boxes, failures, used = 0, 0, 0, list[str](), set[str]()
    for scene in scenes:
        try:
            place = chosen.place(scene, out)
            if place.exists():
                there += 1
            else:
                solid = scenes.solid(scene)
                chosen.write(solid, out)
                made += 1
                boxes += solid.meshes.count(None)
            used |= {o.asset_id or "" for o in scene.objects} & annotations.keys()
        except StableDataError as error:
            if error.code in ("output_unwritable", "shard_unreadable"):
                raise
            message = str(error)
            failures.append(message if message.startswith(scene.scene_id) else f"{scene.scene_id}: {message}")
        if progress is not None:
            progress(made + there + len(failures), len(scenes), len(failures))
    write_annotations(out, {asset_id: annotations[asset_id] for asset_id in used})
    put_file(out / "README.md", _readme(chosen, made + there, [annotations[asset_id] for asset_id in used]).encode())
    return Exported(made, there, boxes, tuple(failures))


def _readme(chosen: Format, num_scenes: int, assets: Sequence[AssetAnnotation]) -> str:
    licences = Counter((a.licence or "not known", a.source or "not known") for a in assets)
    rows = [f"| {licence} | {source} | {count} |" for (licence, source), count in sorted(licences.items())]
    return "\n".join(
        [
            f"# {num_scenes} tabletop scenes",
            "",
            chosen.ABOUT,
            "",
            "Frame: the table top is z = 0 with its near-left corner at the origin, +x right, +y away from the viewer, z up; metres, "
            "kilograms, radians. An object's position is the centre of its box. An object without a mesh is a see-through box.",
            "",
            f"{MANIFEST_FILE} says what was exported from which run. The assets, each with category, source and licence in "
            f"{ANNOTATION_FILE}:",
            "",
            "| licence | source | assets |",
            "|---|---|---|",
            *rows,
            "",
        ]
    )


def _check_known(run: RunFolder, choice: Choice) -> None:
    """Refuses scenes that the run does not have, or that the condition does not take."""
    ids = TableFiles(run.uri, "scenes", ["scene_id"], where=choice.condition)
    have = {name for group in range(len(ids.groups)) for name in ids.read([group])["scene_id"].to_pylist()}
    missing = sorted(set(choice.scene_ids) - have)
    if missing:
        those = f" where {choice.where}" if choice.where else ""
        raise ConfigError(
            f"{run.uri}: the run has no scenes {missing[:5]}{those}, expected ids of its table scenes", "scene_unknown"
        )


def _check_same(target: RunFolder, run: RunFolder, name: str, choice: Choice) -> None:
    """Writes the manifest, or refuses a folder that holds another export."""
    settings: dict[str, Any] = {
        "format": name,
        "run": run.uri,
        "input_fingerprint": content_id({table: sorted(run.shard_ids(table)) for table in (*NEEDED, "settled")}),
        "where": choice.where,
        "scenes": sorted(choice.scene_ids),
        "limit": choice.limit,
        "settled": choice.settled,
    }
    content = target.read_bytes(MANIFEST_FILE)
    if content is None:
        if any(path.name != ".lock" for path in Path(target.root).iterdir()):
            raise ConfigError(
                f"{target.uri}: holds something else, expected an empty folder or this export", "output_not_empty"
            )
        text = json.dumps(settings | {"code_version": __version__}, indent=2, sort_keys=True, ensure_ascii=False)
        target.write_bytes(MANIFEST_FILE, (text + "\n").encode())
        return
    try:
        was = dict(json.loads(content))
    except (ValueError, TypeError):
        was = {}
    for key, now in settings.items():
        if was.get(key) != now:
            raise ConfigError(
                f"{target.uri}: {key}: {was.get(key)} -> {now}, expected what the export was begun with; choose a new folder",
                "config_changed",
            )
