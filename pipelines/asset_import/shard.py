"""The steps of the import job: sizes of a sample of the assets, then the rows of every asset."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from models.text_encoder import load_default
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows, Shard, ShardResult
from stable_data.errors import MeshError
from stable_data.importers.boundary import Boundary
from stable_data.importers.conversion import ConversionContext, ConversionSettings, convert, extents_of
from stable_data.importers.readers import reader_of
from stable_data.importers.source import ReaderOptions, SourceAsset, SourceRef
from stable_data.storage.table_rows import notice_row

MEASURED = "measured"
"""Table of the sizes of assets whose unit is not known."""


@dataclass(frozen=True, slots=True)
class SourceStep(ItemStep[SourceRef]):
    """A step over the assets of a source folder.

    Attributes:
        kind: Kind of the folder, one of :data:`stable_data.importers.readers.READERS`.
        root: The folder, readable for every worker; absolute, because each worker has its own current folder.
        reading: What the reader is told.
        conversion: What an asset becomes.
        seconds: Time limit of an asset.
    """

    UNIT: ClassVar = "asset"

    kind: str
    root: str
    reading: ReaderOptions
    conversion: ConversionSettings
    seconds: float

    @property
    def seconds_per_item(self) -> float:
        """The time limit of an asset, seconds."""
        return self.seconds

    def item_id(self, item: SourceRef) -> str:
        """The asset's id."""
        return item.asset_id

    def read(self, item: SourceRef) -> SourceAsset:
        """Reads an asset; its files are counted from zero."""
        return reader_of(self.kind).read(Boundary(Path(self.root)), item, self.reading)


@dataclass(frozen=True, slots=True)
class MeasureStep(SourceStep):
    """Measures the boxes of assets whose unit is not known. The step of assets reports those that cannot be read."""

    TABLES: ClassVar = ("failures", MEASURED)

    def shard(self, shard: Shard[SourceRef], *, isolated: bool = False) -> ShardResult:
        """Measures the assets of a shard; one that fails is left out here."""
        made = super(MeasureStep, self).shard(shard, isolated=isolated)
        return ShardResult({MEASURED: made.rows.get(MEASURED, ())})

    def prepare(self, item: SourceRef) -> None:
        """Loads the text encoder."""
        _context().vocabulary  # noqa: B018 - computed on the first access

    def item_rows(self, item: SourceRef, progress: ItemProgress) -> Rows:
        """The row of one asset."""
        try:
            asset = self.read(item)
        except MeshError:
            return {}
        if asset.unit_m is not None or asset.size_m is not None:
            return {}
        name = _context().vocabulary.name(asset)
        return {MEASURED: [{"asset_id": item.asset_id, "category": name.category, "extents": extents_of(asset.surfaces)}]}


@dataclass(frozen=True, slots=True)
class ImportStep(SourceStep):
    """Converts assets; see :func:`stable_data.importers.conversion.convert`."""

    TABLES: ClassVar = ("warnings", "failures", "textures", "meshes", "assets")

    def prepare(self, item: SourceRef) -> None:
        """Loads the text encoder."""
        _context()

    def item_rows(self, item: SourceRef, progress: ItemProgress) -> Rows:
        """The rows of one asset."""
        made = convert(self.read(item), self.conversion, _context(), progress, source_path=item.path)
        return {
            "assets": [made.asset_row],
            "meshes": [made.mesh_row],
            "textures": list(made.textures),
            "warnings": [notice_row(n) for n in made.notices],
        }


@lru_cache(maxsize=1)
def _context() -> ConversionContext:
    return ConversionContext(load_default())
