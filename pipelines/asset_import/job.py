"""The import job: a source folder of assets becomes a run with the tables ``assets``, ``meshes`` and ``textures``."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

import stable_data
from models.text_encoder import load_default
from pipelines.asset_import.report import write_import_report
from pipelines.asset_import.settings import ImportSettings
from pipelines.asset_import.shard import MEASURED, ImportStep, MeasureStep, SourceStep
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import ExpectedItems, ShardJob, run_job
from pipelines.execution.shard_size import split_groups
from pipelines.execution.shard_step import Shard, StepShards
from pipelines.preprocess.plan import file_digest
from stable_data.assets.licences import normalise_licence
from stable_data.content_id import content_id, content_id_of_items
from stable_data.errors import ConfigError, Notice
from stable_data.importers.boundary import Boundary
from stable_data.importers.conversion import ConversionContext, SetScale
from stable_data.importers.readers import reader_of
from stable_data.importers.source import SourceRef
from stable_data.storage import schemas
from stable_data.storage.run_folder import RunFolder

S = TypeVar("S", bound=SourceStep)

_MAY_LACK_UNIT = ("mesh", "usd")  # kinds whose files need not state their unit; that of the others is the metre
_MOST_MEASURED = 200  # assets from which the unit of a set is estimated


def import_assets(
    kind: str, source: str, out: str, settings: ImportSettings, workers: WorkerPool, *, report: bool = True
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    root, target = Path(source).expanduser().resolve(), RunFolder(out)
    if target.is_local and Path(target.root).resolve().is_relative_to(root):
        message = f"--out {out}: is inside of the source folder {source}, expected another folder; choose one outside"
        raise ConfigError(message, "output_inside_source")
    return run_job(ImportJob(kind, source, settings), out, workers, report=report)


@dataclass(frozen=True, slots=True)
class _Listing:
    """The assets of a folder.

    Attributes:
        found: The assets, in the order of the reader.
        lost: Notices about assets that cannot be used, each under an identifier of its own.
    """

    found: tuple[SourceRef, ...]
    lost: tuple[Notice, ...]


class ImportJob(ShardJob):
    """Converts the assets of a source folder.

    Args:
        kind: Kind of the folder, one of :data:`stable_data.importers.readers.READERS`.
        source: The folder; every node of a cluster must see it under this path.
        settings: The job's settings.

    Raises:
        ConfigError: The kind is not known, there is no such folder, or it contains no asset of the kind.
    """

    name = "import"
    settings: ImportSettings

    def __init__(self, kind: str, source: str, settings: ImportSettings) -> None:
        if settings.licence and normalise_licence(settings.licence) is None:
            message = f"--licence {settings.licence!r}: is no known licence, expected a name such as CC-BY-4.0"
            raise ConfigError(message, "licence_invalid")
        if kind != "mesh" and (settings.preset or settings.manifest):
            raise ConfigError(f"--preset and --manifest are for kind mesh, but the kind is {kind}; leave them out", "usage")
        self.kind, self.settings = kind, settings
        self.root = Path(source).expanduser().resolve()
        self.reader = reader_of(kind)
        self.boundary = Boundary(self.root)
        self.dataset = self.root.name

    @cached_property
    def _listing(self) -> _Listing:
        """What the reader finds."""
        every = list(self.reader.find(self.boundary, self.settings.reading))
        found = tuple(each for each in every if isinstance(each, SourceRef))
        taken, lost = {ref.asset_id for ref in found}, list[Notice]()
        numbers: defaultdict[str, Iterator[int]] = defaultdict(lambda: count(2))  # for each identifier those not tried yet
        for notice in (each for each in every if isinstance(each, Notice)):
            name = notice.item_id
            while name in taken:  # an asset may be lost because another one has its identifier
                name = f"{notice.item_id}-{next(numbers[notice.item_id])}"
            taken.add(name)
            lost.append(replace(notice, item_id=name))
        if not found:
            found_here = f"none of {len(lost)} assets is usable, the first: {lost[0].message}" if lost else "no assets"
            hint = "" if lost else "; is it another kind?"
            raise ConfigError(f"{self.root}: {found_here} (kind {self.kind}), expected some{hint}", "source_empty")
        return _Listing(found, tuple(lost))

    @cached_property
    def _digests(self) -> dict[str, str]:
        """The hash of every file of the assets."""
        files = sorted({file for ref in self._listing.found for file in ref.files})
        with ThreadPoolExecutor() as pool:  # hashing and reading release the interpreter lock
            hashes = pool.map(file_digest, [self.root / file for file in files])
            return dict(zip(files, tqdm(hashes, "plan", len(files), unit="file", leave=False), strict=True))

    def _content(self, refs: Sequence[SourceRef]) -> Iterator[Any]:
        """What shapes the rows of assets: what is known about them, and the hashes of their files."""
        return ((asdict(ref), [self._digests[file] for file in ref.files]) for ref in refs)

    def inputs(self) -> dict[str, Any]:
        """The kind, and a hash of all files."""
        return {"kind": self.kind, "files": content_id_of_items(self._content(self._listing.found))}

    def about(self) -> dict[str, Any]:
        """The number of assets."""
        return {"num_assets": len(self._listing.found) + len(self._listing.lost)}

    def _step(self, step: Callable[..., S], scale: SetScale | None = None) -> S:
        settings = self.settings
        return step(self.kind, str(self.root), settings.reading, settings.conversion(scale), settings.seconds_per_item)

    def _shards(self, refs: Sequence[SourceRef], *more: Any) -> list[Shard[SourceRef]]:
        shaping = self.settings.shaping() | {"table_version": schemas.TABLE_VERSION, "code": stable_data.__version__}
        groups = split_groups(refs, self.settings.assets_per_shard)
        return [Shard(content_id("import", shaping, self.kind, list(self._content(g)), *more), tuple(g)) for g in groups]

    @property
    def _sample(self) -> Sequence[SourceRef]:
        """The assets from which the unit of a set is estimated; none if the files state it."""
        refs = self._listing.found if self.kind in _MAY_LACK_UNIT and not self.settings.unit_m else ()
        return refs[:: max(1, -(-len(refs) // _MOST_MEASURED))]

    def plan(self) -> Sequence[StepShards[Any]]:
        """The step that measures a sample of the assets, if the unit of some may not be known."""
        sample = self._sample
        return [StepShards(self._step(MeasureStep), self._shards(sample, MEASURED))] if sample else []

    def later_plans(self, folder: RunFolder) -> Iterator[Sequence[StepShards[Any]]]:
        """The step of all assets, with the unit that the sample shows."""
        found = None
        if self._sample:
            rows = sorted(folder.table(MEASURED).to_pylist(), key=lambda row: str(row["asset_id"]))
            sizes = ConversionContext(load_default()).sizes
            found = sizes.set_scale((row["category"], row["extents"]) for row in rows)
        shards = self._shards(self._listing.found, None if found is None else asdict(found))
        yield [StepShards(self._step(ImportStep, found), shards)]

    def expected(self) -> Sequence[ExpectedItems]:
        """All assets."""
        ids = [ref.asset_id for ref in self._listing.found] + [n.item_id for n in self._listing.lost]
        return [ExpectedItems("assets", "asset_id", ids, "failed_assets")]

    def lost(self) -> Sequence[Notice]:
        """Assets that the reader could not use."""
        return self._listing.lost

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Counts assets whose meshes are copies of another's."""
        hashes = Counter(h for h in folder.table("assets", ["geometry_hash"])["geometry_hash"].to_pylist() if h)
        return {"copies": sum(n - 1 for n in hashes.values())}

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_import_report(folder, manifest, self.settings.num_pictures)
