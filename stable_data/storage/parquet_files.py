"""Parquet files of others are opened and read with bounded memory, and with errors of Arrow alone."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.fs as pafs
import pyarrow.parquet as pq

from stable_data.errors import ConfigError
from stable_data.limits import LIMITS, at_most
from stable_data.storage.page_headers import check_pages

_CHECKED: dict[tuple[str, int, int, int], int] = {}  # the most bytes of the lists of files
_MOST_CHECKED = 10_000  # files that a process remembers
_PARTS = 8  # a batch has an eighth of the memory that rows may have: those who look at it make copies
_Rows = TypeVar("_Rows", pa.RecordBatch, pa.Table)


def open_parquet(source: Any, **options: Any) -> pq.ParquetFile:
    """Opens a Parquet file.

    Args:
        source: Its path or stream.
        options: As for :class:`pyarrow.parquet.ParquetFile`.

    Raises:
        pyarrow.ArrowException: It is no Parquet file, the name of a column is not UTF-8, or pages of a local file state more bytes than
            their column or row group, or too many values (:mod:`stable_data.storage.page_headers`).
        OSError: It cannot be read.
    """
    try:
        file = pq.ParquetFile(source, **options)
    except UnicodeDecodeError as error:  # Arrow decodes the names of columns only now
        raise pa.ArrowInvalid(f"the name of a column is not UTF-8: {error}") from error
    if isinstance(source, (str, Path)) and isinstance(options.get("filesystem"), (NoneType, pafs.LocalFileSystem)):
        _check_once(str(source))
    return file


def _check_once(path: str) -> int:
    """Checks the pages of a local file, unless this process has checked it as it is now; returns the most bytes of its lists."""
    about = Path(path).stat()
    key = (path, about.st_ino, about.st_size, about.st_mtime_ns)
    if key not in _CHECKED:
        num_bytes = check_pages(Path(path))
        if len(_CHECKED) >= _MOST_CHECKED:
            _CHECKED.clear()
        _CHECKED[key] = num_bytes
    return _CHECKED[key]


def read_row_groups(
    file: pq.ParquetFile, path: str, groups: Iterable[int], columns: Sequence[str] | None = None, *, use_threads: bool = True
) -> pa.Table:
    """Reads row groups of a Parquet file a few rows at a time, since a small file may decode to very many bytes.

    Args:
        file: The file.
        path: Path of the file, for the message.
        groups: Indices of the row groups.
        columns: Columns or leaves of columns, as Parquet names them, or None for all.
        use_threads: Whether columns are decoded in parallel.

    Raises:
        ConfigError: The row groups need too much memory (``shard_too_big``).
    """
    batches, size = list[pa.RecordBatch](), 0
    for batch in bounded_batches(file, path, groups, columns, use_threads=use_threads):
        size += batch.nbytes
        if size > LIMITS.table.max_decoded_bytes:
            raise _too_big(path, "one file of a table")
        batches.append(batch)
    # Batches, not tables: a concatenation of tables without columns loses the number of their rows.
    return pa.Table.from_batches(batches) if batches else file.read_row_groups([], columns)


def bounded_batches(
    file: pq.ParquetFile,
    path: str,
    groups: Iterable[int],
    columns: Sequence[str] | None = None,
    *,
    most_rows: int | None = None,
    use_threads: bool = True,
) -> Iterator[pa.RecordBatch]:
    """Yields the rows of row groups in batches that need little memory each; see :func:`read_row_groups`.

    Args:
        file: The file.
        path: Path of the file, for the message.
        groups: Indices of the row groups.
        columns: Columns or leaves of columns, as Parquet names them, or None for all.
        most_rows: Rows of a batch, or None for all of a row group if they need little memory.
        use_threads: Whether columns are decoded in parallel.

    Raises:
        ConfigError: A row group states more bytes than the limit (``shard_too_big``).
        pyarrow.ArrowInvalid: Values are broken, see :func:`checked`.
    """
    limit = LIMITS.table.max_decoded_bytes
    for group in groups:
        footer = file.metadata.row_group(group)
        if (stated := footer.total_byte_size) > limit:
            raise _too_big(path, "one row group")
        # No value is larger than the bytes of its row group, and the values of lists are counted.
        rows = limit // max(stated, 1)
        if most_rows is None and footer.num_rows <= rows:
            batches = iter(file.read_row_group(group, columns, use_threads=use_threads).to_batches())  # faster than in steps
        else:
            few = max(1, rows // _PARTS)
            batches = file.iter_batches(min(few, most_rows or few), [group], columns, use_threads=use_threads)
        yield from map(checked, batches)


def checked(rows: _Rows) -> _Rows:
    """Returns rows of a file of others as they are, if all values are what their types say: Arrow reads text that is none.

    Raises:
        pyarrow.ArrowInvalid: A text is not UTF-8, or an offset is wrong.
    """
    rows.validate(full=True)
    return rows


def is_small(fragment: ds.ParquetFileFragment) -> bool:
    """Returns whether a file cannot need too much memory; see :func:`bounded_batches`.

    Raises:
        pyarrow.ArrowException: As :func:`open_parquet`.
        OSError: Likewise.
    """
    most = sum(group.num_rows * group.total_byte_size for group in fragment.row_groups)
    if isinstance(fragment.filesystem, pafs.LocalFileSystem):
        most += _check_once(fragment.path)
    return bool(most <= LIMITS.table.max_decoded_bytes)


def _too_big(path: str, of: str) -> ConfigError:
    return ConfigError(
        f"{path}: needs more memory, expected {at_most(LIMITS.table, 'max_decoded_bytes', 'bytes')} for {of}; "
        "the file may be malicious; if you trust it, write its rows to several files",
        "shard_too_big",
    )
