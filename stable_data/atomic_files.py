"""Files that are there whole or not at all, and names that any file system and any other program takes."""

import hashlib
import re
import uuid
from collections.abc import Set
from pathlib import Path

_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
_MAX_LENGTH = 100


def temporary_path(path: Path) -> Path:
    """Where a file is written before it is put in place: beside it, under a name that no other writer has, on no machine.

    The number of a process would not do: machines, or containers, that share a folder have the same ones.
    """
    return path.with_name(f".{path.name}.tmp-{uuid.uuid4().hex}")


def write_file_atomically(path: Path, content: bytes) -> None:
    """Writes a file aside and puts it in place in one step; its folder must be there.

    Raises:
        OSError: It cannot be written.
    """
    aside = temporary_path(path)
    try:
        aside.write_bytes(content)
        aside.replace(path)
    finally:  # a time limit may end it too
        aside.unlink(missing_ok=True)


def safe_file_name(name: str, reserved: Set[str] = frozenset()) -> str:
    """A name of ASCII letters, digits and ``_.+-``, so that other programs take it; one that is plain already stays as it is.

    Args:
        name: Any text.
        reserved: Names that mean something else where it is used.

    Returns:
        The name; where it had to be changed, with a hash of what it was, so that different names stay different.

    Example:
        >>> plain_name("1_mug_0"), plain_name("../1 mug")
        ('1_mug_0', '1_mug-f4bd1811')
    """
    if _PLAIN.fullmatch(name) and len(name) <= _MAX_LENGTH and name not in reserved:
        return name
    known = re.sub(r"[^A-Za-z0-9_+-]+", "_", name).strip("_+-")[:_MAX_LENGTH] or "x"
    return f"{known}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
