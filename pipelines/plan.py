"""The plan of a preprocess run: settings, and the shards that a dataset is cut into.

Assets and scenes are cut by a fixed rule, and each shard is named by the content of its inputs and the settings that shape it:
the plan of the same dataset and settings is the same, whoever makes it.
"""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

import stable_data
from pipelines.asset_step import AssetUse
from pipelines.scene_step import SceneSettings
from stable_data import tables
from stable_data.assets import AssetStore, aspect_steps, position_convention
from stable_data.errors import ConfigError, SceneError
from stable_data.mesatask import MesaTaskDataset, PositionConvention
from stable_data.scene import QuatXyzw, Vec3
from stable_data.shards import content_id

T = TypeVar("T")

_MAX_SCALES = 1001  # of one asset that its typical scale is taken from
_MAX_TILTS = 8


@dataclass(frozen=True, slots=True)
class PreprocessSettings:
    """Settings of the job; ``--set key=value`` or the table ``[preprocess]`` of a TOML file.

    Attributes:
        important_threshold: Objects nearer than this to a task object are O^B, metres.
        seed: For task templates and splits.
        train_share: Share of near-duplicate groups in the training split.
        validation_share: Share in the validation split; the rest is the test split.
        position_convention: ``box_centre``, ``mesh_centre``, or ``auto``: judged on the dataset.
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
    position_convention: str = "auto"
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
                raise ConfigError(
                    f"setting preprocess.{key} is {getattr(self, key)}, expected a positive number", "config_invalid"
                )
        if self.position_convention not in ("auto", *PositionConvention):
            raise ConfigError(
                f"setting preprocess.position_convention is {self.position_convention}, expected auto, box_centre or mesh_centre",
                "config_invalid",
            )
        shares = (self.train_share, self.validation_share)
        if min(shares) < 0 or sum(shares) > 1:
            raise ConfigError(f"splits are {shares}, expected shares that add up to at most 1", "config_invalid")

    def shaping(self) -> dict[str, Any]:
        """The settings that shape rows: a run is resumed only under the same."""
        aside = ("num_pictures", "seconds_per_item", "task_cache")
        return {k: v for k, v in asdict(self).items() if k not in aside}

    def scene_settings(self) -> SceneSettings:
        """Those of the scene step."""
        convention = PositionConvention(self.position_convention)  # settled() has replaced auto
        return SceneSettings(self.important_threshold, self.seed, self.train_share, self.validation_share, convention)

    def settled(self, dataset: MesaTaskDataset) -> "PreprocessSettings":
        """The settings with ``auto`` replaced by what the dataset shows."""
        if self.position_convention != "auto":
            return self
        return replace(self, position_convention=str(position_convention(dataset, AssetStore(dataset))))


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

    def __str__(self) -> str:
        return f"shard {self.shard_id} ({len(self.scenes)} scenes, {len(self.assets)} assets)"


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run has to do.

    Attributes:
        shards: All shards, assets first.
        fingerprint: Content of all inputs.
        num_scenes: Scenes of the dataset.
        num_assets: Assets that are processed.
        num_assets_without_mesh: Assets that are annotated or used but have no mesh file.
    """

    shards: tuple[Shard, ...]
    fingerprint: str
    num_scenes: int
    num_assets: int
    num_assets_without_mesh: int


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
    wanted = sorted(set(uses) | (set(dataset.annotations) if settings.all_assets else set()))
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
    num_missing = len(wanted) - len(asset_uses)
    return Plan((*asset_shards, *scene_shards), fingerprint, len(dataset.scene_ids), len(asset_uses), num_missing)


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
