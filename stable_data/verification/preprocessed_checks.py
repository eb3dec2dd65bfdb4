"""Checks that a run of preprocess has the samples, grids and features of all its scenes and assets, and that these fit its scenes.

The job plans the grids and features of an asset by the objects of all scenes that it can read. The scenes of the run say the same again,
since each object keeps the entry of the file that it was read from.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from stable_data.assets.point_features import SMALLEST_EXTENT, FeatureKey, feature_key
from stable_data.geometry.sdf.aspects import aspect_of, aspect_steps
from stable_data.json_text import ReadLog, json_value
from stable_data.mesatask.asset_uses import AssetUseCount
from stable_data.mesatask.entry import read_scale
from stable_data.rotations import rotated_extents, tilt_key
from stable_data.scene import UPRIGHT, QuatXyzw, Vec3
from stable_data.storage.id_hashes import IdSet
from stable_data.storage.schemas import Row
from stable_data.verification.asset_checks import AssetFacts
from stable_data.verification.findings import Findings
from stable_data.verification.known_ids import KnownIds
from stable_data.verification.manifest_checks import num_planned
from stable_data.verification.scene_checks import is_close
from stable_data.verification.shard_files import ShardFile

_ROUNDING = 1e-4  # share of an extent: its logarithm is float32
_OF_PROCESS = frozenset({"crashed", "timed_out", "out_of_memory", "unexpected"})
"""Codes of failures that say nothing of the scene: the job may have counted its objects all the same."""


@dataclass(slots=True)
class _Asset:
    """What the rows of an asset say.

    Attributes:
        file: The file of its row in ``assets``.
        number: The number of that row.
        typical_scale: As in that row.
        tilts: Rounded tilt -> count, as in that row.
        grids: Aspects of its grids, in steps.
        features: Its features: aspect in steps and rounded tilt -> its tilt and ``log_extents``.
        use: How the scenes use it.
        is_use_known: Whether every object of it says how it was read.
    """

    file: ShardFile
    number: int
    typical_scale: Sequence[float] | None
    tilts: Counter[QuatXyzw]
    grids: set[tuple[int, int, int]] = field(default_factory=set)
    features: dict[FeatureKey, tuple[QuatXyzw, tuple[float, ...]]] = field(default_factory=dict)
    use: AssetUseCount = field(default_factory=AssetUseCount)
    is_use_known: bool = True


class PreprocessedCheck:
    """Checks rows of ``assets``, ``sdf``, ``features``, ``failures`` and ``scenes`` of a run of preprocess with each other.

    Args:
        manifest: The manifest of the run, or of the one that a published run was made of.
        known: Ids of all scenes, samples and failures.
        facts: What the meshes are.
        findings: Where damage is noted.
    """

    TABLE = "assets"
    TABLES = frozenset({"assets", "sdf", "features", "failures", "scenes"})

    def __init__(self, manifest: Mapping[str, Any], known: KnownIds, facts: AssetFacts, findings: Findings) -> None:
        self._manifest = manifest
        self._known, self._facts, self._findings = known, facts, findings
        self._assets = dict[str, _Asset]()  # those with a row in assets, which is read before the other tables
        self._num_scenes = self._num_unread = 0

    def check(self, rows: Sequence[Row], start: int, file: ShardFile) -> None:
        """Checks and notes rows of a file, of which the first has a number."""
        for number, row in enumerate(rows, start):
            try:
                if file.table == "scenes":
                    self._check_source(row, number, file)
                    self._note_objects(row, number, file)
                elif file.table == "failures":
                    self._num_unread += row["step"] == "read" and row["code"] not in _OF_PROCESS
                else:
                    self._note_asset(row, number, file)
            except (ArithmeticError, LookupError, TypeError, ValueError) as error:
                self._findings.damage(file.name, f"cannot be compared: {type(error).__name__}: {error}", number)

    def _note_asset(self, row: Row, number: int, file: ShardFile) -> None:
        name = row["asset_id"]
        if file.table == "assets":
            tilts = Counter[QuatXyzw]()
            for tilt in row["resting_tilts"]:
                tilts[tilt_key(tuple(tilt["tilt_quat_xyzw"]))] += tilt["count"]
            self._assets[name] = _Asset(file, number, row["typical_scale"], tilts)
        elif name not in self._assets:
            pass  # it refers to no asset, which is told elsewhere
        elif file.table == "sdf":
            self._assets[name].grids.add(aspect_steps(tuple(row["aspect"])))
        else:
            aspect, tilt = tuple(row["aspect"]), tuple(row["tilt_quat_xyzw"])
            self._assets[name].features[feature_key(name, aspect, tilt)] = tilt, tuple(row["log_extents"])

    def _check_source(self, row: Row, number: int, file: ShardFile) -> None:
        dataset = self._manifest.get("dataset")
        if isinstance(dataset, str) and row["source"] != dataset:
            what = f"{row['scene_id']}: source is {row['source']!r:.60}, expected {dataset!r:.60} as of the run"
            self._findings.damage(file.name, what, number)

    def _note_objects(self, row: Row, number: int, file: ShardFile) -> None:
        self._num_scenes += 1
        log = ReadLog(row["scene_id"])
        for o in row["objects"]:
            asset = self._assets.get(o["asset_id"])
            if asset is None:
                continue  # no mesh of it could be used
            entry = json_value(o["source_json"] or "null")
            if isinstance(entry, dict):  # the scale of the file: that of the object may be fitted to its size
                asset.use.add(read_scale(entry, o["instance"], log), tuple(o["tilt_quat_xyzw"]))
            else:
                asset.is_use_known = False
                what = f"{row['scene_id']}: source_json of {o['instance']} is no object of JSON, expected its entry in the layout file"
                self._findings.damage(file.name, what, number)

    def close(self) -> None:
        """Compares what was noted, after all rows were."""
        known = self._known.of
        lost = int((~known.get("samples", IdSet()).has_hashes(known.get("scenes", IdSet()).hashes)).sum())
        if lost:
            self._findings.damage("samples", f"{lost} scenes have no sample, expected one for each stage")
        # An asset may also be used by scenes that failed after they were read.
        planned = num_planned(self._manifest, "scenes")
        if planned is None:  # what a published run says of its origin does not list them
            planned = self._manifest.get("num_scenes")
        is_whole = self._num_scenes + self._num_unread == planned
        for name, asset in self._assets.items():
            try:
                for table, what in self._faults(name, asset, is_whole and asset.is_use_known):
                    where, number = (asset.file.name, asset.number) if table == "assets" else (table, None)
                    self._findings.damage(where, f"asset {name}: {what}", number)
            except (ArithmeticError, LookupError, TypeError, ValueError) as error:
                what = f"asset {name}: cannot be compared: {type(error).__name__}: {error}"
                self._findings.damage(asset.file.name, what, asset.number)

    def _faults(self, name: str, asset: _Asset, is_whole: bool) -> Iterator[tuple[str, str]]:
        """Yields what contradicts between the rows of an asset and the scenes, each with its table."""
        yield from (("sdf", what) for what in _compared("grid", asset.use.aspects(), asset.grids, is_whole))
        expected = _features(name, asset)
        if self._manifest.get("encoder") is not None and self._known.missing(pa.array([name]), ["failures"])[0]:
            yield from (("features", what) for what in _compared("feature", expected.keys(), asset.features.keys(), is_whole))
        if not is_whole:
            return
        yield from (("assets", what) for what in _use_faults(asset))
        for key, scale in expected.items():
            if key in asset.features and scale is not None and (what := self._extents_fault(key, scale, *asset.features[key])):
                yield "features", what

    def _extents_fault(self, key: FeatureKey, scale: float, tilt: QuatXyzw, log_extents: Sequence[float]) -> str:
        """What is wrong with the extents of a feature, given the mesh; empty if nothing is."""
        name, steps, _ = key
        extents = self._facts.extents(name)
        if extents is None:
            return ""
        x, y, z = (float(one) for one in extents * scale * aspect_of(steps))
        most = np.maximum(rotated_extents((x, y, z), tilt), SMALLEST_EXTENT)
        found = np.exp(np.array(log_extents))
        # Of a tilted mesh, bounds alone follow from its box.
        least = most if tilt == UPRIGHT else np.zeros(3)
        is_within = (found <= most * (1 + _ROUNDING)).all() and (found >= least * (1 - _ROUNDING)).all()
        if is_within and np.linalg.norm(found) >= max(x, y, z) * (1 - _ROUNDING):
            return ""
        at_most = "" if tilt == UPRIGHT else "at most "
        what = f"log_extents at the aspect {_told(aspect_of(steps))} are those of {_told(found)} m"
        return f"{what}, expected {at_most}{_told(most)} m by its mesh"


def _features(name: str, asset: _Asset) -> dict[FeatureKey, float | None]:
    """The features that the job makes of an asset, each with its scale, metres per mesh unit; None where it does not follow."""
    use = asset.use
    scales = use.shape_scales(asset.tilts)  # its own tilts: which of several equally frequent ones are there, is not known
    return {(name, *key): scale if key in use.shapes or not use.has_more_scales else None for key, scale in scales.items()}


def _use_faults(asset: _Asset) -> Iterator[str]:
    """Yields what the row of an asset says of its use that is not so in the scenes."""
    expected = {key: count for key, (_, count) in asset.use.tilts.items()}
    most = sorted(count for _, count in asset.use.most_tilts())  # which one of several equal counts is left out, is not known
    if sorted(asset.tilts.values()) != most or any(expected.get(key) != count for key, count in asset.tilts.items()):
        yield f"resting_tilts counts {sorted(asset.tilts.values())} objects, expected {most} of its frequent tilts in the scenes"
    if asset.use.has_more_scales:
        return  # the job looks at the first ones, in its own order
    stated, typical = asset.typical_scale, asset.use.typical_scale()
    is_same = stated == typical if stated is None or typical is None else all(map(is_close, stated, typical))
    if not is_same:
        yield f"typical_scale is {stated}, expected {typical}: the median of its scales in the scenes"


def _compared(what: str, expected: Collection[Any], found: Collection[Any], is_whole: bool) -> Iterator[str]:
    """Yields rows of an asset that are missing or, if all its uses are known, that the job does not make."""
    if lost := set(expected) - set(found):
        yield f"has no {what} at {_place(min(lost))}, expected one by how scenes use it"
    if is_whole and (more := set(found) - set(expected)):
        yield f"has a {what} at {_place(min(more))}, expected none: no scene uses it so"


def _place(key: Any) -> str:
    """A grid's aspect in steps, or the key of a feature, in words."""
    if isinstance(key[0], str):
        return f"the aspect {_told(aspect_of(key[1]))} and the tilt {_told(key[2])}"
    return f"the aspect {_told(aspect_of(key))}"


def _told(values: Vec3 | Sequence[float] | np.ndarray[Any, Any]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"
