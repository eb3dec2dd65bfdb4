"""The assets that generated scenes use, carried into their run: it is looked at, loaded and exported without the libraries."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from typing import ClassVar

import pyarrow.compute as pc

from pipelines.correct.scene_shard import SceneShard
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import limited
from pipelines.execution.shard_job import Rows, rows_alone, rows_or_failure
from pipelines.generate.answers import NOT_OF_A_SCENE
from pipelines.preprocess.asset import AssetSettings, AssetUse, preprocess_asset
from pipelines.preprocess.plan import AssetUseCount, file_digest, groups
from pipelines.sources.assets import AssetLibraries
from stable_data.assets.store import AssetStore
from stable_data.content_id import content_id
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

_PER_SHARD = 16


@dataclass(frozen=True, slots=True)
class CarryWork:
    """The rows of some assets; sent to the workers.

    Attributes:
        TABLES: Of a shard, in the order in which they are put in place.
        out: The run's folder, which every worker can write.
        places: Where assets are taken from, see :class:`~pipelines.sources.assets.AssetLibraries`.
        fingerprint: Content of the libraries.
        seconds: An asset that takes longer is given up.
    """

    TABLES: ClassVar = ("warnings", "failures", "meshes", "assets")

    out: str
    places: tuple[str, ...]
    fingerprint: str
    seconds: float

    def __call__(self, shard: SceneShard[AssetUse], *, isolated: bool = False) -> tuple[int, int]:
        """Makes the rows of a shard and puts its tables in place; gives how many assets there are and how many failed."""
        rows: dict[str, list[schemas.Row]] = defaultdict(list)
        for use in shard.items:
            if isolated:
                made = rows_alone(self._rows, use, use.asset_id, seconds=self.seconds, prepare=partial(_opened, self))
            else:
                with limited(self.seconds):
                    made = self._rows(use)
            for table, found in made.items():
                rows[table] += found
        folder = RunFolder(self.out)
        for table in self.TABLES:
            folder.write_shard(table, shard.shard_id, rows[table])
        return len(shard), len(rows["failures"])

    def _rows(self, use: AssetUse) -> Rows:
        progress = ItemProgress("mesh")
        return rows_or_failure(use.asset_id, progress, partial(self._made, use, progress), of_the_run=NOT_OF_A_SCENE)

    def _made(self, use: AssetUse, progress: ItemProgress) -> Rows:
        shelf, store = _opened(self)
        path = shelf.asset_path(use.asset_id)
        if path is not None:
            use = replace(use, mesh_sha256=file_digest(path))
        made = preprocess_asset(use, shelf.annotation(use.asset_id), store, AssetSettings(), progress)
        return {"assets": [made.asset], "meshes": [made.mesh], "warnings": [schemas.notice_row(n) for n in made.notices]}


@lru_cache(maxsize=1)
def _opened(work: CarryWork) -> tuple[AssetLibraries, AssetStore]:
    shelf = AssetLibraries(work.places)
    return shelf, AssetStore(shelf)


def asset_shards(run: RunFolder, names: Sequence[str], fingerprint: str) -> list[SceneShard[AssetUse]]:
    """The assets that the scenes of a run use, in shards; one without any where no scene was made, so that the tables are there.

    Args:
        run: The run.
        names: Its tables of scenes.
        fingerprint: Content of the libraries.
    """
    uses: dict[str, AssetUseCount] = defaultdict(AssetUseCount)
    for name in names:
        for batch in run.batches(name, ["objects"]):
            objects = pc.list_flatten(batch["objects"])
            columns = [pc.struct_field(objects, key).to_pylist() for key in ("asset_id", "scale", "tilt_quat_xyzw")]
            for asset_id, scale, tilt in zip(*columns, strict=True):
                if asset_id is not None:
                    uses[asset_id].add(None if scale is None else tuple(scale), tuple(tilt))
    # Grids of signed distance are for training, which prepares its own.
    found = [AssetUse(a, "", use.typical_scale(), (), tuple(use.most_tilts())) for a, use in sorted(uses.items())]
    parts: list[Sequence[AssetUse]] = [*groups(found, _PER_SHARD)] or [()]
    return [SceneShard(content_id("carry", fingerprint, [asdict(use) for use in part]), tuple(part)) for part in parts]
