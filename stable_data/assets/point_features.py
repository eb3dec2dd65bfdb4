"""Point features of a run, read back: which there are, and of which encoder."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow.compute as pc

from stable_data.assets.store import aspect_steps, tilt_key
from stable_data.errors import ConfigError
from stable_data.scene import QuatXyzw, Vec3
from stable_data.storage.row_groups import rows_from_table
from stable_data.storage.run_folder import RunFolder

FeatureKey: TypeAlias = tuple[str, tuple[int, int, int], QuatXyzw]
"""Asset, steps of its aspect, and key of its tilt."""


def feature_key(asset_id: str, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> FeatureKey:
    """Under which the feature of an asset at a scale and tilt is found."""
    return asset_id, aspect_steps(scale), tilt_key(tilt_quat_xyzw)


@dataclass(frozen=True, slots=True, eq=False)
class PointFeatures:
    """Features of the assets of a run, all of one encoder.

    Attributes:
        vectors: Feature of the normalised cloud, (64,) float32.
        log_extents: Natural logarithm of the box in the yaw frame at the usual scale, metres, (3,) float64. An object's own
            size is in its row of ``scenes``.
        fingerprint: The encoder.
    """

    vectors: Mapping[FeatureKey, npt.NDArray[np.float32]]
    log_extents: Mapping[FeatureKey, npt.NDArray[np.float64]]
    fingerprint: str

    def of(self, asset_id: str, scale: Vec3, tilt_quat_xyzw: QuatXyzw) -> npt.NDArray[np.float32]:
        """The feature of an asset at a scale and tilt, (64,) float32.

        Raises:
            ConfigError: ``feature_missing``: the run has none of it at this aspect and tilt.
        """
        key = feature_key(asset_id, scale, tilt_quat_xyzw)
        if key not in self.vectors:
            message = f"asset {asset_id}: no feature at aspect {key[1]}, tilt {key[2]} by encoder {self.fingerprint}"
            raise ConfigError(
                f"{message}, expected one for each use in a scene of the run; run preprocess with features", "feature_missing"
            )
        return self.vectors[key]


def read_features(run: RunFolder) -> PointFeatures:
    """The table ``features`` of a run.

    Args:
        run: A run folder, or any folder with the table.

    Raises:
        ConfigError: It is not there or empty, cannot be read, or holds features of several encoders or lengths.
    """
    table = run.table("features")
    found = sorted(pc.unique(table["encoder_fingerprint"]).to_pylist(), key=str)
    if len(found) != 1:
        what = f"features of encoders {', '.join(map(str, found))}" if found else "no features"
        message = f"{run.uri}: contains {what}, expected features of one encoder; preprocess into a new folder with one encoder"
        raise ConfigError(message, "features_mixed" if found else "features_missing")
    lengths = sorted(pc.unique(pc.list_value_length(table["feature"])).to_pylist())
    if len(lengths) != 1:
        raise ConfigError(
            f"{run.uri}: contains features of lengths {lengths}, expected one length; preprocess into a new folder with one encoder",
            "features_mixed",
        )
    rows = rows_from_table(table)
    keys = [feature_key(row["asset_id"], tuple(row["aspect"]), tuple(row["tilt_quat_xyzw"])) for row in rows]
    return PointFeatures(
        {key: row["feature"] for key, row in zip(keys, rows, strict=True)},
        {key: np.array(row["log_extents"]) for key, row in zip(keys, rows, strict=True)},
        found[0],
    )
