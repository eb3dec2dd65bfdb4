"""The clean scenes of a run as tensors, for training and validation of the corrector, with a cache on disk.

The tables of the run folder are read: ``scenes`` with their metric cards, ``meshes``, ``sdf``, the samples in ``assets`` and,
on request, ``features``. The result takes minutes to compute; one file caches it, named by a hash of its inputs.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from models.physics_corrector.flow.category_texts import category_texts
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.sdf_atlas import SdfAtlas
from models.physics_corrector.geometry.shape_tensors import ShapeCollector, ShapeTensors, grids_from_rows
from stable_data.assets.point_features import FAR_TILT, read_features
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.assets.text_embeddings import TextEncoder
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.scene import FloatArray, QuatXyzw, Scene, Stage, Vec3
from stable_data.storage.row_groups import TableFiles, row_slices, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SCENE_LEAVES, scenes_from_table

FeatureSource: TypeAlias = Literal["point", "box"]
"""The network's inputs of a shape: ``point``, the encoder's features and the extents; ``box``, the extents alone."""

_VERSION = 2  # of the cache file; a change of its content needs a new number
_TABLES = ("scenes", "meshes", "sdf", "assets")
_STAGES = {stage: index for index, stage in enumerate(Stage)}
_TENSORS = tuple(f.name for f in fields(LayoutBatch) if f.default is MISSING)  # those that every batch has


@dataclass(frozen=True, slots=True)
class ShapeKey:
    """The asset, scale and tilt of a shape.

    Attributes:
        asset_id: The asset; a clean scene has the mesh of every object.
        scale: Metres per mesh unit.
        tilt_quat_xyzw: Rotation before yaw.
    """

    asset_id: str
    scale: Vec3
    tilt_quat_xyzw: QuatXyzw


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSet:
    """Clean scenes of a run, of all splits.

    Attributes:
        batch: The scenes with their clean poses, without features and texts; :meth:`take` adds these.
        geometry: Their shapes.
        stage: Index of each object's stage, -1 if it has none, (B, N) int64.
        words: Index of each object's category among the texts, and last that of the table's kind, (B, N + 1) int64; -1 in padding.
        split: ``train`` 0, ``validation`` 1, others 2, (B,) int64.
        scene_ids: The ids of the B scenes.
        counts: Numbers of scenes that were read, used and left out, by reason.
        fingerprint: Fingerprint of the run's content.
        texts: The categories of objects and the kinds of tables, in plain words.
        encoder: Fingerprint of the encoder of the features; empty without features.
        text_encoder: Fingerprint of the encoder of the texts; empty without text features.
        features: Point features of the shapes, (S, F) float32; None without features.
        text_features: Text features of ``texts``, (T, D) float32; None without them.
    """

    batch: LayoutBatch
    geometry: ShapeTensors
    stage: Tensor
    words: Tensor
    split: Tensor
    scene_ids: tuple[str, ...]
    counts: Mapping[str, int]
    fingerprint: str
    texts: tuple[str, ...] = ()
    encoder: str = ""
    text_encoder: str = ""
    features: Tensor | None = None
    text_features: Tensor | None = None

    def take(self, scenes: Tensor) -> LayoutBatch:
        """Selects scenes by index (S,) int64, with the features of their shapes and texts."""
        batch = self.batch.take(scenes)
        if self.features is not None:
            batch = replace(batch, features=self.features[batch.shape_index])
        if self.text_features is not None:
            found = torch.where((self.words[scenes] >= 0)[..., None], self.text_features[self.words[scenes].clamp_min(0)], 0)
            batch = replace(batch, texts=found[:, :-1], table_text=found[:, -1])
        return batch

    def of_split(self, split: int) -> Tensor:
        """Indices of the scenes of a split, (S,) int64."""
        return (self.split == split).nonzero()[:, 0]

    def to(self, device: torch.device | str) -> "TrainingSet":
        """Copies scenes, shapes and stages to a device."""
        moved = {name: getattr(self, name).to(device) for name in ("batch", "geometry", "stage", "words")}
        features, texts = (None if f is None else f.to(device) for f in (self.features, self.text_features))
        return replace(self, **moved, features=features, text_features=texts)


@dataclass(frozen=True, slots=True)
class TrainingScenes:
    """The source of a training set.

    Attributes:
        uri: The run folder.
        cache: Local folder for computed files.
        num_surface: Samples of an object's surface.
        num_bottom: Samples of an object's bottom region.
    """

    uri: str
    cache: Path
    num_surface: int = 256
    num_bottom: int = 64

    def fingerprint(self) -> str:
        """Fingerprint of the tables that are read.

        Raises:
            ConfigError: A table is missing (``table_missing``).
        """
        run = RunFolder(self.uri)
        for table in _TABLES:
            if not run.files(table):
                raise ConfigError(
                    f"{self.uri}: no table {table}, expected the folder of a preprocess run with {', '.join(_TABLES)}",
                    "table_missing",
                )
        return content_id({table: sorted(run.shard_ids(table)) for table in _TABLES})

    def store(self) -> AssetStore:
        """The meshes of the run."""
        return AssetStore(RunAssets(RunFolder(self.uri), self.cache / "meshes"))

    def load(self, features: FeatureSource, encode: TextEncoder | None = None) -> TrainingSet:
        """Reads the training set from the cache, or computes and caches it.

        Args:
            features: The network's inputs of a shape.
            encode: Computes text features; None for a network without them.

        Raises:
            ConfigError: The run lacks a table (``table_missing``) or the features (``features_missing``), or has no clean scene
                in the split train (``set_empty``).
        """
        fingerprint = self.fingerprint()
        path = self.cache / f"scenes-{content_id(_VERSION, fingerprint, self.num_surface, self.num_bottom)}.safetensors"
        cached = _read_cache(path)
        if cached is None:
            cached = self._compute(fingerprint)
            _write_cache(path, *cached)
        training_set, keys = cached
        if not len(training_set.of_split(0)):
            counts = ", ".join(f"{name} {count}" for name, count in training_set.counts.items())
            raise ConfigError(
                f"{self.uri}: no clean scene in the split train ({counts}), expected at least one; preprocess more scenes",
                "set_empty",
            )
        if encode is not None:
            rows = torch.from_numpy(encode(training_set.texts))
            training_set = replace(training_set, text_features=rows, text_encoder=encode.fingerprint)
        return training_set if features == "box" else self._with_features(training_set, keys)

    def _with_features(self, training_set: TrainingSet, keys: Sequence[ShapeKey]) -> TrainingSet:
        run = RunFolder(self.uri)
        if not run.files("features"):
            raise ConfigError(
                f"{self.uri}: no table features, expected one; fill it with the point encoder, or set features = box",
                "features_missing",
            )
        found = read_features(run)
        nearest = [found.nearest(key.asset_id, key.scale, key.tilt_quat_xyzw) for key in keys]
        values = torch.from_numpy(np.array([value for value, _ in nearest]))
        counts = {**training_set.counts, "shapes_without_near_feature": sum(angle > FAR_TILT for _, angle in nearest)}
        return replace(training_set, features=values, counts=counts, encoder=found.fingerprint)

    def scenes(self, scene_ids: Sequence[str]) -> list[Scene]:
        """Reads scenes of the run by id, in the given order."""
        table = TableFiles(self.uri, "scenes", list(SCENE_LEAVES))
        wanted = set(scene_ids)
        found: dict[str, Scene] = {}
        for group in range(len(table.groups)):
            rows = table.read([group])
            chosen = rows.filter(pc.is_in(rows["scene_id"], value_set=_texts(wanted)))
            found |= {scene.scene_id: scene for scene in scenes_from_table(chosen)}
        return [found[scene_id] for scene_id in scene_ids]

    def _compute(self, fingerprint: str) -> tuple[TrainingSet, list[ShapeKey]]:
        run = RunFolder(self.uri)
        scenes, splits, counts = clean_targets(self.uri)
        used_assets = {o.asset_id for scene in scenes for o in scene.objects if o.asset_id is not None}
        num_slots = max((len(scene.objects) for scene in scenes), default=1)
        shapes = ShapeCollector(
            self.store(),
            num_surface=self.num_surface,
            num_bottom=self.num_bottom,
            grids=grids_from_rows(_rows_of_assets(run, "sdf", used_assets)),
            points=_points(run),
        )
        parts = [
            LayoutBatch.from_scenes([scene], shapes, num_slots=num_slots)
            for scene in tqdm(scenes, desc="scenes", unit="scene", leave=False)
        ]
        stage = torch.full((len(scenes), num_slots), -1)
        words, texts = torch.full((len(scenes), num_slots + 1), -1), dict[str, int]()
        for n, scene in enumerate(scenes):
            found = [-1 if o.stage is None else _STAGES[o.stage] for o in scene.objects]
            stage[n, : len(found)] = torch.tensor(found)
            names = [texts.setdefault(text, len(texts)) for text in category_texts(scene)]
            words[n, : len(found)], words[n, -1] = torch.tensor(names[:-1]), names[-1]
        batch = _concatenate(parts)
        training_set = TrainingSet(
            batch,
            shapes.geometry(),
            stage,
            words,
            torch.tensor(splits, dtype=torch.int64),
            tuple(scene.scene_id for scene in scenes),
            counts,
            fingerprint,
            tuple(texts),
        )
        return training_set, shape_keys(scenes, batch)


def clean_targets(uri: str) -> tuple[list[Scene], list[int], dict[str, int]]:
    """Reads the scenes of a run that may be training targets, with their splits and the counts by reason.

    A target with a collision or a floating object would teach it, so scenes that are not clean, or whose card is unknown, are
    left out. They could be repaired by ``certify`` here instead.

    Raises:
        ConfigError: The table cannot be read.
    """
    table = TableFiles(uri, "scenes", [*SCENE_LEAVES, "split", "clean"])
    scenes: list[Scene] = []
    splits: list[int] = []
    counts = {"scenes": 0, "kept": 0, "left_out_not_clean": 0, "left_out_unknown": 0, "left_out_empty": 0}
    for group in range(len(table.groups)):
        rows = table.read([group])
        found = zip(scenes_from_table(rows), rows["split"].to_pylist(), rows["clean"].to_pylist(), strict=True)
        for scene, split, is_clean in found:
            counts["scenes"] += 1
            reason = "unknown" if is_clean is None else "not_clean" if not is_clean else "" if scene.objects else "empty"
            if reason:
                counts[f"left_out_{reason}"] += 1
                continue
            counts["kept"] += 1
            scenes.append(scene)
            splits.append({"train": 0, "validation": 1}.get(split, 2))
    return scenes, splits, counts


def shape_keys(scenes: Sequence[Scene], batch: LayoutBatch) -> list[ShapeKey]:
    """Returns the key of each shape, in the order of shape indices."""
    keys: dict[int, ShapeKey] = {}
    for scene, indices in zip(scenes, batch.shape_index.tolist(), strict=True):
        for o, index in zip(scene.objects, indices, strict=False):
            assert o.asset_id is not None  # a clean scene has the mesh of every object
            assert o.scale is not None
            keys.setdefault(index, ShapeKey(o.asset_id, o.scale, o.tilt_quat_xyzw))
    return [keys[index] for index in range(len(keys))]


def _concatenate(parts: Sequence[LayoutBatch]) -> LayoutBatch:
    if not parts:  # an empty batch with the right shapes and types
        return _concatenate([LayoutBatch.from_scenes([], ShapeCollector(AssetStore(_NoAssets())), num_slots=1)])
    return LayoutBatch(**{name: torch.cat([getattr(part, name) for part in parts]) for name in _TENSORS})


class _NoAssets:
    def asset_path(self, asset_id: str) -> Path | None:
        return None


def _texts(values: set[str]) -> Any:
    return pa.array(sorted(values), pa.string())


def _rows_of_assets(run: RunFolder, table: str, assets: set[str]) -> Iterator[Mapping[str, Any]]:
    """Reads the rows of some assets in slices, because a table of grids may be larger than memory."""
    files = TableFiles(run.uri, table, None)
    for group in range(len(files.groups)):
        rows = files.read([group])
        for part in row_slices(rows.filter(pc.is_in(rows["asset_id"], value_set=_texts(assets)))):
            yield from rows_from_table(part)


def _points(run: RunFolder) -> dict[str, FloatArray]:
    table = run.table("assets", ["asset_id", "points"])
    return {row["asset_id"]: row["points"].reshape(-1, 3).astype(np.float64) for row in rows_from_table(table)}


def _write_cache(path: Path, data: TrainingSet, keys: Sequence[ShapeKey]) -> None:
    """Writes a training set without its features atomically."""
    tensors = {f"batch.{name}": getattr(data.batch, name) for name in _TENSORS}
    tensors |= {f"geometry.{name}": getattr(data.geometry, name) for name in ShapeTensors.__slots__ if name != "atlas"}
    tensors |= {f"atlas.{name}": getattr(data.geometry.atlas, name) for name in SdfAtlas.__slots__}
    tensors |= {name: getattr(data, name) for name in ("stage", "words", "split")}
    about: dict[str, Any] = {name: getattr(data, name) for name in ("scene_ids", "fingerprint", "texts")}
    about["counts"] = dict(data.counts)
    about["keys"] = [(key.asset_id, key.scale, key.tilt_quat_xyzw) for key in keys]
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}")
    save_file({name: value.contiguous() for name, value in tensors.items()}, aside, {"about": json.dumps(about)})
    aside.replace(path)


def _read_cache(path: Path) -> tuple[TrainingSet, list[ShapeKey]] | None:
    """Reads a training set; None if the file is missing or damaged."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()["about"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (OSError, SafetensorError):
        return None
    batch = LayoutBatch(**{name: tensors[f"batch.{name}"] for name in _TENSORS})
    atlas = SdfAtlas(*(tensors[f"atlas.{name}"] for name in SdfAtlas.__slots__))
    parts = {name: tensors[f"geometry.{name}"] for name in ShapeTensors.__slots__ if name != "atlas"}
    keys = [ShapeKey(asset_id, tuple(scale), tuple(tilt)) for asset_id, scale, tilt in about["keys"]]
    data = TrainingSet(
        batch,
        ShapeTensors(atlas=atlas, **parts),
        tensors["stage"],
        tensors["words"],
        tensors["split"],
        tuple(about["scene_ids"]),
        about["counts"],
        about["fingerprint"],
        tuple(about["texts"]),
    )
    return data, keys
