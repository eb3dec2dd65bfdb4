"""The rows of a table that pass a condition, file by file: counted, or read in bounded memory."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from stable_data.errors import cannot_read
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.parquet_files import open_parquet, read_row_groups
from stable_data.storage.row_groups import ColumnCheck, chosen_rows, possible_groups
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schema_checks import conform_to_schema, warn_of_missing_columns
from stable_data.storage.schemas import SCHEMAS

_AHEAD_LOCAL, _AHEAD = 2, 8  # files that are read while another one is processed

T = TypeVar("T")


class TableScan:
    """The rows of a table of a run that pass a condition.

    Only the columns that the condition names are read of all rows. Row groups that the statistics of the files exclude are not
    read. A few files are in memory at a time. A warning names the columns that the run lacks, at the end of a scan.

    Args:
        run: The run.
        table: Name in SCHEMAS.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.

    Raises:
        ConfigError: The condition is not valid, or the run has no such table.
    """

    def __init__(self, run: RunFolder, table: str, where: str) -> None:
        self._run, self._table, self._schema = run, table, SCHEMAS[table]
        self._query = parse_filter(where, self._schema)
        self._paths = run.files(table)
        if not self._paths:
            run.dataset(table)  # raises the error that describes the missing table

    def count(self) -> tuple[int, int]:
        """Returns the number of rows that pass, and the number of all rows.

        Raises:
            ConfigError: A file cannot be read, or was written by another version.
        """
        counts = list(self._each(self._count))
        return sum(found for found, _ in counts), sum(total for _, total in counts)

    def tables(self, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
        """Yields the rows that pass, those of a file at a time.

        Args:
            columns: Their columns, or None for all.

        Raises:
            ConfigError: As :meth:`count`.
        """
        schema = self._schema if columns is None else pa.schema([self._schema.field(name) for name in columns])
        yield from self._each(partial(self._rows, schema))

    def _each(self, read: Callable[[pq.ParquetFile, str, list[int]], T]) -> Iterator[T]:
        """Applies a function to each file, in order; the next few files are read meanwhile."""
        check, missing, waiting = ColumnCheck(self._table, self._schema), dict[str, None](), deque[Future[T]]()
        ahead = _AHEAD_LOCAL if self._run.is_local else _AHEAD

        def apply(path: str) -> T:
            with self._opened(path) as (file, fragment):
                missing.update(dict.fromkeys(check.missing(file, f"{self._run.uri}: {path}")))
                return read(file, path, possible_groups(fragment, self._query, self._schema))

        with ThreadPoolExecutor(ahead) as pool:
            for path in self._paths:
                waiting.append(pool.submit(apply, path))
                if len(waiting) > ahead:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        warn_of_missing_columns(self._run.uri, self._table, missing, self._query.columns)

    @contextmanager
    def _opened(self, path: str) -> Iterator[tuple[pq.ParquetFile, ds.ParquetFileFragment]]:
        """Opens a file, whose footer is read once."""
        files = self._run.filesystem
        try:
            fragment = ds.ParquetFileFormat().make_fragment(path, files)
            with open_parquet(path, filesystem=files, metadata=fragment.metadata, pre_buffer=not self._run.is_local) as file:
                yield file, fragment
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(self._run.uri, path, error) from error

    def _count(self, file: pq.ParquetFile, path: str, groups: list[int]) -> tuple[int, int]:
        return len(chosen_rows(file, path, groups, self._query, self._schema)), file.metadata.num_rows

    def _rows(self, schema: pa.Schema, file: pq.ParquetFile, path: str, groups: list[int]) -> pa.Table:
        chosen = chosen_rows(file, path, groups, self._query, self._schema)
        starts = np.cumsum([0, *(file.metadata.row_group(group).num_rows for group in groups)])
        parts = [schema.empty_table()]
        for group, own, start in zip(groups, np.split(chosen, np.searchsorted(chosen, starts[1:-1])), starts, strict=False):
            if len(own):
                there = [name for name in schema.names if name in file.schema_arrow.names]
                rows = read_row_groups(file, path, [group], there, use_threads=False)
                parts.append(conform_to_schema(rows if len(own) == rows.num_rows else rows.take(own - start), schema))
        return pa.concat_tables(parts)
