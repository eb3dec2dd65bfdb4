"""What the pages of a Parquet file state, which Arrow believes: it makes room for as many bytes as a page states before it looks at it.

A file of a few kilobytes can state 2 GiB for each column, and hold pages that decompress to as many. The footer states the bytes of each
row group too, and limits hold for these; so the columns of a row group must not state more than it, nor the pages of a column more than
the column. Equal values take no bytes: of a column of lists, a few bytes can be a billion numbers of one row, or one long text as many
times. So a column has no more values than rows, and the values of lists are counted with the bytes that they take when they are read.

The footer is read here a second time, since ``RowGroupMetaData.column`` of pyarrow ends the process for some broken ones. The format is
Parquet's, ``FileMetaData`` and ``PageHeader``, in the compact protocol of Thrift.
"""

import mmap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from stable_data.limits import LIMITS, at_most

_STOP, _TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 0, 1, 2, 3, 7, 8, 9, 10, 12
_INTEGERS = (4, 5, 6)
_DEEPEST = 12  # values within each other; those of Parquet are eight deep
_LONGEST = 10  # bytes of a number
_MOST_PAGE_VALUES = 100  # of the header of a page, which has about twenty
_TAIL = 8  # the length of the footer and a mark, after the footer

# Numbers of the fields that are read: of FileMetaData,
_SCHEMA, _ROW_GROUPS = 2, 4
# of SchemaElement,
_TYPE, _TYPE_LENGTH, _REPETITION, _NUM_CHILDREN = 1, 2, 3, 5
# of RowGroup and ColumnChunk,
_COLUMNS, _BYTES, _NUM_ROWS, _METADATA = 1, 2, 3, 3
# of ColumnMetaData,
_PATH, _CODEC, _NUM_VALUES, _COLUMN_BYTES, _COMPRESSED_BYTES = 3, 4, 5, 6, 7
_DATA_START, _DICTIONARY_START = 9, 11
# of PageHeader, in which the number of the kind tells where more about a page is,
_PAGE_KIND, _PAGE_BYTES, _COMPRESSED_PAGE_BYTES = 1, 2, 3
_DATA, _DICTIONARY, _DATA_2 = 0, 2, 3
_ABOUT = {_DATA: 5, _DICTIONARY: 7, _DATA_2: 8}
# and of what is there.
_PAGE_VALUES, _ENCODING = 1, {_DATA: 2, _DATA_2: 4}

_REPEATED = 2  # a kind of repetition
_TEXT, _FIXED = 6, 7  # types of values of any length, and of one length
_WIDTHS = {1: 4, 2: 8, 3: 12, 4: 4, 5: 8, _TEXT: 4}  # bytes of a value of the other types, of a text those of its offset
_LEVEL = 8  # bytes that each list around a value may take for it: levels, offset and validity
_DICTIONARIES = (2, 8)  # encodings by numbers of values of a dictionary
_PREFIXES = 7  # that of the letters of a text after those of the one before
_CODECS = {1: "snappy", 2: "gzip", 4: "brotli", 6: "zstd", 7: "lz4_raw"}
_PART = 64  # dictionaries are looked at where lists may need more than this part of the limit
_LARGEST_DICTIONARY = 1 << 24  # bytes of one that is looked at; writers end one at a megabyte
_MOST_LOOKED_AT = 20_000_000  # texts of dictionaries that are looked at for a file, some seconds; 64 bytes count as one

_Content = mmap.mmap | bytes
_Struct = dict[int, Any]


@dataclass(frozen=True, slots=True)
class _Leaf:
    """A column.

    Attributes:
        levels: Lists around each value; without one, a row has one value.
        type: Number of the type of its values.
        width: Bytes of a value when it is read, with the lists around it; of a text, without its letters.
    """

    levels: int
    type: int
    width: int


def check_pages(file: Path | bytes) -> int:
    """Refuses a file in which a column states more bytes than its row group, pages more than their column, or values are too many.

    Args:
        file: The file, or its content, which Arrow has opened.

    Returns:
        The most bytes that the lists of all row groups take when they are read.

    Raises:
        pyarrow.ArrowInvalid: A column or a page states too many bytes, values are too many, or the footer or the header of a page
            cannot be read.
        OSError: The file cannot be read.
    """
    if isinstance(file, bytes):
        return _check_content(file)
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return _check_content(data)


def _check_content(data: _Content) -> int:
    end, num_pages, num_bytes = len(data) - _TAIL, 0, 0
    dictionaries = _Dictionaries(data)
    try:
        start = end - int.from_bytes(data[end : end + 4], "little")
        footer = _Reader(data, start, LIMITS.table.max_footer_values, at_most(LIMITS.table, "max_footer_values")).struct()
        leaves = _leaves(footer[_SCHEMA])
        for group in footer[_ROW_GROUPS]:
            columns = [column[_METADATA] for column in group[_COLUMNS]]
            if (of_columns := sum(column[_COLUMN_BYTES] for column in columns)) > group[_BYTES]:
                raise pa.ArrowInvalid(f"a row group states {group[_BYTES]:,} bytes, but its columns state {of_columns:,}")
            pages = list[list[_Page]]()
            for column in columns:
                pages.append(_read_pages(data, column, LIMITS.table.max_pages - num_pages))
                num_pages += len(pages[-1])
            num_bytes += _check_values(dictionaries, group[_NUM_ROWS], list(zip(leaves, columns, pages, strict=True)))
    except pa.ArrowInvalid:
        raise
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise pa.ArrowInvalid(f"its metadata cannot be read: {error!r}") from error
    return num_bytes


def _leaves(schema: list[_Struct]) -> list[_Leaf]:
    """The columns of a file, whose schema lists each group before what is within it."""
    leaves = list[_Leaf]()
    groups = list[list[int]]()  # of each group that is open, its children to come and the lists around them
    for element in schema:
        while groups and not groups[-1][0]:
            groups.pop()
        levels = (groups[-1][1] if groups else 0) + (element.get(_REPETITION) == _REPEATED)
        if groups:
            groups[-1][0] -= 1
        if not groups or element.get(_NUM_CHILDREN):  # the first one is the group of all columns
            groups.append([element.get(_NUM_CHILDREN, 0), levels])
        else:
            kind = element[_TYPE]
            width = max(element[_TYPE_LENGTH], 1) if kind == _FIXED else _WIDTHS.get(kind, 1)
            leaves.append(_Leaf(levels, kind, width + levels * _LEVEL))
    return leaves


class _Page(NamedTuple):
    """A page: its kind, the number of its values and their encoding, its bytes, and where they are in the file."""

    kind: int
    num_values: int
    encoding: int | None
    size: int
    start: int
    end: int


def _read_pages(data: _Content, column: _Struct, most_pages: int) -> list[_Page]:
    """Reads the headers of the pages of a column of a row group, which must not state more bytes than the column."""
    at = min((start for start in (column[_DATA_START], column.get(_DICTIONARY_START)) if start), default=0)
    end, left, pages = at + column[_COMPRESSED_BYTES], column[_COLUMN_BYTES], list[_Page]()
    while at < end:
        if len(pages) >= most_pages:
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
        start, at = reader.at, reader.at + compressed
        kind = page[_PAGE_KIND]
        about = page[_ABOUT[kind]] if kind in _ABOUT else {_PAGE_VALUES: 0}
        if (num_values := about[_PAGE_VALUES]) < 0:
            raise pa.ArrowInvalid(f"column {_name(column)}: a page states {num_values:,} values, expected a number from 0")
        pages.append(_Page(kind, num_values, about[_ENCODING[kind]] if kind in _ENCODING else None, size, start, at))
    return pages


def _check_values(dictionaries: "_Dictionaries", num_rows: int, columns: list[tuple[_Leaf, _Struct, list[_Page]]]) -> int:
    """Refuses a row group with more values than rows in a column without lists, or whose lists take too many bytes; returns these."""
    for leaf, column, pages in columns:
        num_values = _num_values(column, pages)
        if num_values > num_rows and not leaf.levels:
            raise pa.ArrowInvalid(
                f"column {_name(column)}: has {num_values:,} values, expected one for each of {num_rows:,} rows"
            )
    lists = [each for each in columns if each[0].levels]
    limit = LIMITS.table.max_decoded_bytes
    # That each text may be as long as the dictionary needs no look at it, and is mostly little enough.
    most = sum(_num_bytes(*each, lambda _, page: page.size) for each in lists)
    if most > limit // _PART:
        most = sum(_num_bytes(*each, dictionaries.longest_text) for each in lists)
    if most > limit:
        raise pa.ArrowInvalid(
            f"the lists of a row group may need {most:,} bytes, expected {at_most(LIMITS.table, 'max_decoded_bytes', 'bytes')}; "
            "the file may be malicious; if you trust it, write its rows to several row groups"
        )
    return most


def _num_values(column: _Struct, pages: list[_Page]) -> int:
    """The values of a column, by itself or by its pages, whichever are more."""
    return int(max(column[_NUM_VALUES], sum(page.num_values for page in pages if page.kind != _DICTIONARY)))


def _num_bytes(leaf: _Leaf, column: _Struct, pages: list[_Page], longest_text: Callable[[_Struct, _Page], int]) -> int:
    """The most bytes that the values of a column take when they are read, with the bytes of the longest text of a dictionary."""
    found = leaf.width * _num_values(column, pages)
    if leaf.type == _TEXT:
        dictionary = next((page for page in pages if page.kind == _DICTIONARY), None)
        longest = 0 if dictionary is None else longest_text(column, dictionary)
        for page in pages:
            if page.kind not in _ENCODING:
                continue
            if page.encoding in _DICTIONARIES:
                found += page.num_values * longest
            else:
                found += page.num_values * column[_COLUMN_BYTES] if page.encoding == _PREFIXES else page.size
    return found


class _Dictionaries:
    """Looks at the dictionaries of a file, of which there may be very many: row groups may name the same pages again and again."""

    def __init__(self, data: _Content) -> None:
        self._data, self._left = data, _MOST_LOOKED_AT

    def longest_text(self, column: _Struct, page: _Page) -> int:
        """The bytes of the longest text of a dictionary; of one that is large or cannot be read, or after very many, its own."""
        self._left -= page.num_values + page.size // 64
        codec = column[_CODEC]
        if page.size > _LARGEST_DICTIONARY or self._left < 0 or (codec and codec not in _CODECS):
            return page.size
        content = self._data[page.start : page.end]
        if codec:
            content = pa.Codec(_CODECS[codec]).decompress(content, page.size, asbytes=True)
        at, longest = 0, 0
        for _ in range(page.num_values):
            length = int.from_bytes(content[at : at + 4], "little")
            at, longest = at + 4 + length, max(longest, length)
        return min(longest, page.size)


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

    def __init__(self, data: _Content, at: int, most_values: int, told: str) -> None:
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
