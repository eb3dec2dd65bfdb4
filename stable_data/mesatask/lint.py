"""Lint: the audit of every scene of a folder, as a text page and as a table."""

import errno
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from tempfile import TemporaryFile

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from stable_data.assets.store import AssetStore
from stable_data.diversity.comparison import compare_sets
from stable_data.diversity.scene_set import ComparedScene, SceneSet
from stable_data.errors import Notice, StableDataError, cannot_write
from stable_data.mesatask import MesaTaskDataset, PositionConvention
from stable_data.mesatask.convention_detection import position_convention
from stable_data.mesatask.library import stem_of
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.card import MetricCard
from stable_data.metrics.summary import AuditSummary, summarise
from stable_data.scene import Scene
from stable_data.storage import schemas


@dataclass(frozen=True, slots=True)
class LintResult:
    """The result of lint.

    Attributes:
        root: The folder.
        rows: One row per scene: its id, the metric card, pairs and verdicts.
        failures: Scenes that could not be read or judged.
        warnings: Notices about the other scenes.
        scenes: What is compared of the scenes of the rows.
        library: Category of each asset that scenes may use, by its id; None if it is not known.
    """

    root: Path
    rows: tuple[schemas.Row, ...]
    failures: tuple[Notice, ...]
    warnings: tuple[Notice, ...]
    scenes: tuple[ComparedScene, ...] = ()
    library: Mapping[str, str] | None = None

    def frame(self) -> pl.DataFrame:
        """The rows as a table."""
        return pl.DataFrame(pl.from_arrow(self._arrow()))

    def summary(self) -> AuditSummary:
        """Computes the summary of the page."""
        return summarise(self.frame())

    def write(self, path: Path) -> None:
        """Writes the rows as Parquet.

        Raises:
            ConfigError: The file cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(self._arrow(), path, compression="zstd")
        except OSError as error:
            raise cannot_write(str(path), error) from error

    def __str__(self) -> str:
        """The page as text."""
        head = f"{self.root}: {len(self.rows)} scenes, {len(self.failures)} not usable, {len(self.warnings)} warnings"
        failed = [f"not usable: {n.message}" for n in self.failures]
        counted: dict[str, int] = {}
        for n in self.warnings:
            counted[n.code] = counted.get(n.code, 0) + 1
        warned = [f"warning {code:<36} {count:>6}" for code, count in sorted(counted.items())]
        [diversity] = compare_sets([SceneSet(str(self.root), self.scenes, len(self.scenes), self.library)]).sets
        page = [head, "", str(self.summary()), "", *diversity.lines()]
        return "\n".join([*page, *([""] if warned or failed else []), *warned, *failed])

    def _arrow(self) -> pa.Table:
        schema = schemas.SCHEMAS["scenes"]
        names = ["scene_id", "table_type", *(f.name for f in fields(MetricCard)), "pairs", "verdicts"]
        return pa.Table.from_pylist(list(self.rows), schema=pa.schema([schema.field(n) for n in names]))


def prepare_place(path: Path) -> None:
    """Creates the folder of a file that is written later, and checks that the file can be written.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=path.parent).close()
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    except OSError as error:
        raise cannot_write(str(path), error) from error


def lint_folder(root: Path, *, progress: bool = False) -> LintResult:
    """Audits every scene of a folder in the MesaTask-10K format.

    Raises:
        ConfigError: The folder is not a dataset.
    """
    dataset = MesaTaskDataset(root)
    store = AssetStore(dataset)
    convention = position_convention(dataset, store)
    rows, scenes = list[schemas.Row](), list[ComparedScene]()
    failures = [n for n in dataset.notices if n.code == "layout_missing"]
    warnings = [n for n in dataset.notices if n.code != "layout_missing"]
    for scene_id in tqdm(dataset.scene_ids, desc="lint", unit="scene", disable=not progress):
        found, notices = _lint_scene(dataset, store, convention, scene_id)
        if found is None:
            failures += notices
        else:
            rows.append(found[0])
            scenes.append(ComparedScene.of(found[1]))
            warnings += notices
    return LintResult(root, tuple(rows), tuple(failures), tuple(warnings), tuple(scenes), _library(dataset, scenes))


def _library(dataset: MesaTaskDataset, scenes: Sequence[ComparedScene]) -> dict[str, str]:
    """Category of each asset with a mesh that the annotations offer, by the id that scenes give it."""
    found = {
        uid: annotation.category
        for uid, annotation in ((uid, dataset.annotation(uid)) for uid in dataset.asset_ids)
        if annotation.is_offered and dataset.asset_path(uid) is not None
    }
    used = {name for scene in scenes for name in scene.assets if name is not None}
    for name in sorted(used - found.keys()):
        stem = stem_of(name)
        if stem in found and stem not in used:  # a rotated variant is the asset
            found[name] = found.pop(stem)
    return found


def _lint_scene(
    dataset: MesaTaskDataset, store: AssetStore, convention: PositionConvention, scene_id: str
) -> tuple[tuple[schemas.Row, Scene] | None, tuple[Notice, ...]]:
    """Returns the row of a scene, the scene, and notices about it; without a row, the reason."""
    step = "read"
    try:
        scene, read_notices = dataset.read(scene_id)
        step = "mesh"
        scene, shapes, mesh_notices = store.resolved(scene, convention)
        step = "audit"
        audit = audit_scene(scene, shapes)
    except StableDataError as error:
        return None, (Notice(scene_id, step, error.code, str(error)),)
    except Exception as error:  # noqa: BLE001 - an unexpected error loses one scene, not the page
        message = f"{scene_id}: {type(error).__name__}: {error}; please report this with the file"
        return None, (Notice(scene_id, step, "unexpected", message),)
    row = {"scene_id": scene_id, "table_type": scene.table.table_type, **asdict(audit.card()), **audit.rows()}
    return (row, scene), (*read_notices, *mesh_notices, *audit.notices)
