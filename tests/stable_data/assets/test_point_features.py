"""Point features of a run: of an exact use, and of the nearest one."""

import math
from pathlib import Path

import numpy as np
import pytest

from stable_data.assets.point_features import FAR_TILT, PointFeatures, read_features
from stable_data.errors import ConfigError
from stable_data.scene import UPRIGHT, QuatXyzw
from stable_data.storage.run_folder import RunFolder

RUN = Path(__file__).parents[2] / "data" / "run_v3" / "preprocess"


@pytest.fixture(scope="module")
def features() -> PointFeatures:
    return read_features(RunFolder(RUN))


def about_x(angle: float) -> QuatXyzw:
    return (math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2))


def test_a_use_of_the_run_is_found_exactly_and_as_the_nearest(features: PointFeatures) -> None:
    for row in RunFolder(RUN).table("features").to_pylist():
        use = row["asset_id"], tuple(row["aspect"]), tuple(row["tilt_quat_xyzw"])
        assert features.of(*use).tolist() == row["feature"]
        found, angle = features.nearest(*use)
        assert found.tolist() == row["feature"]
        assert angle < 1e-3
        opposite = tuple(-q for q in row["tilt_quat_xyzw"])  # the same rotation
        assert features.nearest(row["asset_id"], tuple(row["aspect"]), opposite)[0].tolist() == row["feature"]


def test_the_nearest_aspect_comes_before_the_nearest_tilt(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    uses = [((1.0, 1.0, 1.0), UPRIGHT), ((1.0, 1.0, 1.0), about_x(1.0)), ((1.0, 1.0, 0.5), UPRIGHT)]
    rows = [
        {
            "asset_id": "a",
            "aspect": aspect,
            "tilt_quat_xyzw": tilt,
            "feature": [float(n)],
            "log_extents": None,
            "encoder_fingerprint": "one",
        }
        for n, (aspect, tilt) in enumerate(uses)
    ]
    run.write_shard("features", "00", rows)
    features = read_features(run)
    for scale, angle, expected in (((2.0, 2.0, 2.0), 0.9, 1), ((1.0, 1.0, 0.6), 1.0, 2), ((1.0, 0.9, 1.0), 0.3, 0)):
        found, far = features.nearest("a", scale, about_x(angle))
        assert found.tolist() == [expected]
        assert math.isclose(far, abs(angle - (1.0 if expected == 1 else 0.0)), abs_tol=1e-6)
        assert (far > FAR_TILT) == (far > math.radians(5))
    assert np.isnan(next(iter(features.log_extents.values()))).all()
    with pytest.raises(ConfigError, match="asset b has no features"):
        features.nearest("b", (1.0, 1.0, 1.0), UPRIGHT)
    with pytest.raises(ConfigError, match="no feature at aspect"):
        features.of("a", (1.0, 0.2, 1.0), UPRIGHT)
