"""The scenes of a training of the corrector as tensors, and their file in a cache."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from models.physics_corrector.geometry.scene_batch import LayoutBatch
from models.physics_corrector.geometry.sdf_atlas import SdfAtlas
from models.physics_corrector.geometry.shape_tensors import ShapeTensors
from stable_data.scene import QuatXyzw, Vec3

TENSORS = tuple(f.name for f in fields(LayoutBatch) if f.default is MISSING)
"""The tensors that every batch has."""


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
    """Clean scenes, of all splits, and corrected proposals.

    Attributes:
        batch: The scenes with their clean poses, without features and texts; :meth:`take` adds these. Corrected proposals, which
            have no stages, come last.
        geometry: Their shapes.
        stage: Index of each object's stage, -1 if it has none, (B, N) int64.
        words: Index of each object's category among the texts, and last that of the table's kind, (B, N + 1) int64; -1 in padding.
        split: ``train`` 0, ``validation`` 1, others 2, (B,) int64.
        scene_ids: The ids of the B scenes, of which proposals may share one.
        counts: Numbers of scenes that were read, used and left out, by reason.
        fingerprint: Fingerprint of the content of the runs.
        texts: The categories of objects and the kinds of tables, in plain words.
        encoder: Fingerprint of the encoder of the features; empty without features.
        text_encoder: Fingerprint of the encoder of the texts; empty without text features.
        features: Point features of the shapes, (S, F) float32; None without features.
        text_features: Text features of ``texts``, (T, D) float32; None without them.
        coarse: The proposed poses of the last P scenes, (P, N, 4) float32; None without proposals.
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
    coarse: Tensor | None = None

    def take(self, scenes: Tensor) -> LayoutBatch:
        """Selects scenes by index (S,) int64, with the features of their shapes and texts."""
        batch = self.batch.take(scenes)
        if self.features is not None:
            batch = replace(batch, features=self.features[batch.shape_index])
        if self.text_features is not None:
            found = torch.where((self.words[scenes] >= 0)[..., None], self.text_features[self.words[scenes].clamp_min(0)], 0)
            batch = replace(batch, texts=found[:, :-1], table_text=found[:, -1])
        if self.coarse is not None:
            number = scenes - self.num_scenes
            proposed = torch.where((number >= 0)[:, None, None], self.coarse[number.clamp_min(0)], torch.nan)
            batch = replace(batch, coarse=proposed)
        return batch

    @property
    def num_scenes(self) -> int:
        """Number of scenes that are no proposals; they come first."""
        return len(self.batch) - (0 if self.coarse is None else len(self.coarse))

    def of_split(self, split: int) -> Tensor:
        """Indices of the scenes of a split, (S,) int64; not those of proposals."""
        return (self.split[: self.num_scenes] == split).nonzero()[:, 0]

    def proposals_of_split(self, split: int) -> Tensor:
        """Indices of the proposals of a split, (S,) int64."""
        return self.num_scenes + (self.split[self.num_scenes :] == split).nonzero()[:, 0]

    def to(self, device: torch.device | str) -> "TrainingSet":
        """Copies scenes, shapes and stages to a device."""
        moved = {name: getattr(self, name).to(device) for name in ("batch", "geometry", "stage", "words")}
        others = {name: getattr(self, name) for name in ("features", "text_features", "coarse")}
        return replace(self, **moved, **{name: f.to(device) for name, f in others.items() if f is not None})


def write_cache(path: Path, data: TrainingSet, keys: Sequence[ShapeKey]) -> None:
    """Writes a training set without its features atomically."""
    tensors = {f"batch.{name}": getattr(data.batch, name) for name in TENSORS}
    tensors |= {f"geometry.{name}": getattr(data.geometry, name) for name in ShapeTensors.__slots__ if name != "atlas"}
    tensors |= {f"atlas.{name}": getattr(data.geometry.atlas, name) for name in SdfAtlas.__slots__}
    tensors |= {name: getattr(data, name) for name in ("stage", "words", "split")}
    if data.coarse is not None:
        tensors["coarse"] = data.coarse
    about: dict[str, Any] = {name: getattr(data, name) for name in ("scene_ids", "fingerprint", "texts")}
    about["counts"] = dict(data.counts)
    about["keys"] = [(key.asset_id, key.scale, key.tilt_quat_xyzw) for key in keys]
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}")
    save_file({name: value.contiguous() for name, value in tensors.items()}, aside, {"about": json.dumps(about)})
    aside.replace(path)


def read_cache(path: Path) -> tuple[TrainingSet, list[ShapeKey]] | None:
    """Reads a training set; None if the file is missing or damaged."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()["about"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        return _training_set(tensors, about)
    except (OSError, SafetensorError, AttributeError, LookupError, RecursionError, TypeError, ValueError):
        return None  # also a file of others, which has tensors and notes of another form


def _training_set(tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> tuple[TrainingSet, list[ShapeKey]]:
    """A training set of what :func:`write_cache` wrote.

    Raises:
        AttributeError, LookupError, TypeError, ValueError: A tensor or a note is missing or has another form.
    """
    batch = LayoutBatch(**{name: tensors[f"batch.{name}"] for name in TENSORS})
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
        coarse=tensors.get("coarse"),
    )
    return data, keys
