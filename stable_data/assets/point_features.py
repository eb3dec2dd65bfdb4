"""Point features of a run: of an exact aspect and tilt, or of the nearest ones."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow.compute as pc

from stable_data.errors import ConfigError
from stable_data.geometry.sdf.aspects import aspect_of, aspect_steps
from stable_data.rotations import tilt_key
from stable_data.scene import FloatArray, QuatXyzw, Vec3
from stable_data.storage.run_folder import RunFolder

FeatureKey: TypeAlias = tuple[str, tuple[int, int, int], QuatXyzw]
"""Asset id, aspect in steps, and rounded tilt."""

SMALLEST_EXTENT = 1e-4
"""Extents of point clouds count as at least this, metres, so that the logarithm of that of a flat object is finite."""

FAR_TILT = math.radians(5)
"""Difference of tilts above which a feature describes another point cloud, radians."""


def feature_key(asset_id: str, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> FeatureKey:
    """Returns the key of the feature of an asset at a scale and tilt."""
    return asset_id, aspect_steps(scale), tilt_key(tilt_quat_xyzw)


@dataclass(frozen=True, slots=True, eq=False)
class PointFeatures:
    """The R features of the assets of a run, all from one encoder.

    Attributes:
        values: Features of the normalised point clouds, (R, F) float32.
        aspects: Scale divided by its largest component, (R, 3) float64.
        tilts: Rotation before yaw as a unit quaternion xyzw, (R, 4) float64.
        log_extents: Key -> natural logarithm of the box extents in the yaw frame at the typical scale, metres, (3,) float64; nan
            if unknown. The size of an object is in its row of ``scenes``.
        row_of: Key -> row.
        rows_of: Asset id -> rows.
        fingerprint: Fingerprint of the encoder.
    """

    values: npt.NDArray[np.float32]
    aspects: FloatArray
    tilts: FloatArray
    log_extents: Mapping[FeatureKey, FloatArray]
    row_of: Mapping[FeatureKey, int]
    rows_of: Mapping[str, list[int]]
    fingerprint: str

    def of(self, asset_id: str, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> npt.NDArray[np.float32]:
        """Returns the feature of an asset at a scale and tilt that occur in scenes of the run, (F,) float32.

        Raises:
            ConfigError: The run has no feature of the asset at this aspect and tilt (``feature_missing``).
        """
        key = feature_key(asset_id, scale, tilt_quat_xyzw)
        if key not in self.row_of:
            message = f"asset {asset_id}: no feature at aspect {key[1]}, tilt {key[2]} by encoder {self.fingerprint}"
            raise ConfigError(
                f"{message}, expected one for each object of the run's scenes; run preprocess with features", "feature_missing"
            )
        feature: npt.NDArray[np.float32] = self.values[self.row_of[key]]
        return feature

    def nearest(self, asset_id: str, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> tuple[npt.NDArray[np.float32], float]:
        """Returns the feature of an asset with the nearest aspect, and among these with the nearest tilt.

        Returns:
            The feature, (F,) float32, and the difference of its tilt, radians.

        Raises:
            ConfigError: The run has no feature of the asset (``feature_missing``).
        """
        rows = self.rows_of.get(asset_id)
        if rows is None:
            raise ConfigError(
                f"asset {asset_id} has no features by encoder {self.fingerprint}, expected a row; fill the table features again",
                "feature_missing",
            )
        log_aspect = np.log(aspect_of(aspect_steps(scale)))
        distance = np.abs(np.log(self.aspects[rows]) - log_aspect).max(axis=1)
        cosine = np.minimum(np.abs(self.tilts[rows] @ np.asarray(tilt_quat_xyzw)), 1.0)  # q and -q are one rotation
        angle = 2 * np.arccos(cosine)
        best = np.lexsort((angle.round(6), distance.round(6)))[0]
        return self.values[rows[best]], float(angle[best])


def join_features(found: Sequence[PointFeatures]) -> PointFeatures:
    """Joins the features of several runs, of one encoder; of two with one key the first counts.

    Args:
        found: At least one.
    """
    row_of: dict[FeatureKey, int] = {}
    rows_of: dict[str, list[int]] = {}
    log_extents: dict[FeatureKey, FloatArray] = {}
    first = 0
    for each in found:
        row_of = {key: first + row for key, row in each.row_of.items()} | row_of
        log_extents = {**each.log_extents, **log_extents}
        for asset_id, rows in each.rows_of.items():
            rows_of.setdefault(asset_id, []).extend(first + row for row in rows)
        first += len(each.values)
    values, aspects, tilts = (
        np.concatenate([getattr(each, name) for each in found]) for name in ("values", "aspects", "tilts")
    )
    return PointFeatures(values, aspects, tilts, log_extents, row_of, rows_of, found[0].fingerprint)


def read_features(run: RunFolder) -> PointFeatures:
    """Reads the table ``features`` of a run.

    Args:
        run: A run folder, or any folder with the table.

    Raises:
        ConfigError: The table is missing (``table_missing``) or empty (``features_missing``), cannot be read, or contains
            features of several encoders or lengths (``features_mixed``).
    """
    table = run.table("features")
    found = sorted(pc.unique(table["encoder_fingerprint"]).to_pylist(), key=str)
    if len(found) != 1 or found[0] is None:
        what = f"features of the encoders {', '.join(map(str, found))}" if found else "no features"
        message = f"{run.uri}: contains {what}, expected features of one encoder; preprocess into a new folder with one encoder"
        raise ConfigError(message, "features_mixed" if found else "features_missing")
    lengths = sorted(pc.unique(pc.list_value_length(table["feature"])).to_pylist(), key=str)
    if len(lengths) != 1:
        raise ConfigError(
            f"{run.uri}: contains features of lengths {lengths}, expected one length; preprocess into a new folder with one encoder",
            "features_mixed",
        )
    columns = table.to_pydict()
    uses = zip(columns["asset_id"], columns["aspect"], columns["tilt_quat_xyzw"], strict=True)
    keys = [feature_key(asset_id, tuple(aspect), tuple(tilt)) for asset_id, aspect, tilt in uses]
    rows_of: dict[str, list[int]] = {}
    for row, asset_id in enumerate(columns["asset_id"]):
        rows_of.setdefault(asset_id, []).append(row)
    tilts = np.array(columns["tilt_quat_xyzw"], np.float64)
    return PointFeatures(
        np.array(columns["feature"], np.float32),
        np.array(columns["aspect"], np.float64),
        tilts / np.linalg.norm(tilts, axis=1, keepdims=True),
        {key: np.array(extents or [np.nan] * 3, np.float64) for key, extents in zip(keys, columns["log_extents"], strict=True)},
        {key: row for row, key in enumerate(keys)},
        rows_of,
        found[0],
    )
