"""Headers of the pages of a Parquet file, which Arrow believes: it allocates as many bytes as one states before it looks at the page.

A file of a few kilobytes can state 2 GiB for each column. The footer states the bytes of each column too, and limits hold for these; so a
page must not state more than its column. The format is that of ``PageHeader`` in the Thrift definition of Parquet, in Thrift's compact
protocol.
"""

import mmap
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _STRUCT = 0, 1, 2, 3, 7, 8, 12
_INTEGERS = (4, 5, 6)
_UNCOMPRESSED, _COMPRESSED = 2, 3
_DEEPEST = 8  # structures within each other; those of a page are three deep
_LONGEST = 10  # bytes of a number
_MOST_PAGES = 100_000  # of a column of a row group


def check_pages(path: Path, footer: pq.FileMetaData) -> None:
    """Refuses a file of which a page states more bytes than its column.

    Args:
        path: The file.
        footer: Its footer.

    Raises:
        pyarrow.ArrowInvalid: A page states more bytes than its column does, or its header cannot be read.
        OSError: The file cannot be read.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for group in range(footer.num_row_groups):
            columns = footer.row_group(group)
            for number in range(columns.num_columns):
                _check_column(data, columns.column(number))


def stated_bytes(columns: pq.RowGroupMetaData) -> int:
    """Returns how many bytes a row group, or all of its columns together, states to need."""
    of_columns = sum(columns.column(k).total_uncompressed_size for k in range(columns.num_columns))
    found: int = max(columns.total_byte_size, of_columns)
    return found


def _check_column(data: mmap.mmap, column: pq.ColumnChunkMetaData) -> None:
    starts = (column.dictionary_page_offset, column.data_page_offset)
    at = min((start for start in starts if start), default=0)
    end = at + column.total_compressed_size
    for _ in range(_MOST_PAGES):
        if at >= end:
            return
        try:
            sizes, at = _integers(data, at, 0)
            uncompressed, compressed = sizes[_UNCOMPRESSED], sizes[_COMPRESSED]
        except (LookupError, ValueError) as error:
            raise pa.ArrowInvalid(f"column {column.path_in_schema}: the header of a page cannot be read ({error})") from error
        if not (0 <= uncompressed <= column.total_uncompressed_size and compressed >= 0):
            raise pa.ArrowInvalid(
                f"column {column.path_in_schema}: a page states {uncompressed:,} bytes, expected at most those of its column, "
                f"{column.total_uncompressed_size:,}"
            )
        at += compressed
    raise pa.ArrowInvalid(f"column {column.path_in_schema}: has over {_MOST_PAGES:,} pages, expected fewer")


def _integers(data: mmap.mmap, at: int, depth: int) -> tuple[dict[int, int], int]:
    """The integers of a structure by the number of their field, and where it ends."""
    if depth > _DEEPEST:
        raise ValueError("structures within structures")
    found: dict[int, int] = {}
    field = 0
    while (head := data[at]) != _STOP:
        kind, at = head & 15, at + 1
        if head >> 4:
            field += head >> 4
        else:
            field, at = _zigzag(data, at)
        if kind in _INTEGERS:
            found[field], at = _zigzag(data, at)
        else:
            at = _after(data, at, kind, depth)
    return found, at + 1


def _after(data: mmap.mmap, at: int, kind: int, depth: int) -> int:
    """Where a value of a kind ends that begins here."""
    if kind in (_TRUE, _FALSE):  # the kind is the value
        return at
    if kind == _BYTE:
        return at + 1
    if kind == _DOUBLE:
        return at + 8
    if kind == _BINARY:
        length, at = _varint(data, at)
        return at + length
    if kind == _STRUCT:
        return _integers(data, at, depth + 1)[1]
    raise ValueError(f"a value of kind {kind}, which no page has")


def _zigzag(data: mmap.mmap, at: int) -> tuple[int, int]:
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _varint(data: mmap.mmap, at: int) -> tuple[int, int]:
    value = 0
    for k in range(_LONGEST):
        byte = data[at + k]
        value |= (byte & 127) << (7 * k)
        if byte < 128:
            return value, at + k + 1
    raise ValueError("a number without an end")
