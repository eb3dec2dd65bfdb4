"""Checks that a run of preprocess has all that its job leaves of each scene and asset: samples, grids and features, and their uses.

The job plans the grids and features of an asset by the objects of all scenes. The scenes of the run say the same again, since each object
keeps the entry of the file that it was read from.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from stable_data.geometry.sdf.aspects import aspect_of, aspect_steps
from stable_data.json_text import ReadLog, json_value
from stable_data.mesatask.asset_uses import MOST_SCALES, AssetUseCount, ShapeUse
from stable_data.mesatask.entry import read_scale
from stable_data.rotations import rotated_extents, tilt_key
from stable_data.scene import UPRIGHT, QuatXyzw
from stable_data.storage.id_hashes import IdSet
from stable_data.storage.schemas import Row
from stable_data.verification.asset_checks import AssetFacts
from stable_data.verification.findings import Findings
from stable_data.verification.known_ids import KnownIds
from stable_data.verification.scene_checks import is_close
from stable_data.verification.shard_files import ShardFile

_ROUNDING = 1e-4  # logarithms of extents are float32, and are of single vertices

_ShapeKey = tuple[tuple[int, int, int], QuatXyzw]


@dataclass(slots=True)
class _Asset:
    """What the rows of an asset say.

    Attributes:
        file: The file of its row in ``assets``; None if it has none.
        number: The number of that row.
        typical_scale: As in that row.
        tilts: Rounded tilt -> count, as in that row.
        grids: Aspects of its grids, in steps.
        features: Aspect in steps and rounded tilt of each of its features -> its tilt and ``log_extents``.
        use: How the scenes use it.
        is_use_known: Whether every object of it says how it was read.
    """

    file: ShardFile | None = None
    number: int = 0
    typical_scale: Sequence[float] | None = None
    tilts: Counter[QuatXyzw] = field(default_factory=Counter)
    grids: set[tuple[int, int, int]] = field(default_factory=set)
    features: dict[_ShapeKey, tuple[QuatXyzw, tuple[float, ...]]] = field(default_factory=dict)
    use: AssetUseCount = field(default_factory=AssetUseCount)
    is_use_known: bool = True


class PreprocessedCheck:
    """Checks rows of ``assets``, ``sdf``, ``features`` and ``scenes`` of a run of preprocess with each other.

    Args:
        manifest: The manifest of the run, or of the one that a published run was made of.
        tables: The tables that the run must have.
        known: Ids of all scenes, samples and failures.
        facts: What the meshes are.
        findings: Where damage is noted.
    """

    TABLE = "assets"
    TABLES = frozenset({"assets", "sdf", "features", "scenes"})

    def __init__(
        self, manifest: Mapping[str, Any], tables: frozenset[str], known: KnownIds, facts: AssetFacts, findings: Findings
    ) -> None:
        self._manifest, self._tables = manifest, tables
        self._known, self._facts, self._findings = known, facts, findings
        self._assets = defaultdict[str, _Asset](_Asset)
        self._num_scenes = 0

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks and notes rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            if file.table == "scenes":
                self._note_scene(row, number, file)
                continue
            asset = self._assets[row["asset_id"]]
            if file.table == "assets":
                asset.file, asset.number, asset.typical_scale = file, number, row["typical_scale"]
                for tilt in row["resting_tilts"]:
                    asset.tilts[tilt_key(tuple(tilt["tilt_quat_xyzw"]))] += tilt["count"]
            elif file.table == "sdf":
                asset.grids.add(aspect_steps(tuple(row["aspect"])))
            else:
                key = aspect_steps(tuple(row["aspect"])), tilt_key(tuple(row["tilt_quat_xyzw"]))
                asset.features[key] = tuple(row["tilt_quat_xyzw"]), tuple(row["log_extents"])

    def _note_scene(self, row: Row, number: int, file: ShardFile) -> None:
        self._num_scenes += 1
        dataset = self._manifest.get("dataset")
        if isinstance(dataset, str) and row["source"] != dataset:
            what = f"{row['scene_id']}: source is {row['source']!r:.60}, expected {dataset!r:.60} as of the run"
            self._findings.damage(file.name, what, number)
        log = ReadLog(row["scene_id"])
        for o in row["objects"]:
            if o["asset_id"] is None:
                continue
            asset, text = self._assets[o["asset_id"]], o.get("source_json")
            entry = None if text is None else json_value(text)
            if isinstance(entry, dict):  # the scale of the file: that of the object may be fitted to its size
                asset.use.add(read_scale(entry, o["instance"], log), tuple(o["tilt_quat_xyzw"]))
            else:
                asset.is_use_known = False

    def close(self) -> None:
        """Compares what was noted, after all rows were."""
        if "samples" in self._tables:
            known = self._known.of
            lost = int((~known.get("samples", IdSet()).has_hashes(known.get("scenes", IdSet()).hashes)).sum())
            if lost:
                self._findings.damage("samples", f"{lost} scenes have no sample, expected one for each stage")
        for asset_id, asset in self._assets.items():
            if asset.file is None:
                continue  # its grids and features refer to no asset, or no mesh of it could be used
            for table, what in self._faults(asset_id, asset):
                if table == "assets":
                    self._findings.damage(asset.file.name, f"asset {asset_id}: {what}", asset.number)
                else:
                    self._findings.damage(table, f"asset {asset_id}: {what}")

    def _faults(self, asset_id: str, asset: _Asset) -> Iterator[tuple[str, str]]:
        """Yields what contradicts between the rows of an asset and the scenes, each with its table."""
        # An asset may also be used by scenes that failed.
        is_whole = asset.is_use_known and self._num_scenes == self._manifest.get("num_scenes")
        use = asset.use
        if "sdf" in self._tables:
            yield from _compared("sdf", "grid", "aspect in steps", use.aspects(), asset.grids, is_whole)
        shapes = {(shape.steps, tilt_key(shape.tilt_quat_xyzw)): shape for shape in use.shape_uses()}
        is_encoded = self._manifest.get("encoder") is not None and "features" in self._tables
        if is_encoded and self._known.missing(pa.array([asset_id]), ["failures"])[0]:
            yield from _compared("features", "feature", "aspect and tilt", shapes.keys(), asset.features.keys(), is_whole)
        if not is_whole:
            return
        expected = Counter({key: count for key, (_, count) in use.tilts.items()})
        if any(expected[key] != count for key, count in asset.tilts.items()) or sorted(asset.tilts.values()) != sorted(
            count for _, count in use.most_tilts()
        ):
            yield (
                "assets",
                f"resting_tilts counts {sorted(asset.tilts.values())}, expected those of its most frequent tilts in the scenes",
            )
        if sum(map(len, use.shapes.values())) > MOST_SCALES:
            return  # of more, the job looks at the first ones in its own order
        stated, typical = asset.typical_scale, use.typical_scale()
        is_same = stated == typical if stated is None or typical is None else all(map(is_close, stated, typical))
        if not is_same:
            yield "assets", f"typical_scale is {stated}, expected {typical}: the median of its scales in the scenes"
        for key, shape in shapes.items():
            if key in asset.features and (what := self._extents_fault(asset_id, shape, *asset.features[key])):
                yield "features", what

    def _extents_fault(self, asset_id: str, shape: ShapeUse, tilt: QuatXyzw, log_extents: Sequence[float]) -> str:
        """What is wrong with the extents of a feature at a tilt, given the mesh; empty if nothing is."""
        extents = self._facts.extents(asset_id)
        if extents is None:
            return ""
        box = extents * shape.scale * aspect_of(shape.steps)
        x, y, z = box.tolist()
        most, found = np.array(rotated_extents((x, y, z), tilt)), np.exp(np.array(log_extents))
        # Of a tilted mesh, bounds alone follow from its box.
        least = most if tilt == UPRIGHT else np.zeros(3)
        is_within = (found <= most * (1 + _ROUNDING)).all() and (found >= least * (1 - _ROUNDING)).all()
        if is_within and np.linalg.norm(found) >= box.max() * (1 - _ROUNDING):
            return ""
        return (
            f"log_extents at the aspect {shape.steps} are of {found.round(5).tolist()} m, expected {most.round(5).tolist()} m"
        )


def _compared(
    table: str, what: str, of: str, expected: Collection[Any], found: Collection[Any], is_whole: bool
) -> Iterator[tuple[str, str]]:
    """Yields which rows of an asset are missing or, if all uses are known, of no use."""
    if lost := set(expected) - set(found):
        yield table, f"no {what} of the {of} {min(lost)}, in which scenes use it"
    if is_whole and (more := set(found) - set(expected)):
        yield table, f"a {what} of the {of} {min(more)}, in which no scene uses it"
