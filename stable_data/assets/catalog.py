"""Catalogues of assets to choose from: what each is, how large, how it rests, and the row that its words have.

A catalogue is read from the tables of a preprocess run, or from a folder in the MesaTask-10K format. It is light: no mesh is
kept, and the text encoder is whatever the caller hands in.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc

from stable_data.assets.text_embeddings import Rows, TextEncoder, check_rows, embed_texts
from stable_data.errors import ConfigError
from stable_data.geometry.leaning import CATALOGUE_ANGLES, SLENDER_ASSET, leaning_tilt
from stable_data.rotations import normalise_quat, quat_product, rotated_extents, rotation_matrix, stand_on_end
from stable_data.scene import UPRIGHT, FloatArray, QuatXyzw, Vec3
from stable_data.storage.row_groups import rows_from_table
from stable_data.storage.run_folder import RunFolder

_SAME_TILT = math.radians(5.0)
_RIGHT_ANGLE = 1e-6
_STEEP = math.radians(45.0)
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
)


def asset_sentence(words: str, category: str) -> str:
    """What is encoded of a thing: its kind, then its words, so that a kind that is known is heard on both sides.

    Example:
        >>> sentence("a slim one with a red cap", "water_bottle")
        'water bottle, a slim one with a red cap'
    """
    return ", ".join(part for part in (category.replace("_", " ").strip(), words.strip()) if part)


@dataclass(frozen=True, slots=True)
class RestingTilt:
    """A way in which an asset lies still.

    Attributes:
        quat_xyzw: Rotation before yaw, unit.
        extents: Box of the tilted mesh in the yaw frame, mesh units.
        count: How often it was seen; 0 where it is only assumed.
    """

    quat_xyzw: QuatXyzw
    extents: Vec3
    count: int = 0


@dataclass(frozen=True, slots=True)
class Asset:
    """One entry of a catalogue.

    Attributes:
        asset_id: Its uid.
        category: Its kind; empty where unknown.
        description: A few words for it.
        caption: A sentence about it.
        licence: As stated, or None: unknown.
        source: Where it comes from.
        extents: Box of the mesh, mesh units, z up.
        tilts: How it usually rests, most frequent first; tilts within five degrees of a more frequent one are that one. Last
            come those at which a long thing that was only seen lying would lean in a cup.
        on_table: Whether it belongs on a table.
        mark_deletion: Whether the annotators wanted it removed.
        is_composite: Whether it is several things in one mesh.
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

    @property
    def words(self) -> str:
        """What it is found by: its description, else its caption, else its category."""
        return self.description.strip() or self.caption.strip() or self.category.replace("_", " ").strip()

    @property
    def is_offered(self) -> bool:
        """Whether its annotations let it be put on a table."""
        return self.on_table and not self.mark_deletion and not self.is_composite


@dataclass(frozen=True, eq=False)
class AssetLibrary:
    """A catalogue.

    Attributes:
        name: What matches and errors call it.
        assets: N assets, by uid.
        features: Unit row of each one's words, (N, D) float32, or None: not encoded yet.
        encoder_fingerprint: Which encoder made them; empty where the dataset does not say.
        names_category: Whether they are of :func:`asset_sentence`, or of the words alone, as a dataset's own.
        left_out: uid -> why an asset of the dataset cannot be retrieved at all.

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
        """Refuses a library that nothing can be found in."""
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

    def embedded(self, encoder: TextEncoder, cache: Path | None = None) -> "AssetLibrary":
        """The library with its words encoded.

        Args:
            encoder: The text encoder.
            cache: A file that keeps the rows, see :func:`stable_data.assets.text_embeddings.embed_texts`.
        """
        rows = embed_texts([asset_sentence(a.words, a.category) for a in self.assets], encoder, cache)
        return replace(self, features=rows, encoder_fingerprint=encoder.fingerprint, names_category=True)


def library_of_run(run: RunFolder, name: str | None = None, *, own_features: bool = False) -> AssetLibrary:
    """The catalogue of a preprocess run, local or in an object store.

    Where the run does not say whether an asset belongs on a table, it does if a scene has it there. An asset that no scene uses
    stands as it is.

    Args:
        run: The run folder.
        name: What to call the library; by default the run's address.
        own_features: Take the text features that came with the dataset. Otherwise call :meth:`AssetLibrary.embedded`.

    Raises:
        ConfigError: The table ``assets`` is missing, cannot be read, or holds nothing that can be used.
    """
    name = name or run.uri
    rows = run.table("assets", [*_COLUMNS, "text_embedding"] if own_features else _COLUMNS).to_pylist()
    usual = {
        row["asset_id"]: add_leaning_tilts(
            merge_similar_tilts([(_quat(t["tilt_quat_xyzw"]), t["count"]) for t in row["resting_tilts"]]),
            as_vec3(row["extents"]),
        )
        for row in rows
    }
    leaning = [uid for uid, tilts in usual.items() if any(not is_right_angled(quat) for quat, _ in tilts)]
    points = _surface_points(run, leaning)
    assets, features = list[Asset](), dict[str, Any]()
    for row in rows:
        uid, extents = row["asset_id"], as_vec3(row["extents"])
        on_table = bool(row["resting_tilts"]) if row["on_table"] is None else row["on_table"]
        asset = Asset(
            uid,
            row["category"] or "",
            row["description"] or "",
            extents,
            resting_tilts(usual[uid], extents, points.get(uid)),
            caption=row["caption"] or "",
            licence=row["licence"],
            source=row["source"] or "",
            on_table=on_table,
            mark_deletion=row["mark_deletion"] is True,
            is_composite=row["is_composite"] is True,
        )
        assets.append(asset)
        if own_features and row["text_embedding"] is not None:
            features[uid] = row["text_embedding"]
    return build_library(name, assets, features if own_features else None, {})


def build_library(
    name: str, assets: Sequence[Asset], features: Mapping[str, Any] | None, left_out: dict[str, str]
) -> AssetLibrary:
    """The assets that can be found, by uid."""
    kept = []
    for asset in sorted(assets, key=lambda a: a.asset_id):
        why = ""
        if not asset.words:
            why = "without words"
        elif not all(map(math.isfinite, asset.extents)) or max(asset.extents) <= 0:
            why = "without extent"
        elif features is not None and asset.asset_id not in features:
            why = "without a text feature"
        if why:
            left_out[asset.asset_id] = why
        else:
            kept.append(asset)
    rows = np.array([features[a.asset_id] for a in kept], np.float32) if features is not None and kept else None
    return AssetLibrary(name, tuple(kept), rows, left_out=left_out)


def merge_similar_tilts(tilts: Iterable[tuple[QuatXyzw, int]]) -> list[tuple[QuatXyzw, int]]:
    """Tilts, most frequent first; those close to a more frequent one are counted as that one."""
    kept: list[tuple[QuatXyzw, int]] = []
    for quat, count in sorted(tilts, key=lambda item: (-item[1], item[0])):
        for k, (other, total) in enumerate(kept):
            if 2 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(quat, other, strict=True))))) <= _SAME_TILT:
                kept[k] = (other, total + count)
                break
        else:
            kept.append((quat, count))
    return sorted(kept, key=lambda item: (-item[1], item[0]))


def add_leaning_tilts(tilts: Sequence[tuple[QuatXyzw, int]], extents: Vec3) -> list[tuple[QuatXyzw, int]]:
    """Tilts with those at which a long thing that was only seen lying leans in a cup, its top towards -y."""
    axis = int(np.argmax(extents))
    is_long = extents[axis] > SLENDER_ASSET * sorted(extents)[1]
    if not tilts or not is_long or any(abs(rotation_matrix(q)[2, axis]) > math.cos(_STEEP) for q, _ in tilts):
        return list(tilts)
    leaning = [(quat_product(leaning_tilt(angle), stand_on_end(axis)), 0) for angle in CATALOGUE_ANGLES]
    return [*tilts, *leaning]


def resting_tilts(tilts: Sequence[tuple[QuatXyzw, int]], extents: Vec3, points: FloatArray | None) -> tuple[RestingTilt, ...]:
    """The tilts with their boxes; upright where none is known."""
    if not tilts:
        return (RestingTilt(UPRIGHT, extents),)
    return tuple(RestingTilt(quat, _tilted_extents(quat, extents, points), count) for quat, count in tilts)


def _tilted_extents(quat: QuatXyzw, extents: Vec3, points: FloatArray | None) -> Vec3:
    """Box of a tilted mesh: exact for right angles and for vertices, close for surface points, else that of its turned box."""
    if points is None or is_right_angled(quat):
        return rotated_extents(extents, quat)
    reach = np.ptp(points, axis=0)
    # Points on a surface miss its corners: they are stretched to the box that is known exactly.
    stretched = points * np.divide(extents, reach, out=np.ones(3), where=reach > 0)
    return as_vec3(np.ptp(stretched @ rotation_matrix(quat).T, axis=0))


def is_right_angled(quat: QuatXyzw) -> bool:
    """Whether a rotation takes each axis to an axis."""
    return bool((np.abs(rotation_matrix(quat)).max(axis=0) > 1 - _RIGHT_ANGLE).all())


def _surface_points(run: RunFolder, asset_ids: Sequence[str]) -> dict[str, FloatArray]:
    """Surface points of some assets, (P, 3) each, mesh units."""
    if not asset_ids:
        return {}
    table = run.table("assets", ["asset_id", "points"], pc.field("asset_id").isin(list(asset_ids)))
    return {row["asset_id"]: np.asarray(row["points"], np.float64).reshape(-1, 3) for row in rows_from_table(table)}


def _quat(values: Sequence[float]) -> QuatXyzw:
    x, y, z, w = values
    return normalise_quat((x, y, z, w))


def as_vec3(values: Any) -> Vec3:
    """Three numbers as a tuple of floats."""
    x, y, z = (float(v) for v in values)
    return (x, y, z)
