"""The plan of a preprocess run: the shards that a dataset is split into.

Assets and scenes are split by a fixed rule, and the id of a shard is a hash of its inputs and settings. The plan therefore
depends on the dataset and the settings alone.
"""

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tqdm import tqdm

import stable_data
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard
from pipelines.preprocess.asset import AssetUse, TextFeature
from pipelines.preprocess.features import FeatureUse
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.content_id import content_id
from stable_data.errors import Notice
from stable_data.mesatask import MesaTaskDataset, read_text_features
from stable_data.mesatask.asset_uses import AssetUseCount
from stable_data.storage import schemas


@dataclass(frozen=True, slots=True)
class PreprocessPlan:
    """The work of a run.

    Attributes:
        assets: Shards of assets, with their use.
        features: Shards of assets, with the shapes whose features are computed.
        scenes: Shards of scene ids.
        inputs: Hashes of all inputs, by kind.
        scene_ids: Scenes of the dataset, including those whose layout is missing.
        asset_ids: Assets that are processed.
        notices: Notices about the dataset as a whole: scene folders without a layout (``layout_missing``, failures), requested
            assets without a mesh file (``glb_missing``), and the notices of its reader.
        encoder: Fingerprint of the encoder of the point features, or None if no features are computed.
    """

    assets: tuple[Shard[AssetUse], ...]
    features: tuple[Shard[FeatureUse], ...]
    scenes: tuple[Shard[str], ...]
    inputs: Mapping[str, str]
    scene_ids: tuple[str, ...]
    asset_ids: tuple[str, ...]
    notices: tuple[Notice, ...]
    encoder: str | None = None

    def counts(self) -> dict[str, int]:
        """The numbers of scenes, assets and features."""
        return {
            "num_scenes": len(self.scene_ids),
            "num_assets": len(self.asset_ids),
            "num_assets_without_mesh": sum(n.code == "glb_missing" for n in self.notices),
            "num_features": sum(len(use.shapes) for shard in self.features for use in shard.items),
        }


@dataclass
class _Content:
    """Hashes of the contents of a dataset, by scene and by asset."""

    layouts: dict[str, str]
    task_infos: dict[str, str | None]
    meshes: dict[str, str]
    annotations: dict[str, str]
    text_features: dict[str, str]

    def of_scene(self, scene_id: str) -> tuple[str, str, str | None]:
        return scene_id, self.layouts[scene_id], self.task_infos[scene_id]

    def of_asset(self, asset_id: str) -> tuple[str, str | None, str | None]:
        return asset_id, self.meshes.get(asset_id), self.annotations.get(asset_id)


def plan_run(dataset: MesaTaskDataset, settings: PreprocessSettings, encoder: str | None = None) -> PreprocessPlan:
    """Splits a dataset into shards.

    Args:
        dataset: The dataset; every layout and mesh file is read once for its hash.
        settings: Settings that shape the rows.
        encoder: Fingerprint of the encoder of the point features, or None to compute none.

    Raises:
        ConfigError: The text features cannot be used.
    """
    # The version without the hash of the sources: after a change of the code, check_resume prints a line and shards are kept.
    versions = {"table_version": schemas.TABLE_VERSION, "code": stable_data.__version__}
    shaping = settings.shaping() | versions
    uses: dict[str, AssetUseCount] = defaultdict(AssetUseCount)
    used_by_scene: dict[str, list[str]] = {}
    for scene_id in tqdm(dataset.scene_ids, desc="plan", unit="scene", leave=False):
        used_by_scene[scene_id] = _count_uses(dataset, scene_id, uses)
    wanted = sorted(set(uses) | (set(dataset.annotations) if settings.all_assets else set()))
    content = _content(dataset, wanted)
    asset_uses = [_asset_use(a, content.meshes[a], uses.get(a, AssetUseCount())) for a in wanted if a in content.meshes]
    asset_shards = []
    for uses_of_shard in split_groups(asset_uses, settings.assets_per_shard):
        of_assets = [(asdict(u), content.annotations[u.asset_id], content.text_features.get(u.asset_id)) for u in uses_of_shard]
        asset_shards.append(Shard(content_id("assets", shaping, of_assets), tuple(uses_of_shard)))
    feature_uses = [
        FeatureUse(a.asset_id, a.mesh_sha256, shapes)
        for a in asset_uses
        if (shapes := uses.get(a.asset_id, AssetUseCount()).shape_uses())
    ]
    feature_shards = [
        Shard(content_id("features", versions, encoder, [asdict(u) for u in of_shard]), tuple(of_shard))
        for of_shard in (split_groups(feature_uses, settings.assets_per_shard) if encoder is not None else ())
    ]
    scene_shards = []
    for scenes in split_groups(list(dataset.scene_ids), settings.scenes_per_shard):
        used = sorted({a for scene_id in scenes for a in used_by_scene[scene_id]})
        of_scenes = [content.of_scene(s) for s in scenes], [content.of_asset(a) for a in used]
        scene_shards.append(Shard(content_id("scenes", shaping, dataset.root.name, *of_scenes), tuple(scenes)))
    notices = (*dataset.notices, *(_without_mesh(a, a in uses) for a in wanted if a not in content.meshes))
    return PreprocessPlan(
        tuple(asset_shards),
        tuple(feature_shards),
        tuple(scene_shards),
        {kind: content_id(digests) for kind, digests in vars(content).items()}
        | {"folder": content_id(sorted((n.item_id, n.code) for n in notices))},
        (*dataset.scene_ids, *(n.item_id for n in notices if n.code == "layout_missing")),
        tuple(use.asset_id for use in asset_uses),
        notices,
        encoder,
    )


def text_features(root: Path) -> dict[str, TextFeature]:
    """The library's text features by asset; empty if the library has none.

    Raises:
        ConfigError: The file cannot be used.
    """
    path = root / "sbert_text_features.pkl"
    if not path.is_file():
        return {}
    asset_ids, features = read_text_features(path)
    return dict(zip(asset_ids, features, strict=True))


def _content(dataset: MesaTaskDataset, wanted: Sequence[str]) -> _Content:
    layouts = {s: dataset.layout_path(s) for s in dataset.scene_ids}
    task_infos = {s: path.with_name("task_info.json") for s, path in layouts.items()}
    features = text_features(dataset.root)
    return _Content(
        layouts={s: file_digest(path) for s, path in layouts.items()},
        task_infos={s: file_digest(path) if path.is_file() else None for s, path in task_infos.items()},
        meshes={a: file_digest(path) for a in wanted if (path := dataset.asset_path(a)) is not None},
        annotations={a: content_id(dict(dataset.annotation(a).raw)) for a in wanted},
        text_features={a: hashlib.sha256(features[a].tobytes()).hexdigest() for a in wanted if a in features},
    )


def _count_uses(dataset: MesaTaskDataset, scene_id: str, uses: dict[str, AssetUseCount]) -> list[str]:
    try:
        scene, _ = dataset.read(scene_id)
    except Exception:  # noqa: BLE001 - the step of scenes reports the error
        return []
    for o in scene.objects:
        if o.asset_id is not None:
            uses[o.asset_id].add(o.scale, o.tilt_quat_xyzw)
    return [o.asset_id for o in scene.objects if o.asset_id is not None]


def _asset_use(asset_id: str, digest: str, use: AssetUseCount) -> AssetUse:
    aspects = tuple(sorted(use.aspects()))
    return AssetUse(asset_id, digest, use.typical_scale(), aspects, tuple(use.most_tilts()))


def _without_mesh(asset_id: str, is_used: bool) -> Notice:
    consequence = "objects of it are kept as boxes" if is_used else "it is left out"
    message = f"{asset_id}: is {'used' if is_used else 'annotated'} but has no GLB in the library; {consequence}; add the file"
    return Notice(asset_id, "plan", "glb_missing", message)


def file_digest(path: Path) -> str:
    """The hash of a file's content, or the reason if it cannot be read; the step that reads the file reports the error."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        return f"unreadable: {error.strerror}"
