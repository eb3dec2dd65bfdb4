"""Tables of a run for training in PyTorch: by index, or as a stream over ranks and workers that resumes exactly.

The only module of the library that imports torch. Where a run lies on an object store, give the ``DataLoader``
``multiprocessing_context="spawn"``: the clients of object stores do not survive a fork.
"""

import os
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from typing import Any, TypeAlias, TypedDict

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from stable_data.errors import ConfigError
from stable_data.scene import IntArray, Scene
from stable_data.scene_columns import ARRAY_LEAVES, SCENE_LEAVES, SceneArrays, scenes_from_table
from stable_data.shards import RunFolder, content_id
from stable_data.tables import SCHEMAS, Row, check_version

Decode: TypeAlias = Callable[[Row], Any]
TableDecode: TypeAlias = Callable[[pa.Table], Sequence[Any]]

_CACHE_BYTES = 256 * 2**20
_WINDOW_BYTES = 256 * 2**20
_CHUNK_BYTES = 2**22  # rows become Python objects in slices of about this much Arrow, for those take many times the room
_FOOTER_THREADS = 16
_EMPTY = pa.table({})


@dataclass(frozen=True, slots=True)
class _Group:
    """One row group of one file."""

    path: str
    index: int
    num_rows: int
    num_bytes: int


class _TableFiles:
    """The row groups of a table: listed once, read by whichever process holds a copy."""

    def __init__(self, uri: str, table: str, leaves: Sequence[str] | None) -> None:
        self._uri, self._table, self._leaves = uri, table, leaves
        self._folder, self._process = RunFolder(uri), os.getpid()
        self._folder.dataset(table)  # refuses a table that is missing or of another version
        paths = self._folder.files(table)
        with ThreadPoolExecutor(_FOOTER_THREADS) as pool:
            self.groups = [group for groups in pool.map(self._groups, paths) for group in groups]
        self.starts: IntArray = np.cumsum([0, *(group.num_rows for group in self.groups)], dtype=np.int64)

    def __len__(self) -> int:
        return int(self.starts[-1])

    @property
    def fingerprint(self) -> str:
        """Hash of which rows there are, in which order."""
        return content_id([(group.path.rpartition("/")[2], group.index, group.num_rows) for group in self.groups])

    def _groups(self, path: str) -> list[_Group]:
        """The row groups of one file that hold rows."""
        try:
            footer = pq.read_metadata(path, filesystem=self._folder.filesystem)
        except (pa.ArrowInvalid, OSError) as error:
            raise self._unreadable(path, error) from error
        check_version(pa.schema([], metadata=footer.metadata), path)
        sizes = [(footer.row_group(index).num_rows, footer.row_group(index).total_byte_size) for index in range(footer.num_row_groups)]
        return [_Group(path, index, rows, size) for index, (rows, size) in enumerate(sizes) if rows]

    def read(self, groups: Sequence[int]) -> pa.Table:
        """The rows of some row groups, in that order."""
        if self._process != os.getpid():  # forked: a file system must not be shared with the parent
            self._folder, self._process = RunFolder(self._uri), os.getpid()
        chosen = [self.groups[group] for group in groups]
        return pa.concat_tables([self._read_file(path, list(of_file)) for path, of_file in groupby(chosen, lambda g: g.path)])

    def _read_file(self, path: str, groups: list[_Group]) -> pa.Table:
        alone = get_worker_info() is None
        leaves = None if self._leaves is None else list(self._leaves)
        try:
            with pq.ParquetFile(path, filesystem=self._folder.filesystem, pre_buffer=True) as file:
                return file.read_row_groups([group.index for group in groups], columns=leaves, use_threads=alone)
        except (pa.ArrowInvalid, OSError) as error:
            raise self._unreadable(path, error) from error

    def _unreadable(self, path: str, error: Exception) -> ConfigError:
        return ConfigError(
            f"{self._uri}: {path} cannot be read ({error}), expected Parquet of this run; was it changed while it was in use? "
            "Delete it and run preprocess again",
            "shard_unreadable",
        )


def _reading(
    table: str, columns: Sequence[str] | None, decode: Decode | None, decode_table: TableDecode | None
) -> tuple[Sequence[str] | None, TableDecode]:
    """Which leaves to read, and how to turn them into items."""
    for name in columns or ():
        if name not in SCHEMAS[table].names:
            raise ConfigError(
                f"table {table} has no column {name}, expected some of {', '.join(SCHEMAS[table].names)}", "column_unknown"
            )
    if decode_table is not None:
        narrow = columns is None and decode_table is scene_batch_rows
        return ARRAY_LEAVES if narrow else columns, decode_table
    if decode is not None:
        return columns, lambda rows: [decode(row) for row in rows_from_table(rows)]
    if table == "scenes" and columns is None:
        return SCENE_LEAVES, scenes_from_table
    return columns, rows_from_table
