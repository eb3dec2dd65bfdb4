"""A run's clean scenes as tensors: what the corrector is trained and judged on, and how its parts are kept between runs.

Only tables of the run folder are read: ``scenes`` with their metric cards, ``meshes``, ``sdf``, the samples in ``assets`` and,
where they are asked for, ``features``. What takes minutes to compute is kept in one file, named by what it was made from.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
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

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.sdf_atlas import SdfAtlas
from models.physics_corrector.geometry.shape_tensors import GridKey, ShapeCollector, ShapeTensors, grids_from_rows
from stable_data.assets.point_features import FAR_TILT, read_features
from stable_data.assets.run_assets import RunAssets
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.geometry.sdf.grid import SdfGrid
from stable_data.scene import FloatArray, QuatXyzw, Scene, Stage, Vec3
from stable_data.storage.row_groups import TableFiles, row_slices, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_arrays import SCENE_LEAVES, scenes_from_table

FeatureSource: TypeAlias = Literal["point", "box"]
"""What a network is told of shapes: ``point`` the encoder's features, ``box`` nothing but the extents that it always has."""

_VERSION = 1  # of the kept file
_TABLES = ("scenes", "meshes", "sdf", "assets")
_STAGES = {stage: index for index, stage in enumerate(Stage)}


@dataclass(frozen=True, slots=True)
class ShapeKey:
    """What a shape is made of.

    Attributes:
        asset_id: Its asset; a clean scene has the mesh of every object.
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
        batch: The scenes with their clean poses.
        geometry: Their shapes.
        stage: Index of each object's stage, -1 where it has none, (B, N) int64.
        split: ``train`` 0, ``validation`` 1, anything else 2, (B,) int64.
        scene_ids: B.
        counts: Scenes read, kept and left out, by reason.
        fingerprint: Content of the run that it was made from.
        encoder: Fingerprint of the encoder of the features; empty where there are none.
    """

    batch: LayoutBatch
    geometry: ShapeTensors
    stage: Tensor
    split: Tensor
    scene_ids: tuple[str, ...]
    counts: Mapping[str, int]
    fingerprint: str
    encoder: str = ""

    def of_split(self, split: int) -> Tensor:
        """Places of the scenes of a split, (S,) int64."""
        return (self.split == split).nonzero()[:, 0]

    def to(self, device: torch.device | str) -> "TrainingSet":
        """The same on a device."""
        return replace(self, batch=self.batch.to(device), geometry=self.geometry.to(device), stage=self.stage.to(device))


@dataclass(frozen=True, slots=True)
class TrainingScenes:
    """Where the scenes of a training set come from.

    Attributes:
        uri: The run folder.
        cache: Local folder for what is computed of it.
        num_surface: Samples of a surface.
        num_bottom: Samples of a bottom region.
    """

    uri: str
    cache: Path
    num_surface: int = 256
    num_bottom: int = 64

    def fingerprint(self) -> str:
        """Content of the tables that are read.

        Raises:
            ConfigError: A table is not there.
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

    def load(self, features: FeatureSource) -> TrainingSet:
        """The training set: read where it was kept, else computed and kept.

        Raises:
            ConfigError: The run lacks a table, holds no clean scene to train on, or its features cannot be used.
        """
        fingerprint = self.fingerprint()
        path = self.cache / f"scenes-{content_id(_VERSION, fingerprint, self.num_surface, self.num_bottom)}.safetensors"
        found = _read(path)
        if found is None:
            found = self._made(fingerprint)
            _write(path, *found)
        made, keys = found
        if not len(made.of_split(0)):
            raise ConfigError(
                f"{self.uri}: no clean scene in the split train ({_listed(made.counts)}), expected one at least; "
                "preprocess more scenes",
                "set_empty",
            )
        return made if features == "box" else self._with_features(made, keys)

    def _with_features(self, made: TrainingSet, keys: Sequence[ShapeKey]) -> TrainingSet:
        run = RunFolder(self.uri)
        if not run.files("features"):
            raise ConfigError(
                f"{self.uri}: no table features, expected one; fill it with the point encoder, or set features = box",
                "features_missing",
            )
        found = read_features(run)
        nearest = [found.nearest(key.asset_id, key.scale, key.tilt_quat_xyzw) for key in keys]
        values = torch.from_numpy(np.array([value for value, _ in nearest]))[made.batch.shape_index]
        counts = {**made.counts, "shapes_without_near_feature": sum(angle > FAR_TILT for _, angle in nearest)}
        return replace(made, batch=replace(made.batch, features=values), counts=counts, encoder=found.fingerprint)

    def scenes(self, scene_ids: Sequence[str]) -> list[Scene]:
        """Scenes of the run by id, in that order."""
        table = TableFiles(self.uri, "scenes", list(SCENE_LEAVES))
        wanted = set(scene_ids)
        found: dict[str, Scene] = {}
        for group in range(len(table.groups)):
            rows = table.read([group])
            chosen = rows.filter(pc.is_in(rows["scene_id"], value_set=_texts(wanted)))
            found |= {scene.scene_id: scene for scene in scenes_from_table(chosen)}
        return [found[scene_id] for scene_id in scene_ids]

    def _made(self, fingerprint: str) -> tuple[TrainingSet, list[ShapeKey]]:
        run = RunFolder(self.uri)
        scenes, splits, counts = clean_targets(self.uri)
        shapes = ShapeCollector(
            self.store(),
            num_surface=self.num_surface,
            num_bottom=self.num_bottom,
            grids=_grids(run, _used(scenes)),
            points=_points(run),
        )
        parts = [
            LayoutBatch.from_scenes([scene], shapes, num_slots=_most(scenes))
            for scene in tqdm(scenes, desc="scenes", unit="scene", leave=False)
        ]
        stage = torch.full((len(scenes), _most(scenes)), -1)
        for n, scene in enumerate(scenes):
            found = [-1 if o.stage is None else _STAGES[o.stage] for o in scene.objects]
            stage[n, : len(found)] = torch.tensor(found)
        batch = _joined(parts)
        made = TrainingSet(
            batch,
            shapes.geometry(),
            stage,
            torch.tensor(splits, dtype=torch.int64),
            tuple(scene.scene_id for scene in scenes),
            counts,
            fingerprint,
        )
        return made, shape_keys(scenes, batch)


def clean_targets(uri: str) -> tuple[list[Scene], list[int], dict[str, int]]:
    """The scenes of a run that may be targets, their splits, and how many were left out and why.

    A target that collides or floats teaches just that, and one whose card could not be made may. This is where a scene that is
    not clean would be repaired by ``certify`` instead of left out: its moved objects would take the place of ``scene``.

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
    """What each shape of the scenes' geometry is made of, by its place there."""
    keys: dict[int, ShapeKey] = {}
    for scene, indices in zip(scenes, batch.shape_index.tolist(), strict=True):
        for o, index in zip(scene.objects, indices, strict=False):
            assert o.asset_id is not None  # a clean scene has the mesh of every object
            assert o.scale is not None
            keys.setdefault(index, ShapeKey(o.asset_id, o.scale, o.tilt_quat_xyzw))
    return [keys[index] for index in range(len(keys))]


def _most(scenes: Sequence[Scene]) -> int:
    return max((len(scene.objects) for scene in scenes), default=1)


def _used(scenes: Sequence[Scene]) -> set[str]:
    return {o.asset_id for scene in scenes for o in scene.objects if o.asset_id is not None}


def _joined(parts: Sequence[LayoutBatch]) -> LayoutBatch:
    names = [f.name for f in fields(LayoutBatch) if f.name != "features"]
    if not parts:
        return _joined([LayoutBatch.from_scenes([], ShapeCollector(AssetStore(_NoAssets())), num_slots=1)])
    return LayoutBatch(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


class _NoAssets:
    def asset_path(self, asset_id: str) -> Path | None:
        return None


def _texts(values: set[str]) -> Any:
    return pa.array(sorted(values), pa.string())


def _rows(run: RunFolder, table: str, columns: list[str] | None, assets: set[str]) -> Iterator[Mapping[str, Any]]:
    """Rows of some assets, a slice of a file at a time."""
    files = TableFiles(run.uri, table, columns)
    for group in range(len(files.groups)):
        rows = files.read([group])
        for part in row_slices(rows.filter(pc.is_in(rows["asset_id"], value_set=_texts(assets)))):
            yield from rows_from_table(part)


def _grids(run: RunFolder, assets: set[str]) -> dict[GridKey, SdfGrid]:
    return grids_from_rows(_rows(run, "sdf", None, assets))


def _points(run: RunFolder) -> dict[str, FloatArray]:
    table = run.table("assets", ["asset_id", "points"])
    return {row["asset_id"]: row["points"].reshape(-1, 3).astype(np.float64) for row in rows_from_table(table)}


def _write(path: Path, made: TrainingSet, keys: Sequence[ShapeKey]) -> None:
    """Keeps a training set without its features, in one step."""
    tensors = {f"batch.{f.name}": getattr(made.batch, f.name) for f in fields(LayoutBatch) if f.name != "features"}
    tensors |= {f"geometry.{name}": getattr(made.geometry, name) for name in ShapeTensors.__slots__ if name != "atlas"}
    tensors |= {f"atlas.{name}": getattr(made.geometry.atlas, name) for name in SdfAtlas.__slots__}
    tensors |= {"stage": made.stage, "split": made.split}
    about: dict[str, Any] = {"scene_ids": made.scene_ids, "counts": dict(made.counts), "fingerprint": made.fingerprint}
    about["keys"] = [(key.asset_id, key.scale, key.tilt_quat_xyzw) for key in keys]
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}")
    save_file({name: value.contiguous() for name, value in tensors.items()}, aside, {"about": json.dumps(about)})
    aside.replace(path)


def _read(path: Path) -> tuple[TrainingSet, list[ShapeKey]] | None:
    """What was kept, or None where nothing was that can be read."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()["about"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (OSError, SafetensorError):
        return None
    batch = LayoutBatch(**{f.name: tensors[f"batch.{f.name}"] for f in fields(LayoutBatch) if f.name != "features"})
    atlas = SdfAtlas(*(tensors[f"atlas.{name}"] for name in SdfAtlas.__slots__))
    parts = {name: tensors[f"geometry.{name}"] for name in ShapeTensors.__slots__ if name != "atlas"}
    keys = [ShapeKey(asset_id, tuple(scale), tuple(tilt)) for asset_id, scale, tilt in about["keys"]]
    made = TrainingSet(
        batch,
        ShapeTensors(atlas=atlas, **parts),
        tensors["stage"],
        tensors["split"],
        tuple(about["scene_ids"]),
        about["counts"],
        about["fingerprint"],
    )
    return made, keys


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())
