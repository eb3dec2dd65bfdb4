"""Catalogues of assets for retrieval: category, size, resting tilts, and text embedding of each asset.

A catalogue is read from the tables of a preprocess run, or from a folder in the MesaTask-10K format. It contains no meshes, and
the caller passes the text encoder.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.assets.text_bounds import TextBounds
from stable_data.assets.text_embeddings import Rows, TextEncoder, check_rows, embed_texts
from stable_data.errors import ConfigError
from stable_data.geometry.leaning import CATALOGUE_ANGLES, SLENDER_ASSET, leaning_tilt
from stable_data.rotations import normalise_quat, quat_product, rotation_matrix, stand_on_end
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Vec3
from stable_data.storage.row_groups import rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row

_SAME_TILT = math.radians(5.0)  # tilts that differ by at most this are counted as one
_RIGHT_ANGLE = 1e-6
_STEEP = math.radians(45.0)  # a long asset whose axis is closer to vertical than this has been seen standing
_ROWS = 4096  # of a table that are Python objects at a time
_TURNS = 4096  # turns that are remembered, since most assets rest in one of few
_COLUMNS = (
    "asset_id",
    "category",
    "description",
    "caption",
    "licence",
    "source",
    "extents",
    "resting_tilts",
    "on_table",
    "mark_deletion",
    "is_composite",
    "is_container",
    "size_low",
    "size_high",
)


def asset_sentence(words: str, category: str) -> str:
    """Returns the sentence to encode: the category, if it is known, then the words, for queries and assets alike.

    Example:
        >>> asset_sentence("a slim one with a red cap", "water_bottle")
        'water bottle, a slim one with a red cap'
    """
    return ", ".join(part for part in (category.replace("_", " ").strip(), words.strip()) if part)


@dataclass(frozen=True, slots=True)
class RestingTilt:
    """A tilt in which an asset rests.

    Attributes:
        quat_xyzw: Rotation before yaw, unit.
        extents: Box of the tilted mesh in the yaw frame, mesh units.
        count: Number of objects with this tilt; 0 if the tilt is only assumed.
    """

    quat_xyzw: QuatXyzw
    extents: Vec3
    count: int = 0


@dataclass(frozen=True, slots=True)
class Asset:
    """One entry of a catalogue.

    Attributes:
        asset_id: Identifier of the asset.
        category: Category; empty if unknown.
        description: Short description.
        caption: Description in a sentence.
        licence: Licence, or None if unknown.
        source: Origin of the asset.
        extents: Box of the mesh, mesh units, z up.
        tilts: Resting tilts, most frequent first; tilts within five degrees of a more frequent one are counted as that one. The
            last ones, for a long asset that was only seen lying, are assumed tilts of leaning in a cup.
        on_table: Whether the asset belongs on a table.
        mark_deletion: Whether the annotators marked it for deletion.
        is_composite: Whether the mesh contains several objects.
        is_container: Whether other things can be in it; None if unknown.
        size_range: Smallest and largest length that the longest side of the mesh's box may have in a scene, metres; equal if the
            size is exact. None: any size.
    """

    asset_id: str
    category: str
    description: str
    extents: Vec3
    tilts: tuple[RestingTilt, ...]
    caption: str = ""
    licence: str | None = None
    source: str = ""
    on_table: bool = True
    mark_deletion: bool = False
    is_composite: bool = False
    is_container: bool | None = None
    size_range: tuple[float, float] | None = None

    @property
    def words(self) -> str:
        """The text for retrieval: the description, else the caption, else the category."""
        return self.description.strip() or self.caption.strip() or self.category.replace("_", " ").strip()

    @property
    def is_offered(self) -> bool:
        """Whether its annotations allow its use on a table."""
        return self.on_table and not self.mark_deletion and not self.is_composite


@dataclass(frozen=True, eq=False)
class AssetLibrary:
    """A catalogue.

    Attributes:
        name: Name of the library in matches and errors.
        assets: N assets, sorted by identifier.
        features: Unit rows of the words, (N, D) float32, or None if they are not encoded yet.
        encoder_fingerprint: Fingerprint of the encoder of the features; empty if the dataset does not state it.
        names_category: Whether the features are those of :func:`asset_sentence`, or of the words alone, as in a dataset.
        left_out: Asset id -> why an asset of the dataset cannot be retrieved.

    Raises:
        ConfigError: ``library_empty``, ``asset_duplicate`` or ``features_invalid``.
    """

    name: str
    assets: tuple[Asset, ...]
    features: Rows | None = None
    encoder_fingerprint: str = ""
    names_category: bool = False
    left_out: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks that there are assets, that they are unique, and the features."""
        if not self.assets:
            reasons = ", ".join(f"{n} {why}" for why, n in Counter(self.left_out.values()).most_common()) or "no assets"
            raise ConfigError(f"library {self.name}: {reasons}, expected assets with words and extents", "library_empty")
        twice = [uid for uid, n in Counter(a.asset_id for a in self.assets).items() if n > 1]
        if twice:
            message = f"library {self.name}: asset {twice[0]} is listed twice, expected one entry per uid"
            raise ConfigError(f"{message}; was it preprocessed twice into one folder?", "asset_duplicate")
        if self.features is not None:
            object.__setattr__(self, "features", check_rows(self.features, len(self.assets), f"library {self.name}"))

    def __len__(self) -> int:
        """Number of assets."""
        return len(self.assets)

    @cached_property
    def text_bounds(self) -> TextBounds:
        """Bounds of text scores by the features, which must be there."""
        assert self.features is not None
        return TextBounds(self.features)

    def only(self, asset_ids: Collection[str]) -> "AssetLibrary":
        """Returns the library with some of its assets, at least one."""
        kept = [k for k, asset in enumerate(self.assets) if asset.asset_id in asset_ids]
        if len(kept) == len(self.assets):
            return self
        rows = None if self.features is None else self.features[kept]
        return replace(self, assets=tuple(self.assets[k] for k in kept), features=rows)

    def embedded(self, encoder: TextEncoder, cache: Path | None = None) -> "AssetLibrary":
        """Returns the library with the features of an encoder: those that it has, if they are of this encoder, else new ones.

        Args:
            encoder: The text encoder.
            cache: A cache file of features, see :func:`stable_data.assets.text_embeddings.embed_texts`.
        """
        if self.features is not None and self.names_category and self.encoder_fingerprint == encoder.fingerprint:
            return self
        rows = embed_texts([asset_sentence(a.words, a.category) for a in self.assets], encoder, cache)
        return replace(self, features=rows, encoder_fingerprint=encoder.fingerprint, names_category=True)


def library_of_run(run: RunFolder, name: str | None = None, *, own_features: bool = False) -> AssetLibrary:
    """Reads the catalogue of a preprocess run, local or in an object store.

    If the run does not state whether an asset belongs on a table, it does if a scene contains it. The resting tilt of an asset
    that no scene contains is upright. If the run stores the features of all assets' sentences, the library has them.

    Args:
        run: The run folder.
        name: Name of the library; by default the address of the run.
        own_features: Whether to use the text features of the dataset. Otherwise call :meth:`AssetLibrary.embedded`, which encodes
            the sentences if the run does not store their features of the same encoder.

    Raises:
        ConfigError: The table ``assets`` is missing, cannot be read, or contains no usable asset.
    """
    name = name or run.uri
    table = run.table("assets", [*_COLUMNS, "text_embedding"] if own_features else _COLUMNS)
    assets, features, left_out = list[Asset](), dict[str, Any](), dict[str, str]()
    slanted = dict[str, Sequence[tuple[QuatXyzw, int]]]()
    for batch in table.to_batches(_ROWS):  # few rows at a time, because as Python objects they need much more memory
        for row in batch.to_pylist():
            uid = row["asset_id"]
            try:
                extents = as_vec3(row["extents"])
                seen = [(_quat(tuple(t["tilt_quat_xyzw"])), int(t["count"])) for t in row["resting_tilts"]]
            except (TypeError, ValueError):  # a null, or a list of another length
                left_out[str(uid)] = "without extent or resting tilts"
                continue
            tilts = add_leaning_tilts(merge_similar_tilts(seen), extents)
            if any(not is_right_angled(quat) for quat, _ in tilts):
                slanted[uid] = tilts
            assets.append(_asset_of_row(row, extents, resting_tilts(tilts, extents, None)))
            if own_features and row["text_embedding"] is not None:
                features[uid] = row["text_embedding"]
    boxes = _slanted_tilts(run, slanted, {asset.asset_id: asset.extents for asset in assets})
    assets = [replace(a, tilts=boxes[a.asset_id]) if a.asset_id in boxes else a for a in assets]
    library = build_library(name, assets, features if own_features else None, left_out)
    library = library if own_features else _with_stored_features(library, run)
    del table
    pa.default_memory_pool().release_unused()  # of a large table this is much more than what the library needs
    return library


def _asset_of_row(row: Row, extents: Vec3, tilts: tuple[RestingTilt, ...]) -> Asset:
    return Asset(
        row["asset_id"],
        row["category"] or "",
        row["description"] or "",
        extents,
        tilts,
        caption=row["caption"] or "",
        licence=row["licence"],
        source=row["source"] or "",
        on_table=bool(row["resting_tilts"]) if row["on_table"] is None else row["on_table"],
        mark_deletion=row["mark_deletion"] is True,
        is_composite=row["is_composite"] is True,
        is_container=row["is_container"],
        size_range=_size_range(row["size_low"], row["size_high"]),
    )


def _size_range(low: float | None, high: float | None) -> tuple[float, float] | None:
    return None if low is None or high is None else (low, high)


def _with_stored_features(library: AssetLibrary, run: RunFolder) -> AssetLibrary:
    """Returns a library with the features that its run stores, if it has those of one encoder for all assets."""
    table = run.table("assets", ["asset_id", "sentence_embedding", "sentence_encoder"])
    place = {asset_id: k for k, asset_id in enumerate(table["asset_id"].to_pylist())}
    table = table.take([place[asset.asset_id] for asset in library.assets])
    encoders = table["sentence_encoder"].unique().to_pylist()
    if len(encoders) != 1 or not encoders[0] or table["sentence_embedding"].null_count:
        return library
    found = table["sentence_embedding"].combine_chunks()
    values, num = found.flatten().to_numpy(zero_copy_only=False), len(library)
    if not len(values) or len(values) % num or not (np.diff(found.offsets.to_numpy()) == len(values) // num).all():
        lengths = f"{len(values)} numbers for {num} assets"
        message = f"library {library.name}: column sentence_embedding has {lengths}, expected rows of one length"
        raise ConfigError(f"{message}; import the assets again", "features_invalid")
    rows = values.reshape(num, -1).astype(np.float32)  # of unit length to the precision of float16
    rows /= np.maximum(np.sqrt(np.einsum("nd,nd->n", rows, rows)), np.finfo(np.float32).tiny)[:, None]
    return replace(library, features=rows, encoder_fingerprint=encoders[0], names_category=True)


def build_library(
    name: str, assets: Sequence[Asset], features: Mapping[str, Any] | None, left_out: dict[str, str]
) -> AssetLibrary:
    """Makes a library of the assets that can be retrieved, sorted by identifier; adds the others to ``left_out``."""
    usable = []
    for asset in sorted(assets, key=lambda a: a.asset_id):
        why = ""
        if not asset.words:
            why = "without words"
        elif not all(map(math.isfinite, asset.extents)) or max(asset.extents) <= 0:
            why = "without extent"
        elif asset.size_range is not None and not 0 < asset.size_range[0] <= asset.size_range[1] < math.inf:
            why = "with a size range that is not positive and in order"
        elif features is not None and asset.asset_id not in features:
            why = "without a text feature"
        if why:
            left_out[asset.asset_id] = why
        else:
            usable.append(asset)
    rows = np.array([features[a.asset_id] for a in usable], np.float32) if features is not None and usable else None
    return AssetLibrary(name, tuple(usable), rows, left_out=left_out)


def merge_similar_tilts(tilts: Iterable[tuple[QuatXyzw, int]]) -> list[tuple[QuatXyzw, int]]:
    """Sorts tilts, most frequent first, and counts a tilt close to a more frequent one as that one."""
    merged: list[tuple[QuatXyzw, int]] = []
    for quat, count in sorted(tilts, key=lambda item: (-item[1], item[0])):
        for k, (other, total) in enumerate(merged):
            if 2 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(quat, other, strict=True))))) <= _SAME_TILT:
                merged[k] = (other, total + count)
                break
        else:
            merged.append((quat, count))
    return sorted(merged, key=lambda item: (-item[1], item[0]))


def add_leaning_tilts(tilts: Sequence[tuple[QuatXyzw, int]], extents: Vec3) -> list[tuple[QuatXyzw, int]]:
    """Adds tilts of leaning in a cup, with the top towards -y, for a long asset that was only seen lying."""
    axis = int(np.argmax(extents))
    is_long = extents[axis] > SLENDER_ASSET * sorted(extents)[1]
    if not tilts or not is_long or any(abs(_turn(q)[2, axis]) > math.cos(_STEEP) for q, _ in tilts):
        return list(tilts)
    return [*tilts, *_leaning(axis)]


def resting_tilts(tilts: Sequence[tuple[QuatXyzw, int]], extents: Vec3, points: FloatArray | None) -> tuple[RestingTilt, ...]:
    """Returns the tilts with their boxes, or the upright one if no tilt is known."""
    if not tilts:
        return (RestingTilt(UPRIGHT, extents),)
    return tuple(RestingTilt(quat, _tilted_extents(quat, extents, points), count) for quat, count in tilts)


def _tilted_extents(quat: QuatXyzw, extents: Vec3, points: FloatArray | None) -> Vec3:
    """Computes the box of a tilted mesh: exact for right angles, close for surface points, else the box of its tilted box."""
    if points is None or is_right_angled(quat):
        return extents if quat == UPRIGHT else as_vec3(np.abs(_turn(quat)) @ np.asarray(extents))
    reach = np.ptp(points, axis=0)
    # Sampled surface points miss the corners, so they are stretched to the exact box of the mesh.
    stretched = points * np.divide(extents, reach, out=np.ones(3), where=reach > 0)
    return as_vec3(np.ptp(stretched @ _turn(quat).T, axis=0))


@lru_cache(maxsize=_TURNS)
def is_right_angled(quat: QuatXyzw) -> bool:
    """Whether a rotation maps each axis to an axis."""
    return bool((np.abs(_turn(quat)).max(axis=0) > 1 - _RIGHT_ANGLE).all())


def _slanted_tilts(
    run: RunFolder, tilts: Mapping[str, Sequence[tuple[QuatXyzw, int]]], extents: Mapping[str, Vec3]
) -> dict[str, tuple[RestingTilt, ...]]:
    """Returns the tilts of some assets with their boxes by their surface points; an asset whose row has no points is left out."""
    found: dict[str, tuple[RestingTilt, ...]] = {}
    if not tilts:
        return found
    for batch in run.batches("assets", ["asset_id", "points"], pc.field("asset_id").isin(list(tilts))):
        for row in rows_from_table(pa.Table.from_batches([batch])):
            if row["points"] is not None:
                uid, points = row["asset_id"], np.asarray(row["points"], np.float64).reshape(-1, 3)
                found[uid] = resting_tilts(tilts[uid], extents[uid], points)
    return found


@lru_cache(maxsize=_TURNS)
def _quat(values: tuple[float, ...]) -> QuatXyzw:
    x, y, z, w = values
    return normalise_quat((x, y, z, w))


@lru_cache(maxsize=_TURNS)
def _turn(quat: QuatXyzw) -> FloatArray:
    return rotation_matrix(quat)


@cache
def _leaning(axis: int) -> tuple[tuple[QuatXyzw, int], ...]:
    return tuple((quat_product(leaning_tilt(angle), stand_on_end(axis)), 0) for angle in CATALOGUE_ANGLES)


def as_vec3(values: Any) -> Vec3:
    """Converts three numbers to a tuple of floats."""
    x, y, z = (float(v) for v in values)
    return (x, y, z)
