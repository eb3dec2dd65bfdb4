"""Correct: scenes of a dataset or of a run become scenes that are exactly clean.

Repair of other people's datasets, and rearrangement. The scenes of a shard go through the flow as one batch, so a shard's rows
depend on nothing but the shard.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar

from models.physics_corrector.certify import CertifyOptions, Status
from models.physics_corrector.corrector import Correction, Flow, PhysicsCorrector
from models.physics_corrector.learned import load_flow, weights_fingerprint
from pipelines.correct_report import write_correct_report
from pipelines.job import (
    Rows,
    check_resume,
    check_shards,
    count_items,
    count_rows,
    new_manifest,
    rows_alone,
    rows_or_failure,
    run_missing,
    write_manifest,
)
from pipelines.progress import Progress
from pipelines.runner import Loss, Workers, alone, limited
from pipelines.scene_source import FolderSource, SceneSource, TableSource, Taken, scene_source
from pipelines.scene_step import SceneSettings, num_carried, related
from stable_data import tables
from stable_data.errors import ConfigError, Notice
from stable_data.mesatask import PositionConvention, write_annotations, write_scene
from stable_data.mesatask.library import LIBRARY_FOLDER
from stable_data.metrics.audit import PosedScene
from stable_data.scene import FloatArray, Scene
from stable_data.shards import RunFolder, content_id, unwritable

I = TypeVar("I")  # noqa: E741 - an item

WhenFull: TypeAlias = Literal["drop", "infeasible"]

CORRECT_TABLES = ("warnings", "failures", "corrections", "scenes")
"""Tables of a shard, in the order in which they are put in place."""

CARRIED_TABLES = ("assets", "meshes", "sdf", "features")
"""Tables of the input run that the output carries, so that it can be trained on and exported as it is."""

_OF_DATASET = content_id("dataset")


@dataclass(frozen=True, slots=True)
class CorrectSettings:
    """Settings of the job; ``--set key=value`` or the table ``[correct]`` of a TOML file.

    Attributes:
        weights: The corrector: ``auto`` is the one in the repository, ``none`` certifies alone, else a file.
        steps: Steps of the flow; 0 as its weights say.
        when_full: What happens where not everything fits: ``drop`` the least important background object, or ``infeasible``.
        restore: Whether the scene graph's on and in relations are restored where the layout broke them.
        fixed: Categories or instances that must stay, joined by commas.
        judge_raw: Whether the raw result of the flow is audited too.
        important_threshold: Objects nearer than this to a task object are O^B, metres.
        seed: For task templates and splits.
        position_convention: ``box_centre``, ``mesh_centre``, or ``auto``: judged on the dataset.
        scenes_per_shard: Scenes of one shard, where they come from a folder.
        write_dataset: Whether the corrected scenes of a folder are written in its format too, beside the tables.
        num_pictures: Scenes drawn in the report, before and after.
        seconds_per_item: A scene that takes longer is a failure; not watched without worker processes.
    """

    weights: str = "auto"
    steps: int = 0
    when_full: str = "drop"
    restore: bool = True
    fixed: str = ""
    judge_raw: bool = True
    important_threshold: float = 0.02
    seed: int = 0
    position_convention: str = "auto"
    scenes_per_shard: int = 32
    write_dataset: bool = True
    num_pictures: int = 8
    seconds_per_item: float = 600.0

    def __post_init__(self) -> None:
        """Refuses settings that no run can follow."""
        if self.when_full not in ("drop", "infeasible"):
            raise ConfigError(f"setting correct.when_full is {self.when_full}, expected drop or infeasible", "config_invalid")
        if self.position_convention not in ("auto", *PositionConvention):
            found = f"setting correct.position_convention is {self.position_convention}"
            raise ConfigError(f"{found}, expected auto, box_centre or mesh_centre", "config_invalid")
        for key in ("important_threshold", "scenes_per_shard", "seconds_per_item"):
            if getattr(self, key) <= 0:
                found = f"setting correct.{key} is {getattr(self, key)}"
                raise ConfigError(f"{found}, expected a positive number", "config_invalid")
        if self.steps < 0:
            raise ConfigError(f"setting correct.steps is {self.steps}, expected 0 or more", "config_invalid")

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows: a run is resumed only under the same."""
        aside = ("num_pictures", "seconds_per_item", "write_dataset")
        return {k: v for k, v in asdict(self).items() if k not in aside}

    def scene_settings(self) -> SceneSettings:
        """Those of reading a scene."""
        convention = PositionConvention(self.position_convention)  # settled() has replaced auto
        return SceneSettings(self.important_threshold, self.seed, position_convention=convention)

    def settled(self, source: SceneSource) -> "CorrectSettings":
        """The settings with ``auto`` replaced: what positions mean, and where the weights are."""
        settings = self
        if settings.position_convention == "auto":
            settings = replace(settings, position_convention=str(source.position_convention()))
        if settings.weights not in ("auto", "none"):
            settings = replace(settings, weights=str(Path(settings.weights).expanduser().resolve()))
        return settings

    def fixed_in(self, scene: Scene) -> frozenset[str]:
        """The instances of a scene that must stay."""
        names = {name.strip() for name in self.fixed.split(",")}
        return frozenset(o.instance for o in scene.objects if {o.instance, o.category} & names)


@dataclass(frozen=True, slots=True)
class CorrectShard:
    """Scenes that are done together.

    Attributes:
        shard_id: Content of its inputs, the weights and the settings that shape it.
        scenes: Scene ids.
    """

    shard_id: str
    scenes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.scenes)

    def __str__(self) -> str:
        return f"shard {self.shard_id} ({len(self.scenes)} scenes)"


@dataclass(frozen=True, slots=True)
class CorrectWork:
    """The work of one shard; sent to the workers.

    Attributes:
        scenes: Where the scenes are: an absolute path or a URI that every worker can read.
        out: The run's folder, which every worker can write, likewise.
        settings: The job's settings.
        fingerprint: Content of the inputs: what a process keeps of one is not used for another in the same place.
    """

    scenes: str
    out: str
    settings: CorrectSettings
    fingerprint: str = ""

    def __call__(self, shard: CorrectShard, *, isolated: bool = False) -> tuple[int, int]:
        """Does the shard and puts its tables in place; gives its scenes and how many of them failed."""
        rows: dict[str, list[tables.Row]] = defaultdict(list)
        usable = []
        for scene_id in shard.scenes:
            failed = self._limited(self.taken, scene_id, scene_id, isolated)
            _add(rows, failed)
            if not failed:
                usable.append(scene_id)
        for item in zip(usable, self._raw_poses(usable, isolated), strict=True):
            _add(rows, self._limited(self.corrected, item, item[0], isolated))
        out = RunFolder(self.out)
        for table in CORRECT_TABLES:
            out.write_shard(table, shard.shard_id, rows[table])
        return len(shard), len(rows["failures"])

    def taken(self, scene_id: str) -> Rows:
        """Takes a scene from its source; gives the row of its failure, or nothing."""
        progress = Progress("read")

        def take() -> Rows:
            self._take(scene_id, progress)
            return {}

        return rows_or_failure(scene_id, progress, take)

    def raw_poses(self, scene_ids: Sequence[str]) -> list[FloatArray | None]:
        """What the flow makes of scenes: poses of their objects, (N, 4) float64; None without a flow."""
        taken = [self._take(scene_id, Progress("read")) for scene_id in scene_ids]
        corrector = self._corrector()
        fixed = [self.settings.fixed_in(t.scene) for t in taken]
        raws = corrector.raw([t.scene for t in taken], [t.shapes for t in taken], fixed)
        return [None if raw is None else raw.poses() for raw in raws]

    def corrected(self, item: tuple[str, FloatArray | None]) -> Rows:
        """Rows of one scene, from where the flow put its objects."""
        scene_id, raw_poses = item
        progress = Progress("certify")
        return rows_or_failure(scene_id, progress, lambda: self._rows(scene_id, raw_poses, progress))

    def _rows(self, scene_id: str, raw_poses: FloatArray | None, progress: Progress) -> Rows:
        taken = self._take(scene_id, progress)
        progress.step = "certify"
        raw = None if raw_poses is None else taken.scene.with_poses(raw_poses)
        fixed = self.settings.fixed_in(taken.scene)
        done = self._corrector().certified(taken.scene, taken.shapes, taken.audit, raw, fixed)
        notices = list(taken.notices)
        found: Rows = {"corrections": [correction_row(done)]}
        if done.certified is None or done.audit is None or done.card_after is None:
            message = f"{scene_id}: {done.reason}"
            found["failures"] = [tables.notice_row(Notice(scene_id, "certify", str(done.status), message))]
        else:
            progress.step = "relations"
            shape_of = {o.instance: shape for o, shape in zip(taken.scene.objects, taken.shapes, strict=True)}
            posed = PosedScene(done.certified, [shape_of[o.instance] for o in done.certified.objects])
            scene, _ = related(posed, done.audit, taken.containers)
            stacked, contained = num_carried(scene)
            card = replace(done.card_after, num_stacked=stacked, num_contained=contained)
            found["scenes"] = [{**tables.scene_row(scene), **tables.card_row(card), **done.audit.rows(), **taken.origin}]
            notices += [
                Notice(scene_id, "certify", "dropped", f"{scene_id}: {d.instance} is left out: {d.reason}")
                for d in done.dropped
            ]
            if done.status is Status.UNKNOWN:
                notices.append(Notice(scene_id, "certify", "unknown", f"{scene_id}: {done.reason}"))
        return found | {"warnings": [tables.notice_row(n) for n in notices]}

    def _raw_poses(self, scene_ids: Sequence[str], isolated: bool) -> list[FloatArray | None]:
        if not isolated:
            return self.raw_poses(scene_ids)
        seconds = self.settings.seconds_per_item * max(1, len(scene_ids))
        found = alone(self.raw_poses, scene_ids, seconds=seconds, prepare=self._prepare)
        if isinstance(found, Loss):
            raise ConfigError(
                f"the flow {str(found).replace('_', ' ')} over {len(scene_ids)} scenes such as {scene_ids[0]}; free memory, take "
                "smaller shards, or set weights to none",
                "flow_failed",
            )
        return found

    def _limited(self, make: Callable[[I], Rows], item: I, scene_id: str, isolated: bool) -> Rows:
        seconds = self.settings.seconds_per_item
        if isolated:
            return rows_alone(make, item, scene_id, seconds=seconds, prepare=self._prepare)
        self._prepare()
        with limited(seconds):
            return make(item)

    def _prepare(self) -> None:
        """Opens what scenes need, outside of the time of the first one."""
        _opened(self.scenes, self.fingerprint)
        self._corrector()

    def _corrector(self) -> PhysicsCorrector:
        settings = self.settings
        when_full: WhenFull = "infeasible" if settings.when_full == "infeasible" else "drop"
        options = CertifyOptions(when_full=when_full, restore=settings.restore)
        return PhysicsCorrector(_flow(settings.weights, settings.steps, self.fingerprint), options, settings.judge_raw)

    def _take(self, scene_id: str, progress: Progress) -> Taken:
        return _taken(self.scenes, self.fingerprint, self.settings.scene_settings(), scene_id, _Told(progress))


class _Told:
    """A progress that is no part of a cache's key."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Told)

    def __hash__(self) -> int:
        return 0


@lru_cache(maxsize=2)
def _opened(scenes: str, fingerprint: str) -> SceneSource:
    return scene_source(scenes)


@lru_cache(maxsize=64)  # of a shard: a scene is asked for three times
def _taken(scenes: str, fingerprint: str, settings: SceneSettings, scene_id: str, told: _Told) -> Taken:
    return _opened(scenes, fingerprint).take(scene_id, settings, told.progress)


@lru_cache(maxsize=1)
def _flow(weights: str, steps: int, fingerprint: str) -> Flow | None:
    return load_flow(weights, steps)


def correct(scenes: str, out: str, settings: CorrectSettings, workers: Workers, *, report: bool = True) -> dict[str, Any]:
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
    where = scenes if "://" in scenes else str(Path(scenes).expanduser().resolve())
    folder = RunFolder(out)
    if "://" not in scenes and folder.is_local and Path(where) in (Path(folder.root), *Path(folder.root).parents):
        raise ConfigError(f"{out}: lies in the scenes that are read, expected another folder", "output_invalid")
    source = scene_source(where)
    settings = _settled(source, settings, workers)
    with folder.locked():
        parts, inputs = source.parts(settings.scene_settings(), settings.scenes_per_shard)
        inputs |= {"weights": weights_fingerprint(settings.weights)}
        shards = [
            CorrectShard(content_id("correct", settings.shaping(), inputs["weights"], p.content), p.scene_ids) for p in parts
        ]
        scene_ids = [scene_id for shard in shards for scene_id in shard.scenes]
        fingerprint = content_id(inputs)
        manifest = new_manifest(
            "correct", source.name, fingerprint, inputs=inputs, settings=asdict(settings), num_scenes=len(scene_ids)
        )
        check_resume(folder, manifest, settings.shaping())
        write_manifest(folder, manifest)
        lost = [n for n in source.notices if n.code == "layout_missing"]
        _write_notices(folder, lost, [n for n in source.notices if n.code != "layout_missing"])
        work = CorrectWork(where, folder.root if folder.is_local else out, settings, fingerprint)
        run_missing(folder, shards, lambda _: CORRECT_TABLES, work, workers, "correct", "scene")
        ids = {shard.shard_id for shard in shards}
        check_shards(folder, {t: ids | {_OF_DATASET} if t in ("warnings", "failures") else ids for t in CORRECT_TABLES})
        carried = _carry(source, folder)
        failed = count_items(folder, "scenes", "scene_id", [*scene_ids, *(n.item_id for n in lost)])
        status = Counter(folder.table("corrections", ["status"])["status"].to_pylist())
        counts = {**count_rows(folder, (*CORRECT_TABLES, *carried)), "failed_scenes": failed, "by_status": dict(status)}
        manifest |= {"status": "complete", "counts": counts}
        write_manifest(folder, manifest)
        if settings.write_dataset and isinstance(source, FolderSource) and folder.is_local:
            write_dataset(source, folder)
        if report:
            write_correct_report(folder, manifest, source.store, settings.num_pictures)
    return manifest


def _settled(source: SceneSource, settings: CorrectSettings, workers: Workers) -> CorrectSettings:
    """The settings with ``auto`` replaced, by a process of its own where workers are: a mesh must not end the run's."""
    if settings.position_convention != "auto" or workers.are_this_process or isinstance(source, TableSource):
        return settings.settled(source)
    settled = alone(settings.settled, source, seconds=64 * settings.seconds_per_item)
    if isinstance(settled, Loss):
        raise ConfigError(
            f"{source.name}: the check of what positions mean {str(settled).replace('_', ' ')} over a layout or mesh; set "
            "position_convention to box_centre or mesh_centre",
            "convention_unknown",
        )
    return settled


def _write_notices(folder: RunFolder, lost: Sequence[Notice], odd: Sequence[Notice]) -> None:
    """Rows that belong to no shard: scene folders without a layout, and what is odd about the source as a whole."""
    for table, found in (("failures", lost), ("warnings", odd)):
        if _OF_DATASET not in folder.shard_ids(table):
            folder.write_shard(table, _OF_DATASET, [tables.notice_row(n) for n in found])


def _carry(source: SceneSource, folder: RunFolder) -> list[str]:
    """Copies the tables of assets of a run, file by file; a dataset has none."""
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


def _add(rows: dict[str, list[tables.Row]], new: Mapping[str, Sequence[tables.Row]]) -> None:
    for table, found in new.items():
        rows[table] += found


def _pose_rows(scene: Scene) -> list[tables.Row]:
    return [{"instance": o.instance, "position": o.position, "yaw": o.yaw} for o in scene.objects]


def describe_correction(scenes: str, settings: CorrectSettings) -> dict[str, Any]:
    """What a run would do: settings and counts, for ``--dry-run``."""
    source = scene_source(scenes if "://" in scenes else str(Path(scenes).expanduser().resolve()))
    settings = settings.settled(source)
    parts, inputs = source.parts(settings.scene_settings(), settings.scenes_per_shard)
    inputs |= {"weights": weights_fingerprint(settings.weights)}
    num_scenes = sum(len(part.scene_ids) for part in parts)
    return {"settings": asdict(settings), "inputs": inputs, "num_shards": len(parts), "num_scenes": num_scenes}


def correction_row(done: Correction) -> tables.Row:
    """A correction as a row of ``corrections``."""
    kept = done.kept
    counted = ("on_in_held", "on_in_kept", "asked_broken", "asked_restored", "directional_held", "directional_kept")
    return {
        "scene_id": done.start.scene_id,
        "status": str(done.status),
        "reason": done.reason,
        "dropped": [{"instance": d.instance, "reason": d.reason} for d in done.dropped],
        "start": _pose_rows(done.start),
        "raw": None if done.raw is None else _pose_rows(done.raw),
        "card_before": asdict(done.card_before),
        "card_raw": None if done.card_raw is None else asdict(done.card_raw),
        "card_after": None if done.card_after is None else asdict(done.card_after),
        **{name: None if kept is None else getattr(kept, name) for name in counted},
    }


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
        for batch in folder.dataset("scenes").to_batches():
            for row in batch.to_pylist():
                write_scene(root, tables.scene_from_row(row), annotations=dataset.annotations)
    except OSError as error:
        raise unwritable(str(root), error) from error
    return root
