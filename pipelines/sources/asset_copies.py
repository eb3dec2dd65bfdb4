"""Copies the assets of scenes into their run, which can then be loaded and exported without the libraries.

The rows of a library that is a run are copied, except for the columns that say how the scenes use an asset, and for the text
embedding, because those of several libraries would mix. What a row lacks, and all rows of other libraries, are computed.
"""

from collections import defaultdict
from collections.abc import Container, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import ClassVar

import pyarrow.compute as pc

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import NOT_OF_AN_ITEM, ItemStep, Rows, Shard
from pipelines.preprocess.asset import AssetSettings, AssetUse, preprocess_asset, use_columns
from pipelines.preprocess.plan import file_digest
from pipelines.sources.assets import AssetLibraries
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.errors import Notice
from stable_data.mesatask.asset_uses import AssetUseCount
from stable_data.scene import UPRIGHT
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import notice_row

_PER_SHARD = 16
_NEEDED = ("report", "points", "normals")  # columns that a row needs to be copied


@dataclass(frozen=True, slots=True)
class CopyAssets(ItemStep[AssetUse]):
    """Copies the rows of assets; sent to the workers.

    Attributes:
        places: The asset libraries, see :class:`~pipelines.sources.assets.AssetLibraries`.
        fingerprint: Hash of the libraries.
        seconds: Time limit of an asset.
        scenes: A source of scenes whose own library is the first, or None.
        decomposes: Whether meshes that come without convex parts are decomposed.
    """

    TABLES: ClassVar = ("warnings", "failures", "textures", "meshes", "assets")
    UNIT: ClassVar = "asset"
    OF_THE_RUN: ClassVar = NOT_OF_AN_ITEM

    places: tuple[str, ...]
    fingerprint: str
    seconds: float
    scenes: str | None = None
    decomposes: bool = True

    @property
    def seconds_per_item(self) -> float:
        """The time limit of an asset, seconds."""
        return self.seconds

    def item_id(self, item: AssetUse) -> str:
        """The asset's id."""
        return item.asset_id

    def prepare(self, item: AssetUse) -> None:
        """Opens the libraries."""
        _opened(self)

    def item_rows(self, item: AssetUse, progress: ItemProgress) -> Rows:
        """The rows of one asset; none if its mesh cannot be used, as the warnings of its scenes say."""
        progress.step = "mesh"
        shelf, store = _opened(self)
        if store.fault_of(item.asset_id) is not None:
            return {}
        asset, mesh = shelf.rows(item.asset_id) or ({}, {})
        has_asset = all(asset.get(name) is not None for name in _NEEDED)
        has_mesh = bool(mesh.get("parts")) or (bool(mesh) and not self.decomposes)
        notices: tuple[Notice, ...] = ()
        textures = list(shelf.textures(item.asset_id))
        if not (has_asset and has_mesh):
            path, settings = shelf.asset_path(item.asset_id), AssetSettings(decomposes=self.decomposes)
            if path is not None:
                item = replace(item, mesh_sha256=file_digest(path))
            made = preprocess_asset(item, shelf.annotation(item.asset_id), store, settings, progress)
            notices, textures = made.notices, textures or list(made.textures)
            asset = asset if has_asset else made.asset
            if not has_mesh:  # what cannot be computed, such as a look, is that of the row
                mesh = made.mesh | {name: value for name, value in mesh.items() if made.mesh[name] is None}
        if has_asset:
            used = use_columns(item, store.asset(item.asset_id))
            if store.physics(item.asset_id) is not None:  # a known mass, centre and inertia hold at the scale of the row
                used = {"resting_tilts": used["resting_tilts"]}
            asset = asset | {"text_embedding": None} | used
        notices += store.look(item.asset_id)[1]
        return {"assets": [asset], "meshes": [mesh], "textures": textures, "warnings": [notice_row(n) for n in notices]}


@lru_cache(maxsize=1)
def _opened(work: CopyAssets) -> tuple[AssetLibraries, AssetStore]:
    shelf = AssetLibraries(work.places, scenes=work.scenes)
    return shelf, AssetStore(shelf)


def asset_shards(run: RunFolder, names: Sequence[str], fingerprint: str, without: Container[str] = ()) -> list[Shard[AssetUse]]:
    """The assets that the scenes of a run use, in shards. If there are none, there is one empty shard, so that the tables exist.

    Args:
        run: The run.
        names: Its tables of scenes.
        fingerprint: Hash of the libraries.
        without: Ids of assets that are not copied.
    """
    uses: dict[str, AssetUseCount] = defaultdict(AssetUseCount)
    for name in names:
        for batch in run.batches(name, ["objects", "surface"]):
            for asset_id in pc.struct_field(batch["surface"], "asset_id").to_pylist():
                if asset_id is not None and asset_id not in without:
                    uses[asset_id].add((1.0, 1.0, 1.0), UPRIGHT)
            objects = pc.list_flatten(batch["objects"])
            columns = [pc.struct_field(objects, key).to_pylist() for key in ("asset_id", "scale", "tilt_quat_xyzw")]
            for asset_id, scale, tilt in zip(*columns, strict=True):
                if asset_id is not None and asset_id not in without:
                    uses[asset_id].add(None if scale is None else tuple(scale), tuple(tilt))
    # No signed-distance grids: only training needs them, and it computes its own.
    found = [AssetUse(a, "", use.typical_scale(), (), tuple(use.most_tilts())) for a, use in sorted(uses.items())]
    parts: list[Sequence[AssetUse]] = [*split_groups(found, _PER_SHARD)] or [()]
    return [Shard(content_id("carry", fingerprint, [asdict(use) for use in part]), tuple(part)) for part in parts]
