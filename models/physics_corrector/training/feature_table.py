"""The 64-d features of the shapes that scenes point to, from the rows of a run's table ``features``."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stable_data.assets.store import aspect_of, aspect_steps
from stable_data.errors import ConfigError
from stable_data.scene import FloatArray, QuatXyzw, Vec3
from stable_data.storage.run_folder import RunFolder

_COLUMNS = ["asset_id", "aspect", "tilt_quat_xyzw", "feature", "encoder_fingerprint"]
_FAR = math.radians(5)  # a row of another tilt than this describes another cloud


@dataclass(frozen=True, slots=True)
class ShapeKey:
    """What a shape is made of.

    Attributes:
        asset_id: Its asset; a clean scene has the mesh of every object.
        scale: Metres per mesh unit.
        tilt_quat_xyzw: Rotation before yaw.
    """

    asset_id: str
    scale: Vec3
    tilt_quat_xyzw: QuatXyzw


@dataclass(frozen=True, slots=True, eq=False)
class FeatureTable:
    """Features of shapes.

    Attributes:
        values: One row a shape, (K, F) float32.
        fingerprint: The encoder that made them.
        num_far: Shapes whose nearest row is of a tilt that is more than 5 degrees away.
    """

    values: npt.NDArray[np.float32]
    fingerprint: str
    num_far: int


def point_features(run: RunFolder, keys: Sequence[ShapeKey]) -> FeatureTable:
    """The feature of each shape: of its asset's rows the one whose aspect, then tilt, is nearest.

    Raises:
        ConfigError: The table is not there, its rows are of several encoders, or an asset has none.
    """
    if not run.files("features"):
        raise ConfigError(
            f"{run.uri}: no table features, expected one; fill it with the point encoder, or set features = box",
            "features_missing",
        )
    rows = run.table("features", _COLUMNS)
    fingerprints = sorted(set(rows["encoder_fingerprint"].to_pylist()), key=str)
    if len(fingerprints) != 1 or fingerprints[0] is None:
        found = ", ".join(map(str, fingerprints)) or "none"
        raise ConfigError(
            f"{run.uri}: the table features is of the encoders {found}, expected one; fill it anew with one encoder",
            "features_mixed",
        )
    of_asset = _by_asset(rows.to_pydict())
    width = len(next(iter(of_asset.values())).values[0])
    values, num_far = np.zeros((len(keys), width), np.float32), 0
    for n, key in enumerate(keys):
        if key.asset_id not in of_asset:
            raise ConfigError(
                f"{run.uri}: asset {key.asset_id} has no features, expected a row; fill the table features again",
                "features_missing",
            )
        values[n], angle = of_asset[key.asset_id].nearest(key)
        num_far += angle > _FAR
    return FeatureTable(values, fingerprints[0], num_far)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The rows of one asset."""

    log_aspects: FloatArray  # (R, 3)
    tilts: FloatArray  # (R, 4)
    values: npt.NDArray[np.float32]  # (R, F)

    def nearest(self, key: ShapeKey) -> tuple[npt.NDArray[np.float32], float]:
        """The feature for a shape, and by how much its tilt differs, radians."""
        aspect = np.abs(self.log_aspects - np.log(aspect_of(aspect_steps(key.scale)))).max(axis=1)
        cosine = np.minimum(np.abs(self.tilts @ np.asarray(key.tilt_quat_xyzw)), 1.0)  # q and -q are one rotation
        angle = 2 * np.arccos(cosine)
        best = np.lexsort((angle.round(6), aspect.round(6)))[0]
        return self.values[best], float(angle[best])


def _by_asset(columns: Mapping[str, list[object]]) -> dict[str, _Rows]:
    places: dict[str, list[int]] = {}
    for n, asset_id in enumerate(columns["asset_id"]):
        places.setdefault(str(asset_id), []).append(n)
    log_aspects = np.log(np.array(columns["aspect"], np.float64))
    tilts = np.array(columns["tilt_quat_xyzw"], np.float64)
    values = np.array(columns["feature"], np.float32)
    tilts /= np.linalg.norm(tilts, axis=1, keepdims=True)
    return {a: _Rows(log_aspects[of], tilts[of], values[of]) for a, of in places.items()}
