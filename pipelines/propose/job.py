"""Propose: instructions and tables become raw layouts with assets, a folder in the MesaTask-10K format.

This is the reasoner alone: nothing is corrected, and what it lays out may collide or float.
"""

import hashlib
import io
import itertools
import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from PIL import Image
from tqdm import tqdm

from models.semantic_reasoner.factory import load_reasoner, shaping_of_proposals
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution.code_history import record_code
from pipelines.execution.shard_job import check_resume, check_shards, count_rows, engine_off, new_manifest, write_manifest
from pipelines.propose.report import write_propose_report
from pipelines.propose.settings import ProposeSettings, plain_retrieval
from pipelines.propose.shard import Outcome, Proposer, proposal_rows
from pipelines.reports.scene_pictures import drawn
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.tasks import read_tasks
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, MeshError, Notice, SceneError, unwritable
from stable_data.mesatask import write_annotations, write_scene
from stable_data.mesatask.layout import LAYOUT_FILE
from stable_data.mesatask.library import LIBRARY_FOLDER
from stable_data.mesatask.writing import LAYOUT_FOLDER, write_asset
from stable_data.scene import Scene
from stable_data.simulation.render import FRONT_SIZE
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import notice_row

TABLES = ("failures", "warnings")
"""Tables of a run; scenes are in the folder ``dataset``."""

PROPOSALS = "proposals"
"""Folder of the shards of ``proposals.jsonl``."""


def propose(
    tasks: Path | LayoutTask, out: str, settings: ProposeSettings, assets: Sequence[str] = (), *, report: bool = True
) -> dict[str, Any]:
    """Runs the job in this process, or what is missing of it.

    Args:
        tasks: A file of tasks, see :func:`pipelines.sources.tasks.read_tasks`, or one task.
        out: Local folder.
        settings: What shapes the scenes.
        assets: Where assets are taken from, see :class:`pipelines.sources.assets.AssetLibraries`.
        report: Whether to write the report page.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    folder = RunFolder(out)
    if not folder.is_local:
        raise ConfigError(f"{out}: is no local folder, expected one: scenes are written as files", "output_invalid")
    if isinstance(tasks, Path):
        next(read_tasks(tasks))  # what cannot be read at all is refused before anything is loaded
    shelf = AssetLibraries(assets)
    reasoner, statistics = load_reasoner(settings.engine, settings.reasoner)
    proposer = Proposer(reasoner, statistics, shelf.retriever(settings.retrieval), settings.stages, settings.seed)
    inputs = {"tasks": _fingerprint(tasks), "reasoner": shaping_of_proposals(settings.engine, settings.reasoner)}
    inputs |= {f"assets.{name}": found for name, found in shelf.fingerprints.items()}
    with folder.locked():
        name = tasks.stem if isinstance(tasks, Path) else tasks.scene_id
        told = asdict(settings) | settings.shaping() | {"retrieval": plain_retrieval(settings.retrieval)}
        manifest = new_manifest("propose", name, content_id(inputs), inputs=inputs, settings=told, engine=reasoner.engine.name)
        check_resume(folder, manifest, settings.shaping())
        write_manifest(folder, manifest)
        work = _Writer(folder, shelf, settings)
        num_tasks = num_scenes = 0
        shard_ids = []
        rows = read_tasks(tasks) if isinstance(tasks, Path) else iter([tasks])
        with tqdm(desc="propose", unit="scene") as bar:
            for part in _parts(rows, settings.scenes_per_shard):
                shard_id = content_id("propose", settings.shaping(), inputs, [asdict(task) for task in part])
                if not work.is_done(shard_id):
                    if record_code(folder.uri, manifest):
                        write_manifest(folder, manifest)
                    work.write(shard_id, part, proposer)
                shard_ids.append(shard_id)
                num_tasks += len(part)
                num_scenes += work.num_scenes(part)
                bar.update(len(part))
                bar.set_postfix_str(f"{num_tasks - num_scenes} failed", refresh=False)
        check_shards(folder, {table: set(shard_ids) for table in TABLES})
        work.close(shard_ids)
        counts = count_rows(folder, TABLES)
        if num_tasks - num_scenes != counts["failures"]:
            raise ConfigError(
                f"{out}: {num_scenes} scenes and {counts['failures']} failures of {num_tasks} tasks, expected each task to be one of "
                "both; was the folder changed by hand? choose a new one",
                "rows_differ",
            )
        manifest |= {"status": "complete", "num_tasks": num_tasks, "counts": {**counts, "scenes": num_scenes}}
        write_manifest(folder, manifest)
        if report:
            write_propose_report(folder, manifest, settings.num_pictures)
    return manifest


def _parts(rows: Iterable[LayoutTask | Notice], size: int) -> Iterator[list[LayoutTask | Notice]]:
    rows = iter(rows)
    while part := list(itertools.islice(rows, size)):
        yield part


def _fingerprint(tasks: Path | LayoutTask) -> str:
    if isinstance(tasks, LayoutTask):
        return content_id(asdict(tasks))
    with tasks.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:16]


class _Writer:
    """Puts scenes, their assets and what is to be said of them in place."""

    def __init__(self, folder: RunFolder, shelf: AssetLibraries, settings: ProposeSettings) -> None:
        self._folder, self._shelf, self._settings = folder, shelf, settings
        self.root = Path(folder.root) / "dataset"
        self._store = AssetStore(shelf)
        self._draws = settings.pictures
        self._num_told = 0  # notices of the engine

    def is_done(self, shard_id: str) -> bool:
        """Whether a part is in place; its rows are written after its scenes."""
        return all(shard_id in self._folder.shard_ids(table) for table in TABLES)

    def write(self, shard_id: str, part: Sequence[LayoutTask | Notice], proposer: Proposer) -> None:
        """Lays out a part and writes all that comes of it.

        Raises:
            ConfigError: The engine answers nothing any more (``engine_off``), or the folder cannot be written.
        """
        outcomes = proposer.outcomes([task for task in part if isinstance(task, LayoutTask)])
        if any(outcome.is_off for outcome in outcomes):
            failure = next(o.failure for o in outcomes if o.is_off)
            assert failure is not None
            raise engine_off(failure.message)
        failures = [row for row in part if isinstance(row, Notice)]
        warnings: list[Notice] = []
        for outcome in outcomes:
            warnings += outcome.warnings
            failure = outcome.failure or self._write_scene(outcome, warnings)
            if failure is not None:
                failures.append(failure)
                shutil.rmtree(self._scene_folder(outcome.layout.task), ignore_errors=True)  # of a run that was killed
        told = list(getattr(proposer.reasoner.engine, "notices", ()))
        warnings += told[self._num_told :]
        self._num_told = len(told)
        lines = (json.dumps(row, ensure_ascii=False) for o in outcomes for row in proposal_rows(o.layout))
        self._folder.write_bytes(f"{PROPOSALS}/{shard_id}.jsonl", "".join(f"{line}\n" for line in lines).encode())
        self._folder.write_shard("warnings", shard_id, [notice_row(n) for n in warnings])
        self._folder.write_shard("failures", shard_id, [notice_row(n) for n in failures])

    def num_scenes(self, part: Sequence[LayoutTask | Notice]) -> int:
        """How many tasks of a part have become scenes."""
        return sum(isinstance(task, LayoutTask) and (self._scene_folder(task) / LAYOUT_FILE).is_file() for task in part)

    def close(self, shard_ids: Sequence[str]) -> None:
        """Writes what is of the whole run: the annotations of its assets, and ``proposals.jsonl``."""
        try:
            uids = sorted(path.stem for path in (self.root / LIBRARY_FOLDER).glob("*.glb"))
            write_annotations(self.root, {uid: self._shelf.annotation(uid) for uid in uids})
            aside = Path(self._folder.root) / ".proposals.tmp-all"
            with aside.open("wb") as whole:
                for shard_id in shard_ids:
                    with (Path(self._folder.root) / PROPOSALS / f"{shard_id}.jsonl").open("rb") as part:
                        shutil.copyfileobj(part, whole)
            aside.replace(aside.with_name(f"{PROPOSALS}.jsonl"))
        except OSError as error:
            raise unwritable(self._folder.uri, error) from error

    def _scene_folder(self, task: LayoutTask) -> Path:
        return self.root / LAYOUT_FOLDER / task.table.table_type / task.scene_id

    def _write_scene(self, outcome: Outcome, warnings: list[Notice]) -> Notice | None:
        """Writes a scene with its assets; gives why it could not be."""
        assert outcome.scene is not None
        scene, _, odd = self._store.resolved(outcome.scene)
        warnings += odd
        uids = {o.asset_id for o in scene.objects if o.asset_id is not None}
        try:
            for uid in uids:
                path = self._shelf.asset_path(uid)
                if path is not None and not (self.root / LIBRARY_FOLDER / f"{uid}.glb").is_file():
                    write_asset(self.root, uid, path.read_bytes())
            annotations = {uid: self._shelf.annotation(uid) for uid in uids}
            extents = {uid: box for uid, a in annotations.items() if (box := a.extents_z_up) is not None}
            write_scene(self.root, scene, self._picture(scene, warnings), extents=extents, annotations=annotations)
        except (SceneError, MeshError) as error:
            return Notice(scene.scene_id, "write", error.code, str(error))
        except OSError as error:
            raise unwritable(str(self.root), error) from error
        return None

    def _picture(self, scene: Scene, warnings: list[Notice]) -> bytes | None:
        """The front view as PNG; None where it cannot be drawn, which is said."""
        if not self._draws:
            return None
        stream = io.BytesIO()
        try:
            Image.fromarray(drawn(scene, self._store, FRONT_SIZE)).save(stream, "png")
        except ConfigError as error:  # this machine draws nothing at all
            self._draws = False
            warnings.append(Notice(scene.scene_id, "draw", error.code, f"{scene.scene_id} and those after it: {error}"))
            return None
        except Exception as error:  # noqa: BLE001 - a scene that cannot be drawn is a scene nevertheless
            message = f"{scene.scene_id} cannot be drawn: {type(error).__name__}: {error}"
            warnings.append(Notice(scene.scene_id, "draw", "picture_missing", message))
            return None
        return stream.getvalue()
