"""Which code is running: the version, and the content of the sources."""

import hashlib
from functools import cache
from pathlib import Path

from stable_data import __version__

_ROOT = Path(__file__).resolve().parents[1]
_PACKAGES = ("stable_data", "models", "pipelines")


@cache
def code_version() -> str:
    """The version of the toolkit with a hash of its sources, such as ``0.1.0+1f0c2e9ab4d7``.

    Two commits of one version differ in it where a module differs; tests, documents and benchmarks make no rows. It is the same on every
    machine with the same files; where the light library is installed alone, of that alone. Sources are read once, 10 to 30 ms.
    """
    return f"{__version__}+{digest_of(_ROOT)}"


def release_of(code: str) -> str:
    """The version without the hash.

    Example:
        >>> release_of("0.1.0+1f0c2e9ab4d7")
        '0.1.0'
    """
    return code.partition("+")[0]


def digest_of(root: Path) -> str:
    """12 hex digits of the hash of all modules of the toolkit in a folder, by their names and content."""
    digest = hashlib.sha256()
    found = (path for package in _PACKAGES for path in (root / package).rglob("*.py"))
    # An editor's lock beside a module is a link to nothing.
    paths = [path for path in found if path.is_file() and not path.name.startswith(".")]
    for name in sorted(path.relative_to(root).as_posix() for path in paths):
        content = (root / name).read_bytes()
        digest.update(f"{name}\n{len(content)}\n".encode() + content)
    return digest.hexdigest()[:12]
