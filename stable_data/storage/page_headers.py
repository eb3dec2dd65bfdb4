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

from stable_data.limits import LIMITS, at_most

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 12
_INTEGERS = (4, 5, 6)
_DEEPEST = 12  # values within each other; those of Parquet are eight deep
_LONGEST = 10  # bytes of a number
_MOST_PAGE_VALUES = 100  # of the header of a page, which has about twenty
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
        end, num_pages = len(data) - _TAIL, 0
        try:
            start = end - int.from_bytes(data[end : end + 4], "little")
            footer = _Reader(data, start, LIMITS.table.max_footer_values, at_most(LIMITS.table, "max_footer_values")).struct()
            for group in footer[_ROW_GROUPS]:
                columns = [column[_METADATA] for column in group[_COLUMNS]]
                if (of_columns := sum(column[_COLUMN_BYTES] for column in columns)) > group[_BYTES]:
                    raise pa.ArrowInvalid(f"a row group states {group[_BYTES]:,} bytes, but its columns state {of_columns:,}")
                for column in columns:
                    num_pages += _check_column(data, column, LIMITS.table.max_pages - num_pages)
        except pa.ArrowInvalid:
            raise
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise pa.ArrowInvalid(f"its metadata cannot be read: {error!r}") from error


def _check_column(data: mmap.mmap, column: _Struct, most_pages: int) -> int:
    """Checks the pages of a column of a row group, and returns their number."""
    at = min((start for start in (column[_DATA_START], column.get(_DICTIONARY_START)) if start), default=0)
    end, left, num_pages = at + column[_COMPRESSED_BYTES], column[_COLUMN_BYTES], 0
    while at < end:
        num_pages += 1
        if num_pages > most_pages:
            raise pa.ArrowInvalid(f"it has more pages, expected {at_most(LIMITS.table, 'max_pages')}")
        reader = _Reader(data, at, _MOST_PAGE_VALUES, f"at most {_MOST_PAGE_VALUES}")
        page = reader.struct()
        size, compressed = page[_PAGE_BYTES], page[_COMPRESSED_PAGE_BYTES]
        left -= size
        if left < 0 or size < 0 or compressed < 0:
            raise pa.ArrowInvalid(
                f"column {_name(column)}: a page states {size:,} bytes, expected at most what is left of those of its column, "
                f"{left + size:,}"
            )
        at = reader.at + compressed
    return num_pages


def _name(column: _Struct) -> str:
    return b".".join(column[_PATH]).decode(errors="replace")


class _Reader:
    """Reads structures in the compact protocol of Thrift.

    Args:
        data: The file.
        at: Where the structure begins.
        most_values: Values that it may have, with those within others.
        told: The same in words.

    Attributes:
        at: Where what was read ends.
    """

    def __init__(self, data: mmap.mmap, at: int, most_values: int, told: str) -> None:
        self._data, self.at, self._left, self._told = data, at, most_values, told

    def struct(self, depth: int = 0) -> _Struct:
        """Reads the values of a structure by the numbers of their fields.

        Raises:
            LookupError: The file ends before the structure does.
            ValueError: It is none of Parquet.
        """
        found: _Struct = {}
        field = 0
        while (head := self._data[self.at]) != _STOP:
            kind = head & 15
            self.at += 1
            field = field + (head >> 4) if head >> 4 else self._number()
            if kind in (_TRUE, _FALSE):  # the kind is the value
                found[field] = kind == _TRUE
            else:
                found[field] = self._value(kind, depth + 1)
        self.at += 1
        return found

    def _value(self, kind: int, depth: int) -> Any:
        self._left -= 1
        if depth > _DEEPEST or self._left < 0:
            raise ValueError(f"more values, expected {self._told}, at most {_DEEPEST} within each other")
        if kind in _INTEGERS:
            return self._number()
        if kind == _BINARY:
            return self._bytes(self._varint())
        if kind == _STRUCT:
            return self.struct(depth)
        if kind in (_LIST, _SET):
            return self._list(depth)
        if kind in (_TRUE, _FALSE, _BYTE):
            return self._byte()
        if kind == _DOUBLE:
            return self._bytes(8)
        raise ValueError(f"a value of kind {kind}, which Parquet does not have")

    def _list(self, depth: int) -> list[Any]:
        head = self._byte()
        length = head >> 4 if head >> 4 < 15 else self._varint()
        return [self._value(head & 15, depth + 1) for _ in range(length)]

    def _bytes(self, length: int) -> bytes:
        self.at += length
        return self._data[self.at - length : self.at]

    def _byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]

    def _number(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)

    def _varint(self) -> int:
        value = 0
        for k in range(_LONGEST):
            byte = self._data[self.at]
            self.at += 1
            value |= (byte & 127) << (7 * k)
            if byte < 128:
                return value
        raise ValueError("a number without an end")
