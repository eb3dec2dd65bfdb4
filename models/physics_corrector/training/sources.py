"""Reads the training set of the corrector: clean scenes of preprocess runs, and proposals of generate runs that use their assets.

These tables of a preprocess run are read: ``scenes`` with their metric cards, ``meshes``, ``sdf``, the samples in ``assets`` and,
on request, ``features``. The result takes minutes to compute; one file caches it, named by a hash of its inputs.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from torch import Tensor
from tqdm import tqdm

from models.physics_corrector.flow.category_texts import category_texts
from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.shape_tensors import ShapeCollector, grids_from_rows
from models.physics_corrector.training.dataset import TENSORS, ShapeKey, TrainingSet, read_cache, write_cache
from models.physics_corrector.training.proposals import TABLES as PROPOSAL_TABLES
from models.physics_corrector.training.proposals import ProposalSample, read_proposals
from stable_data.assets.point_features import FAR_TILT, PointFeatures, join_features, read_features
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.assets.text_embeddings import TextEncoder
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.scene import FloatArray, Scene, Stage
from stable_data.storage.row_groups import TableFiles, row_slices, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SCENE_LEAVES, scenes_from_table

FeatureSource: TypeAlias = Literal["point", "box"]
"""The network's inputs of a shape: ``point``, the encoder's features and the extents; ``box``, the extents alone."""

_VERSION = 4  # of the cache file; a change of its content needs a new number
_TABLES = ("scenes", "meshes", "sdf", "assets")
_STAGES = {stage: index for index, stage in enumerate(Stage)}
_SPLITS = {"train": 0, "validation": 1}


@dataclass(frozen=True, slots=True)
class TrainingScenes:
    """The source of a training set.

    Attributes:
        uris: Folders of preprocess runs. An asset that several have must be the same in all.
        cache: Local folder for computed files.
        num_surface: Samples of an object's surface.
        num_bottom: Samples of an object's bottom region.
        proposals: Folders of generate runs. Their scenes that use assets of ``uris`` alone give proposals.
    """

    uris: tuple[str, ...]
    cache: Path
    num_surface: int = 256
    num_bottom: int = 64
    proposals: tuple[str, ...] = ()

    def fingerprint(self) -> str:
        """Fingerprint of the tables that are read.

        Raises:
            ConfigError: A table is missing (``table_missing``).
        """
        kinds = (
            (self.uris, _TABLES, f"a preprocess run with {', '.join(_TABLES)}"),
            (self.proposals, PROPOSAL_TABLES, f"a generate run with {' and '.join(PROPOSAL_TABLES)}"),
        )
        read: list[dict[str, list[str]]] = []
        for uris, tables, expected in kinds:
            for uri in uris:
                run = RunFolder(uri)
                for table in tables:
                    if not run.files(table):
                        raise ConfigError(f"{uri}: no table {table}, expected the folder of {expected}", "table_missing")
                read.append({table: sorted(run.shard_ids(table)) for table in tables})
        return content_id(*read)

    def num_scenes(self) -> int:
        """Number of scenes of all preprocess runs."""
        return sum(RunFolder(uri).num_rows("scenes") for uri in self.uris)

    def store(self) -> AssetStore:
        """The meshes of the runs.

        Raises:
            ConfigError: Two runs have different meshes of one asset (``assets_differ``).
        """
        return AssetStore(_RunsAssets([(uri, RunAssets(RunFolder(uri), self.cache / "meshes")) for uri in self.uris]))

    def load(self, features: FeatureSource, encode: TextEncoder | None = None) -> TrainingSet:
        """Reads the training set from the cache, or computes and caches it.

        Args:
            features: The network's inputs of a shape.
            encode: Computes text features; None for a network without them.

        Raises:
            ConfigError: A run lacks a table (``table_missing``) or the features (``features_missing``), runs do not fit together
                (``assets_differ``, ``features_mixed``), or there is no clean scene in the split train (``set_empty``).
        """
        fingerprint = self.fingerprint()
        path = self.cache / f"scenes-{content_id(_VERSION, fingerprint, self.num_surface, self.num_bottom)}.safetensors"
        cached = read_cache(path)
        if cached is None:
            cached = self._compute(fingerprint)
            write_cache(path, *cached)
        training_set, keys = cached
        if not len(training_set.of_split(0)):
            counts = ", ".join(f"{name} {count}" for name, count in training_set.counts.items())
            raise ConfigError(
                f"{', '.join(self.uris)}: no clean scene in the split train ({counts}), expected at least one; "
                "preprocess more scenes, or set targets = repair",
                "set_empty",
            )
        if encode is not None:
            rows = torch.from_numpy(encode(training_set.texts))
            training_set = replace(training_set, text_features=rows, text_encoder=encode.fingerprint)
        return training_set if features == "box" else self._with_features(training_set, keys)

    def _with_features(self, training_set: TrainingSet, keys: Sequence[ShapeKey]) -> TrainingSet:
        found = [self._features(uri) for uri in self.uris]
        encoders = sorted({of_run.fingerprint for of_run in found})
        if len(encoders) > 1:
            raise ConfigError(
                f"{', '.join(self.uris)}: have features of the encoders {', '.join(encoders)}, expected those of one; preprocess "
                "all with one encoder",
                "features_mixed",
            )
        joined = join_features(found)
        nearest = [joined.nearest(key.asset_id, key.scale, key.tilt_quat_xyzw) for key in keys]
        values = torch.from_numpy(np.array([value for value, _ in nearest]))
        counts = {**training_set.counts, "shapes_without_near_feature": sum(angle > FAR_TILT for _, angle in nearest)}
        return replace(training_set, features=values, counts=counts, encoder=encoders[0])

    def _features(self, uri: str) -> PointFeatures:
        run = RunFolder(uri)
        if not run.files("features"):
            raise ConfigError(
                f"{uri}: no table features, expected one; fill it with the point encoder, or set features = box",
                "features_missing",
            )
        return read_features(run)

    def scenes(self, scene_ids: Sequence[str]) -> list[Scene]:
        """Reads scenes of the preprocess runs by id, in the given order; of two with one id that of the earlier run."""
        wanted = set(scene_ids)
        found: dict[str, Scene] = {}
        for uri in self.uris:
            table = TableFiles(uri, "scenes", list(SCENE_LEAVES))
            for group in range(len(table.groups)):
                rows = table.read([group])
                chosen = rows.filter(pc.is_in(rows["scene_id"], value_set=_texts(wanted - found.keys())))
                found |= {scene.scene_id: scene for scene in scenes_from_table(chosen)}
        return [found[scene_id] for scene_id in scene_ids]

    def _compute(self, fingerprint: str) -> tuple[TrainingSet, list[ShapeKey]]:
        store = self.store()  # refuses runs that do not fit together, before anything takes time
        scenes, splits, counts = list[Scene](), list[int](), Counter[str]()
        for uri in self.uris:
            of_run = clean_targets(uri)
            scenes, splits = scenes + of_run[0], splits + of_run[1]
            counts.update(of_run[2])
        num_targets, proposals = len(scenes), list[ProposalSample]()
        meshes = {asset_id: sha256 for uri in self.uris for asset_id, sha256 in _meshes(uri)}
        for uri in self.proposals:
            own, of_reason = read_proposals(uri, meshes)
            proposals += own
            counts.update(of_reason)
        scenes += [p.scene for p in proposals]
        splits += [_SPLITS.get(p.split, 2) for p in proposals]
        used_assets = {o.asset_id for scene in scenes for o in scene.objects if o.asset_id is not None}
        num_slots = max((len(scene.objects) for scene in scenes), default=1)
        shapes = ShapeCollector(
            store,
            num_surface=self.num_surface,
            num_bottom=self.num_bottom,
            grids=grids_from_rows(
                row for uri in reversed(self.uris) for row in _rows_of_assets(RunFolder(uri), "sdf", used_assets)
            ),
            points={asset_id: points for uri in reversed(self.uris) for asset_id, points in _points(RunFolder(uri)).items()},
        )
        parts = [
            LayoutBatch.from_scenes([scene], shapes, num_slots=num_slots)
            for scene in tqdm(scenes, desc="scenes", unit="scene", leave=False)
        ]
        stage = torch.full((len(scenes), num_slots), -1)
        words, texts = torch.full((len(scenes), num_slots + 1), -1), dict[str, int]()
        for n, scene in enumerate(scenes):
            found = [-1 if o.stage is None or n >= num_targets else _STAGES[o.stage] for o in scene.objects]
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
            dict(counts),
            fingerprint,
            tuple(texts),
            coarse=_coarse(proposals, num_slots) if proposals else None,
        )
        return training_set, shape_keys(scenes, batch)


def clean_targets(uri: str) -> tuple[list[Scene], list[int], dict[str, int]]:
    """Reads the scenes of a run that may be training targets, with their splits and the counts by reason.

    A target with a collision or a floating object would teach it, so scenes that are not clean, or whose card is unknown, are
    left out. The training job can repair them first.

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
            splits.append(_SPLITS.get(split, 2))
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
    return LayoutBatch(**{name: torch.cat([getattr(part, name) for part in parts]) for name in TENSORS})


def _coarse(proposals: Sequence[ProposalSample], num_slots: int) -> Tensor:
    """The proposed poses, (P, N, 4) float32."""
    coarse = torch.zeros((len(proposals), num_slots, 4))
    for n, proposal in enumerate(proposals):
        coarse[n, : len(proposal.coarse)] = torch.from_numpy(proposal.coarse)
    return coarse


class _RunsAssets:
    """The meshes of several runs, as an asset source."""

    def __init__(self, runs: Sequence[tuple[str, RunAssets]]) -> None:
        self._of: dict[str, RunAssets] = {}
        for uri, assets in runs:
            for asset_id in assets.asset_ids():
                first = self._of.setdefault(asset_id, assets)
                if first.sha256(asset_id) != assets.sha256(asset_id):
                    raise ConfigError(
                        f"{uri}: its mesh of the asset {asset_id} is not the one of an earlier run, expected the same; preprocess the "
                        "runs with the same version, or train on one of them",
                        "assets_differ",
                    )

    def asset_path(self, asset_id: str) -> Path | None:
        return self._of[asset_id].asset_path(asset_id) if asset_id in self._of else None

    def is_stored(self, asset_id: str) -> bool:
        return asset_id in self._of


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


def _meshes(uri: str) -> Iterator[tuple[str, str]]:
    """The assets of a run with the hashes of their meshes."""
    for row in RunFolder(uri).table("meshes", ["asset_id", "sha256"]).to_pylist():
        yield row["asset_id"], row["sha256"]


def _points(run: RunFolder) -> dict[str, FloatArray]:
    table = run.table("assets", ["asset_id", "points"])
    return {row["asset_id"]: row["points"].reshape(-1, 3).astype(np.float64) for row in rows_from_table(table)}
