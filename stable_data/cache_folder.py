"""The folder of a user for files that can be made again, shared by all of the user's processes."""

import os
import tempfile
from contextlib import suppress
from pathlib import Path


def user_cache(name: str) -> Path:
    """The folder of a kind of file: ``stable-data/NAME`` in ``XDG_CACHE_HOME`` or ``~/.cache``.

    A user without a home has it in the folder of temporary files.
    """
    try:
        place = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    except RuntimeError:
        place = Path(tempfile.gettempdir())
    return place / "stable-data" / name


def trim_folder(folder: Path, max_bytes: int) -> int:
    """Removes the files of a folder, and of its subfolders, that were changed or touched longest ago, until the rest fits.

    Another process may remove or add files meanwhile; a file that cannot be removed stays.

    Args:
        folder: The folder; it may be missing.
        max_bytes: Maximum size of the files that stay, bytes.

    Returns:
        Size of the files that stay, bytes.
    """
    found: list[tuple[int, int, str]] = []
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):  # removed meanwhile
                path = os.path.join(place, name)  # noqa: PTH118 - many files
                status = os.stat(path)  # noqa: PTH116
                found.append((status.st_mtime_ns, status.st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= max_bytes:
            break
        with suppress(OSError):
            os.unlink(path)  # noqa: PTH108
            total -= size
    return total
