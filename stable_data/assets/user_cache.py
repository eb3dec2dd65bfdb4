"""Arrays that are computed once for each mesh, in files that all processes of a user share.

A file is named by a hash of its inputs and of the code that computes it, so that changed code makes new files. Without a usable file,
arrays are computed again; a disk that is full or read-only costs time, never a result.
"""

import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stable_data.atomic_files import write_file_atomically

Arrays = Mapping[str, npt.NDArray[Any]]


class ArrayFiles:
    """Files of arrays by key.

    Args:
        folder: The folder; None stores nothing.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def read(self, key: str) -> dict[str, npt.NDArray[Any]] | None:
        """Returns the arrays of a key; None if there is no usable file."""
        if self._folder is None:
            return None
        try:
            # numpy would leave the file itself open if it is damaged.
            content = io.BytesIO((self._folder / f"{key}.npz").read_bytes())
            with np.load(content, allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return None

    def write(self, key: str, arrays: Arrays) -> None:
        """Stores the arrays of a key, if that is possible."""
        if self._folder is None:
            return
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            write_file_atomically(self._folder / f"{key}.npz", content.getvalue())


def array_key(code: Path, *parts: bytes) -> str:
    """Returns a key: a hash of the Python files at a path, which is a module or a folder of modules, and of further parts."""
    digest = hashlib.sha256(_code(code))
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()[:24]


@cache
def _code(code: Path) -> bytes:
    files = sorted(code.glob("*.py")) if code.is_dir() else [code]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).digest()
