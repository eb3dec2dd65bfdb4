"""Atomic file writes, and file names that every file system and program accepts."""

import hashlib
import re
import uuid
from collections.abc import Set
from pathlib import Path

_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
_MAX_LENGTH = 100


def temporary_path(path: Path) -> Path:
    """The path of a file while it is written: in the same folder, with a name unique over all machines.

    A process id would not be unique: machines or containers that share a folder use the same ids.
    """
    return path.with_name(f".{path.name}.tmp-{uuid.uuid4().hex}")


def write_file_atomically(path: Path, content: bytes) -> None:
    """Writes a file to a temporary path and renames it into place; its folder must exist.

    Raises:
        OSError: The file cannot be written.
    """
    temporary = temporary_path(path)
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:  # also if a time limit interrupts the write
        temporary.unlink(missing_ok=True)


def safe_file_name(name: str, reserved: Set[str] = frozenset()) -> str:
    """Returns a name of ASCII letters, digits and ``_.+-`` that other programs accept; a plain name is unchanged.

    Args:
        name: Any text.
        reserved: Names with a special meaning where the file is used.

    Returns:
        The name. A changed name ends with a hash of the original, so that different names stay different.

    Example:
        >>> safe_file_name("1_mug_0"), safe_file_name("../1 mug")
        ('1_mug_0', '1_mug-f4bd1811cd88589d')
    """
    if _PLAIN.fullmatch(name) and len(name) <= _MAX_LENGTH and name not in reserved:
        return name
    readable = re.sub(r"[^A-Za-z0-9_+-]+", "_", name).strip("_+-")[:_MAX_LENGTH] or "x"
    return f"{readable}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"
