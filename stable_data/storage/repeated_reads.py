"""Files of an object store, which are read again where an answer is cut off.

Arrow repeats what a store refuses or does not answer. It does not always repeat a read whose answer has begun and then ends too early: the
library below it may take that for a fault of this machine (``Failed to flush response stream``). In a long job, some of the reads end so.
"""

import time
from collections.abc import Callable
from typing import TypeVar

import pyarrow as pa
import pyarrow.fs as pafs

_T = TypeVar("_T")

_PAUSES = (0.1, 0.5, 2.0)  # seconds before a read is done again


def with_repeated_reads(store: pafs.FileSystem) -> pafs.FileSystem:
    """Returns a file system that reads again what a store cuts off; all else is as before.

    Args:
        store: The file system of an object store.
    """
    return pafs.PyFileSystem(_Handler(store))


class _RepeatedFile:
    """A file for :class:`pyarrow.PythonFile`."""

    def __init__(self, store: pafs.FileSystem, path: str) -> None:
        self._file = store.open_input_file(path)

    @property
    def closed(self) -> bool:
        return bool(self._file.closed)

    def close(self) -> None:
        self._file.close()

    def seek(self, offset: int, whence: int = 0) -> int:
        return int(self._file.seek(offset, whence))

    def tell(self) -> int:
        return int(self._file.tell())

    def read(self, size: int = -1) -> bytes:
        return bytes(self._read(lambda: self._file.read(None if size < 0 else size)))

    def read_buffer(self, size: int = -1) -> pa.Buffer:
        """The next bytes without a copy, which Arrow takes in place of :meth:`read`."""
        return self._read(lambda: self._file.read_buffer(None if size < 0 else size))

    def _read(self, read: Callable[[], _T]) -> _T:
        start = self._file.tell()
        for pause in _PAUSES:
            try:
                return read()
            except OSError:
                time.sleep(pause)
                self._file.seek(start)
        return read()


class _Handler(pafs.FileSystemHandler):  # type: ignore[misc]  # pyarrow has no types
    """Passes all calls to the store."""

    def __init__(self, store: pafs.FileSystem) -> None:
        self._store = store

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Handler) and bool(self._store == other._store)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(type(self))

    def open_input_file(self, path: str) -> pa.NativeFile:
        return pa.PythonFile(_RepeatedFile(self._store, path), mode="r")

    def open_input_stream(self, path: str) -> pa.NativeFile:
        return self.open_input_file(path)

    def get_file_info(self, paths: list[str]) -> list[pafs.FileInfo]:
        return list(self._store.get_file_info(paths))

    def get_file_info_selector(self, selector: pafs.FileSelector) -> list[pafs.FileInfo]:
        return list(self._store.get_file_info(selector))

    def get_type_name(self) -> str:
        return str(self._store.type_name)

    def normalize_path(self, path: str) -> str:
        return str(self._store.normalize_path(path))

    def open_output_stream(self, path: str, metadata: dict[str, str]) -> pa.NativeFile:
        return self._store.open_output_stream(path, compression=None, metadata=metadata)

    def open_append_stream(self, path: str, metadata: dict[str, str]) -> pa.NativeFile:
        return self._store.open_append_stream(path, compression=None, metadata=metadata)

    def create_dir(self, path: str, recursive: bool) -> None:
        self._store.create_dir(path, recursive=recursive)

    def delete_dir(self, path: str) -> None:
        self._store.delete_dir(path)

    def delete_dir_contents(self, path: str, missing_dir_ok: bool = False) -> None:
        self._store.delete_dir_contents(path, missing_dir_ok=missing_dir_ok)

    def delete_root_dir_contents(self) -> None:
        self._store.delete_dir_contents("/", accept_root_dir=True)

    def delete_file(self, path: str) -> None:
        self._store.delete_file(path)

    def move(self, src: str, dest: str) -> None:
        self._store.move(src, dest)

    def copy_file(self, src: str, dest: str) -> None:
        self._store.copy_file(src, dest)
