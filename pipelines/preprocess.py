"""Preprocess: a folder of scenes in the MesaTask-10K format becomes staged, geometry-complete tables.

The plan cuts assets and scenes into shards by a fixed rule and names each by the content of its inputs and the settings that
shape it; a shard whose last table is in place is done. Workers write their own shards, so nothing large travels.
"""

import hashlib
import importlib
import json
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

import stable_data
from pipelines.asset_step import AssetSettings, AssetUse, preprocess_asset
from pipelines.report import write_report
from pipelines.runner import Workers, alone
from pipelines.scene_step import CachedWriter, SceneSettings, preprocess_scene
from pipelines.settings import differences
from stable_data import tables
from stable_data.assets import AssetStore, aspect_steps
from stable_data.errors import ConfigError, Notice, SceneError, StableDataError
from stable_data.mesatask import MesaTaskDataset, read_text_features
from stable_data.scene import QuatXyzw, Scene, Vec3
from stable_data.shards import RunFolder, content_id

T = TypeVar("T")

_MAX_SCALES = 1001  # of one asset that its typical scale is taken from
_MAX_TILTS = 8
SCENE_TABLES = ("warnings", "failures", "samples", "scenes")
"""Tables of a scene shard, in the order in which they are put in place: the last one says that the shard is complete."""
ASSET_TABLES = ("warnings", "failures", "sdf", "meshes", "assets")
"""Tables of an asset shard, likewise."""


@dataclass(frozen=True, slots=True)
class PreprocessSettings:
    """Settings of the job; ``--set key=value`` or the table ``[preprocess]`` of a TOML file.

    Attributes:
        important_threshold: Objects nearer than this to a task object are O^B, metres.
        seed: For task templates and splits.
        train_share: Share of near-duplicate groups in the training split.
        validation_share: Share in the validation split; the rest is the test split.
        num_points: Surface points of an asset.
        all_assets: Process every annotated asset with a mesh, not only those that a scene uses.
        scenes_per_shard: Scenes of one shard.
        assets_per_shard: Assets of one shard.
        task_writer: ``module:function`` that writes task infos for scenes without one; empty: templates.
        task_cache: Folder that keeps its answers.
        num_pictures: Scenes drawn in the report.
        seconds_per_item: A scene or asset that takes longer is a failure.
    """

    important_threshold: float = 0.02
    seed: int = 0
    train_share: float = 0.9
    validation_share: float = 0.05
    num_points: int = 1024
    all_assets: bool = True
    scenes_per_shard: int = 32
    assets_per_shard: int = 8
    task_writer: str = ""
    task_cache: str = "data/task_cache"
    num_pictures: int = 12
    seconds_per_item: float = 600.0

    def __post_init__(self) -> None:
        """Refuses settings that no run can follow."""
        positive = ("important_threshold", "num_points", "scenes_per_shard", "assets_per_shard", "seconds_per_item")
        for key in positive:
            if getattr(self, key) <= 0:
                raise ConfigError(f"setting preprocess.{key} is {getattr(self, key)}, expected a positive number", "config_invalid")
        shares = (self.train_share, self.validation_share)
        if min(shares) < 0 or sum(shares) > 1:
            raise ConfigError(f"splits are {shares}, expected shares that add up to at most 1", "config_invalid")

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows: a run is resumed only under the same."""
        aside = ("num_pictures", "seconds_per_item", "task_cache")
        return {k: v for k, v in asdict(self).items() if k not in aside}

    def scene_settings(self) -> SceneSettings:
        """Those of the scene step."""
        return SceneSettings(self.important_threshold, self.seed, self.train_share, self.validation_share)


@dataclass(frozen=True, slots=True)
class Shard:
    """Scenes or assets that are done together.

    Attributes:
        shard_id: Content of its inputs and of the settings that shape it.
        scenes: Scene ids; empty for a shard of assets.
        assets: Assets with their use.
    """

    shard_id: str
    scenes: tuple[str, ...] = ()
    assets: tuple[AssetUse, ...] = ()

    def __len__(self) -> int:
        return len(self.scenes) + len(self.assets)


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run has to do.

    Attributes:
        shards: All shards, assets first.
        fingerprint: Content of all inputs.
        num_scenes: Scenes of the dataset.
        num_assets: Assets that are processed.
    """

    shards: tuple[Shard, ...]
    fingerprint: str
    num_scenes: int
    num_assets: int


@dataclass
class _Use:
    """How scenes use an asset, being counted."""

    scales: list[Vec3] = field(default_factory=list)
    tilts: Counter[QuatXyzw] = field(default_factory=Counter)
    aspects: set[tuple[int, int, int]] = field(default_factory=set)

    def add(self, scale: Vec3 | None, tilt: QuatXyzw) -> None:
        self.tilts[_rounded_tilt(tilt)] += 1
        if scale is not None:
            self.aspects.add(aspect_steps(scale))
            if len(self.scales) < _MAX_SCALES:
                self.scales.append(scale)

    def typical_scale(self) -> Vec3 | None:
        if not self.scales:
            return None
        x, y, z = np.median(np.array(self.scales), axis=0).tolist()
        return x, y, z


def plan_run(dataset: MesaTaskDataset, settings: PreprocessSettings) -> Plan:
    """Cuts a dataset into shards.

    Args:
        dataset: The dataset; every layout and mesh file is read once for its content.
        settings: What shapes the rows.
    """
    shaping = settings.shaping() | {"table_version": tables.TABLE_VERSION, "code": stable_data.__version__}
    uses: dict[str, _Use] = defaultdict(_Use)
    digests: dict[str, str] = {}
    used_by_scene: dict[str, list[str]] = {}
    for scene_id in tqdm(dataset.scene_ids, desc="plan", unit="scene", leave=False):
        digests[scene_id] = _scene_digest(dataset, scene_id)
        used_by_scene[scene_id] = _count_uses(dataset, scene_id, uses)
    wanted = sorted(set(uses) | (set(dataset.asset_ids) if settings.all_assets else set()))
    mesh_digests = {a: _file_digest(path) for a in wanted if (path := dataset.asset_path(a)) is not None}
    asset_uses = [_asset_use(a, mesh_digests[a], uses.get(a, _Use())) for a in wanted if a in mesh_digests]
    asset_shards = [
        Shard(content_id("assets", shaping, [asdict(use) for use in group]), assets=tuple(group))
        for group in _groups(asset_uses, settings.assets_per_shard)
    ]
    scene_shards = []
    for group in _groups(list(dataset.scene_ids), settings.scenes_per_shard):
        meshes = sorted({(a, mesh_digests.get(a)) for scene_id in group for a in used_by_scene[scene_id]})
        scene_shards.append(Shard(content_id("scenes", shaping, [(s, digests[s]) for s in group], meshes), scenes=tuple(group)))
    fingerprint = content_id(sorted(digests.items()), sorted(mesh_digests.items()))
    return Plan((*asset_shards, *scene_shards), fingerprint, len(dataset.scene_ids), len(asset_uses))


def _count_uses(dataset: MesaTaskDataset, scene_id: str, uses: dict[str, _Use]) -> list[str]:
    try:
        scene, _ = dataset.read(scene_id)
    except SceneError:
        return []  # its own step will say why
    for o in scene.objects:
        if o.asset_id is not None:
            uses[o.asset_id].add(o.scale, o.tilt_quat_xyzw)
    return [o.asset_id for o in scene.objects if o.asset_id is not None]


def _asset_use(asset_id: str, digest: str, use: _Use) -> AssetUse:
    tilts = sorted(use.tilts.items(), key=lambda item: (-item[1], item[0]))[:_MAX_TILTS]
    aspects = tuple(sorted(use.aspects | {(0, 0, 0)}))
    return AssetUse(asset_id, digest, use.typical_scale(), aspects, tuple(tilts))


def _rounded_tilt(tilt: QuatXyzw) -> QuatXyzw:
    """A tilt to about a degree, with one of its two signs."""
    sign = 1.0 if next((q for q in reversed(tilt) if abs(q) > 0.01), 1.0) > 0 else -1.0
    x, y, z, w = (round(sign * q, 2) + 0.0 for q in tilt)
    return x, y, z, w


def _groups(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    return (items[start : start + size] for start in range(0, len(items), size))


def _file_digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _scene_digest(dataset: MesaTaskDataset, scene_id: str) -> str:
    layout = dataset.layout_path(scene_id)
    task = layout.with_name("task_info.json")
    return content_id(_file_digest(layout), _file_digest(task) if task.is_file() else None)


@dataclass(frozen=True, slots=True)
class PreprocessShard:
    """The work of one shard; sent to the workers.

    Attributes:
        data: Root of the dataset, which every worker can read.
        out: The run's folder, which every worker can write.
        settings: The job's settings.
    """

    data: str
    out: str
    settings: PreprocessSettings

    def __call__(self, shard: Shard, *, isolated: bool = False) -> tuple[int, int]:
        """Does the shard and puts its tables in place; gives its items and how many of them failed."""
        rows: dict[str, list[tables.Row]] = defaultdict(list)
        for item in (*shard.assets, *shard.scenes):
            found = alone(self.item, item, seconds=self.settings.seconds_per_item) if isolated else self.item(item)
            if found is None:
                item_id = item if isinstance(item, str) else item.asset_id
                message = f"{item_id}: the process that read it died or took over {self.settings.seconds_per_item:g} s; is the file hostile?"
                found = {"failures": [tables.notice_row(Notice(item_id, "isolate", "crashed", message))]}
            for table, new in found.items():
                rows[table] += new
        out = RunFolder(self.out)
        for table in ASSET_TABLES if shard.assets else SCENE_TABLES:
            out.write_shard(table, shard.shard_id, rows[table])
        return len(shard), len(rows["failures"])

    def item(self, item: str | AssetUse) -> dict[str, list[tables.Row]]:
        """Rows of one scene or asset, by table; a failure is a row too."""
        dataset, store = _opened(self.data)
        item_id = item if isinstance(item, str) else item.asset_id
        try:
            if isinstance(item, str):
                scene = preprocess_scene(dataset, item, store, self.settings.scene_settings(), _writer(self.settings))
                found = {"scenes": [scene.scene], "samples": list(scene.samples)}
                notices = scene.notices
            else:
                embedding = _embeddings(self.data).get(item.asset_id)
                asset = preprocess_asset(
                    item, dataset.annotation(item.asset_id), store, AssetSettings(self.settings.num_points), embedding
                )
                found = {"assets": [asset.asset], "meshes": [asset.mesh], "sdf": list(asset.grids)}
                notices = asset.notices
        except ConfigError:
            raise  # the run itself cannot go on
        except StableDataError as error:
            return {"failures": [tables.notice_row(Notice(item_id, _step_of(item), error.code, str(error)))]}
        except Exception as error:  # noqa: BLE001 - the one place where what nobody foresaw becomes a row
            message = f"{item_id}: {type(error).__name__}: {error}; please report this with the file"
            return {"failures": [tables.notice_row(Notice(item_id, _step_of(item), "unexpected", message))]}
        return found | {"warnings": [tables.notice_row(n) for n in notices]}


def _step_of(item: str | AssetUse) -> str:
    return "read" if isinstance(item, str) else "mesh"


@lru_cache(maxsize=2)
def _opened(data: str) -> tuple[MesaTaskDataset, AssetStore]:
    dataset = MesaTaskDataset(Path(data))
    return dataset, AssetStore(dataset)


@lru_cache(maxsize=2)
def _embeddings(data: str) -> dict[str, list[float]]:
    path = Path(data) / "sbert_text_features.pkl"
    if not path.is_file():
        return {}
    asset_ids, features = read_text_features(path)
    return {a: row.tolist() for a, row in zip(asset_ids, features, strict=True)}


@lru_cache(maxsize=2)
def _writer(settings: PreprocessSettings) -> CachedWriter | None:
    if not settings.task_writer:
        return None
    module, _, name = settings.task_writer.partition(":")
    try:
        write: Callable[..., Any] = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"setting task_writer is {settings.task_writer} ({error}), expected module:function", "config_invalid") from error
    return CachedWriter(write, settings.task_cache, settings.task_writer)


def preprocess(data: str, out: str, settings: PreprocessSettings, workers: Workers, *, report: bool = True) -> dict[str, Any]:
    """Runs the job, or what is missing of it.

    Args:
        data: Root of a dataset in the MesaTask-10K format.
        out: Local folder or object-store URI.
        settings: What shapes the rows.
        workers: Who runs the shards.
        report: Whether to write the report page.

    Returns:
        The manifest: settings, fingerprint, versions and counts.

    Raises:
        ConfigError: The run cannot start or go on; what is in place stays.
    """
    dataset = MesaTaskDataset(Path(data))
    _writer(settings)
    _embeddings(data)
    folder = RunFolder(out)
    with folder.locked():
        plan = plan_run(dataset, settings)
        manifest = _manifest(dataset, plan, settings)
        _check_resume(folder, manifest)
        folder.write_bytes("manifest.json", _json(manifest))
        _run_shards(folder, plan, PreprocessShard(str(dataset.root), out, settings), workers)
        manifest |= {"status": "complete", "counts": _counts(folder)}
        if report:
            write_report(folder, manifest, AssetStore(dataset), settings.num_pictures)
        folder.write_bytes("manifest.json", _json(manifest))
    return manifest


def describe_plan(data: str, settings: PreprocessSettings) -> dict[str, Any]:
    """What a run would do: settings and counts, for ``--dry-run``."""
    plan = plan_run(MesaTaskDataset(Path(data)), settings)
    counts = {"num_scenes": plan.num_scenes, "num_assets": plan.num_assets, "num_shards": len(plan.shards)}
    return {"settings": asdict(settings), "input_fingerprint": plan.fingerprint, **counts}


def _run_shards(folder: RunFolder, plan: Plan, work: PreprocessShard, workers: Workers) -> None:
    done = folder.shard_ids("scenes") | folder.shard_ids("assets")
    missing = [s for s in plan.shards if s.shard_id not in done]
    total, failed = sum(map(len, plan.shards)), 0
    with tqdm(total=total, initial=total - sum(map(len, missing)), desc="preprocess", unit="item") as bar:
        for size, failures in workers.run(work, missing) if missing else ():
            failed += failures
            bar.update(size)
            bar.set_postfix_str(f"{failed} failed", refresh=False)


def _manifest(dataset: MesaTaskDataset, plan: Plan, settings: PreprocessSettings) -> dict[str, Any]:
    return {
        "job": "preprocess",
        "status": "running",
        "code_version": stable_data.__version__,
        "table_version": tables.TABLE_VERSION,
        "dataset": dataset.root.name,
        "input_fingerprint": plan.fingerprint,
        "settings": asdict(settings),
        "num_scenes": plan.num_scenes,
        "num_assets": plan.num_assets,
    }


def _check_resume(folder: RunFolder, manifest: dict[str, Any]) -> None:
    """Refuses to mix rows of two configurations, inputs or versions in one folder."""
    content = folder.read_bytes("manifest.json")
    if content is None:
        return
    try:
        was = json.loads(content)
    except json.JSONDecodeError as error:
        raise ConfigError(f"{folder.uri}/manifest.json: not JSON ({error}); is this the folder of a run?", "manifest_invalid") from error
    shaping = PreprocessSettings(**manifest["settings"]).shaping()
    compared = ("job", "code_version", "table_version", "input_fingerprint")
    changed = differences({k: was.get(k) for k in compared}, {k: manifest[k] for k in compared})
    changed += differences({k: was.get("settings", {}).get(k) for k in shaping}, shaping)
    if changed:
        raise ConfigError(
            f"{folder.uri}: was made with another configuration ({'; '.join(changed)}); choose a new folder or restore it", "config_changed"
        )


def _counts(folder: RunFolder) -> dict[str, Any]:
    counts: dict[str, Any] = {t: folder.dataset(t).count_rows() for t in dict.fromkeys((*ASSET_TABLES, *SCENE_TABLES))}
    for table in ("warnings", "failures"):
        rows = folder.table(table, ["code", "step"])
        counts[f"{table}_by_code"] = dict(sorted(Counter(rows["code"].to_pylist()).items()))
    steps = Counter(folder.table("failures", ["step"])["step"].to_pylist())
    counts["failures_by_step"] = dict(sorted(steps.items()))
    return counts


def _json(document: dict[str, Any]) -> bytes:
    return (json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode()
