"""Robot packages: a robot whose files are missing says how to get them; the others hold their pose."""

from pathlib import Path

import pytest

from stable_data.errors import ConfigError
from stable_data.robot.arm.robots import ROBOTS, robot_named
from stable_data.simulation.scene_geometry import SceneGeometry
from tests.stable_data.robot.tables import Bench


def test_a_robot_without_files_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ConfigError, match="stable-data robots --fetch panda") as error:
        robot_named("panda")
    assert error.value.code == "robot_missing"


def test_an_unknown_robot_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected one of panda"):
        robot_named("ur99")


@pytest.mark.parametrize("name", list(ROBOTS))
def test_a_robot_holds_its_pose_and_opens_again(name: str, geometry: SceneGeometry) -> None:
    if not ROBOTS[name].is_there:
        pytest.skip(f"the files of {name} are not on this machine: stable-data robots --fetch {name}")
    bench = Bench(geometry, name)
    bench.world.advance(bench.arm.home, 0.0, 1.0)
    assert abs(bench.world.opening) < 0.01
    bench.world.advance(bench.arm.home, 0.05, 1.0)
    assert abs(bench.world.joints - bench.arm.home).max() < 2e-3
    assert bench.world.opening == pytest.approx(0.05, abs=0.02)
    assert bench.world.contacts().hit == frozenset()


def test_models_come_from_known_packages_with_a_licence() -> None:
    for robot in ROBOTS.values():
        assert robot.package is None or (robot.package.licence and len(robot.package.sha256) == 64)
        assert len(robot.joints) == len(robot.home) == len(robot.actuators)
