"""What the pages of a Parquet file state, which Arrow believes: it makes room for as many bytes as a page states before it looks at it.

A file of a few kilobytes can state 2 GiB for each column, and hold pages that decompress to as many. The footer states the bytes of each
row group too, and limits hold for these; so the columns of a row group must not state more than it, nor the pages of a column more than
the column. The footer is read here a second time, since ``RowGroupMetaData.column`` of pyarrow ends the process for some broken ones. The
format is Parquet's, ``FileMetaData`` and ``PageHeader``, in the compact protocol of Thrift.
"""

import mmap
from pathlib import Path
from typing import Any

import pyarrow as pa

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 12
_INTEGERS = (4, 5, 6)
_DEEPEST = 12  # values within each other; those of Parquet are eight deep
_LONGEST = 10  # bytes of a number
_MOST_PAGES = 100_000  # of a column of a row group
_TAIL = 8  # the length of the footer and a mark, after the footer

# Numbers of the fields that are read.
_ROW_GROUPS = 4  # of FileMetaData
_COLUMNS, _BYTES = 1, 2  # of RowGroup
_METADATA = 3  # of ColumnChunk
_PATH, _COLUMN_BYTES, _COMPRESSED_BYTES, _DATA_START, _DICTIONARY_START = 3, 6, 7, 9, 11  # of ColumnMetaData
_PAGE_BYTES, _COMPRESSED_PAGE_BYTES = 2, 3  # of PageHeader

_Struct = dict[int, Any]


def check_pages(path: Path) -> None:
    """Refuses a file in which a column states more bytes than its row group, or pages more than their column.

    Args:
        path: The file, which Arrow has opened.

    Raises:
        pyarrow.ArrowInvalid: A column or a page states too many bytes, or the footer or the header of a page cannot be read.
        OSError: The file cannot be read.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        end = len(data) - _TAIL
        try:
            footer, _ = _read_struct(data, end - int.from_bytes(data[end : end + 4], "little"), 0)
            for group in footer[_ROW_GROUPS]:
                columns = [column[_METADATA] for column in group[_COLUMNS]]
                if (of_columns := sum(column[_COLUMN_BYTES] for column in columns)) > group[_BYTES]:
                    raise pa.ArrowInvalid(f"a row group states {group[_BYTES]:,} bytes, but its columns state {of_columns:,}")
                for column in columns:
                    _check_column(data, column)
        except (LookupError, TypeError, ValueError) as error:
            raise (
                error if isinstance(error, pa.ArrowInvalid) else pa.ArrowInvalid(f"its metadata cannot be read: {error!r}")
            ) from error


def _check_column(data: mmap.mmap, column: _Struct) -> None:
    at = min((start for start in (column[_DATA_START], column.get(_DICTIONARY_START)) if start), default=0)
    end, left = at + column[_COMPRESSED_BYTES], column[_COLUMN_BYTES]
    for _ in range(_MOST_PAGES):
        if at >= end:
            return
        page, at = _read_struct(data, at, 0)
        size, compressed = page[_PAGE_BYTES], page[_COMPRESSED_PAGE_BYTES]
        left -= size
        if left < 0 or size < 0 or compressed < 0:
            raise pa.ArrowInvalid(
                f"column {_name(column)}: a page states {size:,} bytes, expected at most what is left of those of its column, "
                f"{left + size:,}"
            )
        at += compressed
    raise pa.ArrowInvalid(f"column {_name(column)}: has over {_MOST_PAGES:,} pages, expected fewer")


def _name(column: _Struct) -> str:
    return b".".join(column[_PATH]).decode(errors="replace")


def _read_struct(data: mmap.mmap, at: int, depth: int) -> tuple[_Struct, int]:
    """The values of a structure by the numbers of their fields, and where it ends."""
    found: _Struct = {}
    field = 0
    while (head := data[at]) != _STOP:
        kind, at = head & 15, at + 1
        if head >> 4:
            field += head >> 4
        else:
            field, at = _read_number(data, at)
        if kind in _INTEGERS:
            found[field], at = _read_number(data, at)
        elif kind in (_TRUE, _FALSE):  # the kind is the value
            found[field] = kind == _TRUE
        else:
            found[field], at = _read_value(data, at, kind, depth + 1)
    return found, at + 1


def _read_value(data: mmap.mmap, at: int, kind: int, depth: int) -> tuple[Any, int]:
    """The value of a kind that begins here, and where it ends."""
    if depth > _DEEPEST:
        raise ValueError("values within values")
    if kind in _INTEGERS:
        return _read_number(data, at)
    if kind == _BINARY:
        length, at = _read_varint(data, at)
        return data[at : at + length], at + length
    if kind == _STRUCT:
        return _read_struct(data, at, depth)
    if kind in (_LIST, _SET):
        return _read_list(data, at, depth)
    if kind in (_TRUE, _FALSE, _BYTE):
        return data[at], at + 1
    if kind == _DOUBLE:
        return data[at : at + 8], at + 8
    raise ValueError(f"a value of kind {kind}, which Parquet does not have")


def _read_list(data: mmap.mmap, at: int, depth: int) -> tuple[list[Any], int]:
    length, kind, at = data[at] >> 4, data[at] & 15, at + 1
    if length == 15:
        length, at = _read_varint(data, at)
    values = []
    for _ in range(length):  # each takes a byte at least, so the file ends before a false length does
        value, at = _read_value(data, at, kind, depth + 1)
        values.append(value)
    return values, at


def _read_number(data: mmap.mmap, at: int) -> tuple[int, int]:
    byte = data[at]
    value, at = (byte, at + 1) if byte < 128 else _read_varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _read_varint(data: mmap.mmap, at: int) -> tuple[int, int]:
    value = 0
    for k in range(_LONGEST):
        byte = data[at + k]
        value |= (byte & 127) << (7 * k)
        if byte < 128:
            return value, at + k + 1
    raise ValueError("a number without an end")
