"""A robot at a laid table, once for the tests that do not change it."""

import pytest

from stable_data.simulation.scene_geometry import SceneGeometry
from tests.stable_data.robot.tables import Bench, geometry_in, laid_table


@pytest.fixture(scope="session")
def geometry(tmp_path_factory: pytest.TempPathFactory) -> SceneGeometry:
    return geometry_in(tmp_path_factory.mktemp("robot"), laid_table())


@pytest.fixture
def bench(geometry: SceneGeometry) -> Bench:
    return Bench(geometry)
