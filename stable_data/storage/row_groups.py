"""The row groups of a table of one or several runs: listed once, then read one by one, also in worker processes."""

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from stable_data.content_id import content_id
from stable_data.errors import ConfigError, cannot_read
from stable_data.scene import IntArray
from stable_data.storage.filter_expression import FilterExpression, parse_filter
from stable_data.storage.parquet_files import open_parquet, read_row_groups
from stable_data.storage.run_folder import RunFolder, Uri
from stable_data.storage.schema_checks import check_schema, conform_to_schema, missing_columns, warn_of_missing_columns
from stable_data.storage.schemas import SCHEMAS, Row

SPLITS = ("train", "validation", "test", "unseen")
"""The values of the column ``split``."""

Places: TypeAlias = Mapping[str, Mapping[int, IntArray]]
"""Path of a file -> number of a row group -> rows of the row group, ascending, (N,) int64."""

_REQUESTS = 16  # concurrent reads of an object store
_ARRAYS = (pa.float16(), pa.float32(), pa.int32())  # element types of lists that become numpy arrays
_SLICE_BYTES = 4 * 2**20
_SCHEMA = b"ARROW:schema"  # metadata of a file: its schema as Arrow writes it
_NUMBER = ".row"  # temporary column; no column of a table starts with a dot


@dataclass(frozen=True, slots=True, eq=False)
class RowGroup:
    """One row group of one file.

    Attributes:
        run: Index of the run.
        path: Path of the file, as its file system names it.
        index: Index of the row group in the file.
        num_rows: Number of selected rows.
        num_bytes: Size of all columns and rows, decompressed.
        chosen: Indices of the selected rows, (num_rows,) int64, or None for all rows.
    """

    run: int
    path: str
    index: int
    num_rows: int
    num_bytes: int
    chosen: IntArray | None = None


class TableFiles:
    """The row groups of a table in the order of its files.

    A column that a file lacks, because the file is older than the column, is read as null; a warning names the column.

    Args:
        uri: The run folder, or several, whose rows follow one another.
        table: Name in SCHEMAS.
        leaves: Columns or leaves of columns, as Parquet names them, or None for all.
        split: Split of the rows, or None for all rows. Other rows are removed before decoding.
        where: Condition on the rows (:mod:`stable_data.storage.filter_expression`), or None for all rows. Other rows are
            removed before decoding, and row groups that the statistics of the files exclude are not opened.
        places: Only these rows (:meth:`stable_data.storage.scene_index.SceneIndex.places`) of the only run; None: all.

    Attributes:
        uri: The run folder, or all run folders in one string.
        split: The argument.
        where: The argument.
        groups: The row groups with at least one selected row.
        starts: Index of the first row of each row group, and the total number of rows, (groups + 1,) int64.

    Raises:
        ConfigError: The table is missing, was written by another version or cannot be read; the split or a column does not
            exist; or no run is given, or one run twice.
    """

    def __init__(
        self,
        uri: Uri | Sequence[Uri],
        table: str,
        leaves: Sequence[str] | None,
        split: str | None = None,
        where: str | None = None,
        places: Places | None = None,
    ) -> None:
        _check_split(table, split)
        self._uris = [os.fspath(one) for one in ([uri] if isinstance(uri, str | os.PathLike) else uri)]
        self.uri, self.split, self.where = ", ".join(self._uris), split, where
        self._table = table
        self._leaves = None if leaves is None else list(leaves)
        self._folders, self._process = [RunFolder(uri) for uri in self._uris], os.getpid()
        roots = {folder.root if folder.is_local else folder.uri for folder in self._folders}
        if not roots or len(roots) < len(self._folders):
            raise ConfigError(f"runs are [{self.uri}], expected at least one run and no duplicates", "runs_invalid")
        paths = [(run, path) for run, folder in enumerate(self._folders) for path in self._paths(folder)]
        if places is not None:
            paths = [(run, path) for run, path in paths if path in places]
        self._schema, self._places = leaf_schema(SCHEMAS[table], leaves), places
        query = self._query()  # once, before the threads: concurrent parsing in Python 3.11 may fail
        expected = [*self._schema, *(SCHEMAS[table].field(name) for name in (query.columns if query else ()))]
        check = ColumnCheck(table, expected)
        with ThreadPoolExecutor(_REQUESTS) as pool:
            listed = list(pool.map(lambda found: self._list_groups(found[0], found[1], query, check), paths))
        self.groups = [group for groups, _ in listed for group in groups]
        warn_of_missing_columns(
            self.uri, table, (name for _, names in listed for name in names), query.columns if query else ()
        )
        self.starts: IntArray = np.cumsum([0, *(group.num_rows for group in self.groups)], dtype=np.int64)

    def __len__(self) -> int:
        """Number of rows."""
        return int(self.starts[-1])

    @property
    def fingerprint(self) -> str:
        """Hash of the selected rows and their order."""
        return content_id([(group.run, group.path.rpartition("/")[2], group.index, group.num_rows) for group in self.groups])

    def read(self, groups: Sequence[int], *, use_threads: bool = False) -> pa.Table:
        """Reads the rows of some row groups, in the given order.

        Raises:
            ConfigError: A file was changed or removed in the meantime.
        """
        if self._process != os.getpid():  # after a fork: a file system cannot be shared with the parent process
            self._folders, self._process = [RunFolder(uri) for uri in self._uris], os.getpid()
        of_files = [list(of_file) for _, of_file in groupby((self.groups[g] for g in groups), lambda g: (g.run, g.path))]
        if len(of_files) == 1 or all(self._folders[of_file[0].run].is_local for of_file in of_files):
            return pa.concat_tables([self._read_file(of_file, use_threads) for of_file in of_files])
        with ThreadPoolExecutor(_REQUESTS) as pool:  # an object store has a high latency but serves many requests at once
            return pa.concat_tables(pool.map(lambda of_file: self._read_file(of_file, False), of_files))

    def _read_file(self, groups: list[RowGroup], use_threads: bool) -> pa.Table:
        """Reads row groups of one file."""
        folder, path = self._folders[groups[0].run], groups[0].path
        try:
            with open_parquet(path, filesystem=folder.filesystem, pre_buffer=True) as file:
                parts = [read_row_groups(file, path, [g.index], self._leaves, use_threads=use_threads) for g in groups]
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(folder.uri, path, error) from error
        return pa.concat_tables(
            conform_to_schema(part if g.chosen is None else part.take(g.chosen), self._schema)
            for part, g in zip(parts, groups, strict=True)
        )

    def _paths(self, folder: RunFolder) -> list[str]:
        paths = folder.files(self._table)
        if not paths:
            folder.dataset(self._table)  # raises the error that describes the missing table
        return paths

    def _list_groups(
        self, run: int, path: str, query: FilterExpression | None, check: "ColumnCheck"
    ) -> tuple[list[RowGroup], list[str]]:
        """Lists the row groups of a file that have selected rows, and the requested columns that it lacks."""
        folder, schema = self._folders[run], SCHEMAS[self._table]
        try:
            fragment = ds.ParquetFileFormat().make_fragment(path, folder.filesystem)
            with open_parquet(path, filesystem=folder.filesystem, metadata=fragment.metadata) as file:
                missing = check.missing(file, f"{folder.uri}: {path}")
                possible = range(file.num_row_groups) if query is None else possible_groups(fragment, query, schema)
                rows = None if self._places is None else self._places[path]
                groups = [
                    _row_group(run, path, file, index, query, schema, None if rows is None else rows[index])
                    for index in possible
                    if rows is None or index in rows
                ]
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(folder.uri, path, error) from error
        return [group for group in groups if group.num_rows], missing

    def _query(self) -> FilterExpression | None:
        """Returns the condition of ``split`` and ``where`` together."""
        parts = ([f"split == {self.split!r}"] if self.split else []) + ([f"({self.where})"] if self.where else [])
        if self.where:
            parse_filter(self.where, SCHEMAS[self._table])  # alone first, so that an error quotes the user's text only
        return parse_filter(" and ".join(parts), SCHEMAS[self._table]) if parts else None


class ColumnCheck:
    """Checks the files of a table against its schema; a schema that the file before has is not checked again.

    The files of a run nearly always have one schema, and its conversion to Arrow takes as long as opening a small file.
    """

    def __init__(self, table: str, expected: Sequence[pa.Field]) -> None:
        self._table, self._expected = table, expected
        self._last: tuple[int, dict[bytes, bytes], list[str]] | None = None

    def missing(self, file: pq.ParquetFile, where: str) -> list[str]:
        """Returns the expected columns that a file lacks.

        Raises:
            ConfigError: As for :func:`stable_data.storage.schema_checks.check_schema`.
        """
        # Not file.schema: it and the footer refer to each other, so that the footers of all files would stay in memory.
        last, num_leaves, metadata = self._last, file.metadata.num_columns, file.metadata.metadata or {}
        if last is not None and _SCHEMA in metadata and last[:2] == (num_leaves, metadata):
            return last[2]
        schema = file.schema_arrow
        check_schema(schema, self._table, where)
        missing = missing_columns(schema, self._expected)
        self._last = num_leaves, metadata, missing  # one assignment: the threads that share this object see all of it
        return missing


def possible_groups(fragment: ds.ParquetFileFragment, query: FilterExpression, schema: pa.Schema) -> list[int]:
    """Returns the row groups of a file that its statistics do not exclude."""
    return [group.id for group in fragment.subset(query.expression, schema=schema).row_groups]


def _row_group(
    run: int,
    path: str,
    file: pq.ParquetFile,
    index: int,
    query: FilterExpression | None,
    schema: pa.Schema,
    rows: IntArray | None,
) -> RowGroup:
    footer = file.metadata.row_group(index)
    if query is None:
        return RowGroup(run, path, index, footer.num_rows if rows is None else len(rows), footer.total_byte_size, rows)
    chosen = chosen_rows(file, path, [index], query, schema)
    chosen = chosen if rows is None else np.intersect1d(rows, chosen, assume_unique=True)
    return RowGroup(run, path, index, len(chosen), footer.total_byte_size, chosen)


def chosen_rows(file: pq.ParquetFile, path: str, groups: Sequence[int], query: FilterExpression, schema: pa.Schema) -> IntArray:
    """Returns the rows of some row groups that pass a condition, (N,) int64, counted from the first row of the first one.

    Raises:
        ConfigError: The columns of the condition need too much memory.
    """
    columns = conform_to_schema(
        read_row_groups(file, path, groups, list(query.columns), use_threads=False),
        pa.schema([schema.field(name) for name in query.columns]),
    )
    numbers = pa.array(np.arange(columns.num_rows))
    return np.asarray(query.rows(columns.append_column(_NUMBER, numbers))[_NUMBER].to_numpy(), np.int64)


def leaf_schema(schema: pa.Schema, leaves: Sequence[str] | None) -> pa.Schema:
    """Returns the columns of a schema, and the fields of their structs, that contain one of some leaves.

    Args:
        schema: Schema of a table.
        leaves: Columns or leaves of columns, as Parquet names them, or None for all.
    """
    if leaves is None:
        return schema
    paths = [leaf.split(".") for leaf in leaves]
    columns = [(column, [path[1:] for path in paths if path[0] == column.name]) for column in schema]
    return pa.schema([column.with_type(_leaf_type(column.type, under)) for column, under in columns if under], schema.metadata)


def _leaf_type(type_: pa.DataType, paths: list[list[str]]) -> pa.DataType:
    if [] in paths:
        return type_
    if pa.types.is_list(type_):
        return pa.list_(_leaf_type(type_.value_type, [path[2:] for path in paths]))  # Parquet's levels "list" and "element"
    fields = [(field, [path[1:] for path in paths if path[0] == field.name]) for field in type_]
    return pa.struct([field.with_type(_leaf_type(field.type, under)) for field, under in fields if under])


def check_columns(table: str, columns: Sequence[str] | None) -> None:
    """Checks that a table has some columns.

    Raises:
        ConfigError: A column does not exist (``column_unknown``).
    """
    known = SCHEMAS[table].names if table in SCHEMAS else []
    unknown = [name for name in columns or () if name not in known]
    if unknown and known:
        raise ConfigError(f"table {table} has no columns {unknown}, expected some of {', '.join(known)}", "column_unknown")


def _check_split(table: str, split: str | None) -> None:
    """Checks that a table has a split."""
    if split is None:
        return
    if table in SCHEMAS and "split" not in SCHEMAS[table].names:
        raise ConfigError(f"table {table} has no splits, expected the table scenes or samples; omit split", "split_unknown")
    if split not in SPLITS:
        raise ConfigError(f"split is {split!r}, expected one of {', '.join(SPLITS)}, or None for all rows", "split_unknown")


def row_slices(table: pa.Table) -> Iterator[pa.Table]:
    """Yields slices of a table of about 4 MB: as Python objects, rows need many times the memory."""
    step = max(1, table.num_rows * _SLICE_BYTES // max(1, table.nbytes))
    return (table.slice(start, step) for start in range(0, table.num_rows, step))


def rows_from_table(table: pa.Table) -> list[Row]:
    """Returns rows as dictionaries; lists of float16, float32 and int32 (point clouds and grids) become numpy arrays."""
    columns = [_values(column) for column in table.columns]
    return [dict(zip(table.column_names, values, strict=True)) for values in zip(*columns, strict=True)]


def _values(column: pa.ChunkedArray) -> list[Any]:
    if not (pa.types.is_list(column.type) and column.type.value_type in _ARRAYS):
        return list(column.to_pylist())
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    ends = np.cumsum(pc.fill_null(pc.list_value_length(column), 0).to_numpy()).tolist()
    # Copies, because a view is read-only for torch and keeps the whole row group in memory.
    arrays = (flat[start:end].copy() for start, end in pairwise([0, *ends]))
    return [array if valid else None for array, valid in zip(arrays, column.is_valid().to_pylist(), strict=True)]
