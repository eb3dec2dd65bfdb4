"""A disk of its own for a run, which can be filled and freed: a file system in a file, mounted on a folder."""

import os
import subprocess
import time
from contextlib import suppress
from pathlib import Path

from stable_data.errors import ConfigError

_BLOCK = 4096


class SmallDisk:
    """A disk of a limited size. To mount it needs the rights of root, and a loop device.

    Args:
        folder: Folder of the image ``disk.img``, which is kept when the disk is closed, and of the mount point ``disk``.
        gigabytes: Size of the disk; the image is as large as its content.

    Raises:
        ConfigError: It cannot be mounted (``disk_not_mounted``).
    """

    def __init__(self, folder: Path, gigabytes: float) -> None:
        self.root = folder / "disk"
        image = folder / "disk.img"
        self.root.mkdir(parents=True, exist_ok=True)
        if self.root.is_mount():  # of a program that was killed
            self.free()
            return
        try:
            if not image.exists():
                with image.open("wb") as stream:
                    stream.truncate(int(gigabytes * 1e9) // _BLOCK * _BLOCK)
                _run("mkfs.ext4", "-q", "-m", "0", str(image))
            _run("mount", "-o", "loop", str(image), str(self.root))
        except (OSError, subprocess.CalledProcessError) as error:
            reason = str(getattr(error, "stderr", None) or error).strip().splitlines()[0]
            raise ConfigError(
                f"{self.root}: no disk can be mounted there ({reason}); run as root with a loop device, or leave the fault full_disk out",
                "disk_not_mounted",
            ) from error
        self.free()

    @property
    def _ballast(self) -> Path:
        return self.root / "ballast"

    def fill(self) -> None:
        """Fills the disk to its last block."""
        with self._ballast.open("wb") as stream, suppress(OSError):
            free = os.statvfs(self.root)
            os.posix_fallocate(stream.fileno(), 0, max(1, (free.f_bavail - 16) * free.f_frsize))
        with self._ballast.open("ab", buffering=0) as stream, suppress(OSError):
            while True:
                stream.write(bytes(_BLOCK))

    def free(self) -> None:
        """Frees what :meth:`fill` has taken."""
        self._ballast.unlink(missing_ok=True)

    def close(self) -> None:
        """Unmounts the disk; the image stays."""
        self.free()
        for _ in range(30):
            with suppress(subprocess.CalledProcessError):
                _run("umount", str(self.root))
                return
            time.sleep(1.0)  # a process that was killed may still hold a file
        _run("umount", "--lazy", str(self.root))


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, text=True)
