"""Where the row of each scene of a run is, so that scenes are read by id without a search of the table."""

import os
import struct
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import accumulate, chain, pairwise
from pathlib import Path
from threading import Lock
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stable_data.atomic_files import temporary_path
from stable_data.cache_folder import trim_folder, user_cache
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, cannot_read
from stable_data.scene import IntArray, Scene
from stable_data.storage.id_hashes import Hashes, id_hashes
from stable_data.storage.parquet_files import open_parquet, read_row_groups
from stable_data.storage.row_groups import ColumnCheck, Places, leaf_schema
from stable_data.storage.run_folder import RunFolder, Uri, absolute_uri
from stable_data.storage.scene_arrays import SCENE_LEAVES, scenes_from_table
from stable_data.storage.schema_checks import conform_to_schema, warn_of_missing_columns
from stable_data.storage.schemas import SCHEMAS, Row

RowNumbers: TypeAlias = npt.NDArray[np.uint32] | npt.NDArray[np.uint64]

MAX_INDEX_BYTES = 4 * 2**30
"""Maximum size of all indexes of a user; those that were used longest ago are removed."""

_MAGIC = b"stable-data scene index 1".ljust(32)
_HEADER = struct.Struct("<32s16s5Q")
"""Magic, fingerprint, rows, row groups, bytes of a row's number, and the checksums of the small and of the large arrays."""

_CACHE_BYTES = 2**30
_FOOTER_WEIGHT = 10  # memory of a footer, relative to its bytes in a file
_AT_ONCE = 16  # files that are read at the same time: an object store has a latency


class SceneIndex:
    """The rows of a table of a run by scene id.

    An index is made when it is first asked for, is stored in the user's cache (``scene_index``), and is read from a memory map.
    It belongs to the files of the table as they are (names, sizes, times of change): for other files it is made again. A row is
    given only if it states the id that was asked for, so that a wrong index never gives a wrong row. An open index is a snapshot:
    open another one to see rows that were added later.

    Args:
        uri: The run folder.
        table: A table with the column ``scene_id``, a row for each scene: ``scenes``, ``settled``, ``rejected``.
        folder: The folder of the indexes; None: that in the user's cache.
        cache_bytes: Maximum memory of the footers of files that stay open, about 700 bytes a row; the last one stays open whatever
            its size.

    Raises:
        ConfigError: The run has no such table, or the table has no scenes or cannot be read.
    """

    def __init__(
        self,
        uri: Uri | RunFolder,
        table: str = "scenes",
        folder: Path | None = None,
        cache_bytes: int = _CACHE_BYTES,
    ) -> None:
        self._run = uri if isinstance(uri, RunFolder) else RunFolder(uri)
        if table in SCHEMAS and "scene_id" not in SCHEMAS[table].names:
            raise ConfigError(f"table {table} has no column scene_id, expected a table of scenes", "column_unknown")
        self._table, self._folder = table, user_cache("scene_index") if folder is None else folder
        self._cache_bytes = cache_bytes
        self._stamps = self._run.file_stamps(table)
        if not self._stamps:
            self._run.dataset(table)  # raises the error that describes the missing table
        self._check = ColumnCheck(table, SCHEMAS[table])
        self._files, self._file_bytes, self._lock = OrderedDict[str, pq.ParquetFile](), 0, Lock()
        self._schemas: dict[tuple[str, ...] | None, pa.Schema] = {}  # of recent reads
        self._opened = self._open() or self._make()
        self._is_checked = False

    def __reduce__(self) -> tuple[type["SceneIndex"], tuple[str, str, Path, int]]:
        return type(self), (self._run.uri, self._table, self._folder, self._cache_bytes)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self._opened.rows)

    def __contains__(self, scene_id: str) -> bool:
        return not self.unknown([scene_id])

    @property
    def path(self) -> Path:
        """The file of the index."""
        return self._folder / f"{content_id(absolute_uri(self._run.uri), self._table)}.index"

    def scene(self, scene_id: str) -> Scene:
        """Returns a scene, without the ``source`` entries of its original files.

        Raises:
            ConfigError: As :meth:`rows`.
        """
        return self.scenes([scene_id])[0]

    def scenes(self, scene_ids: Sequence[str]) -> list[Scene]:
        """Returns some scenes in the given order, as :meth:`scene`.

        Raises:
            ConfigError: As :meth:`rows`.
        """
        return scenes_from_table(self.rows(scene_ids, SCENE_LEAVES))

    def rows(self, scene_ids: Sequence[str], leaves: Sequence[str] | None = None) -> pa.Table:
        """Returns the rows of some scenes in the given order.

        Args:
            scene_ids: The scenes; an id may occur several times.
            leaves: Columns or leaves of columns, as Parquet names them; None: all.

        Raises:
            ConfigError: The table has no such scene (``scene_unknown``), or several of one id (``scene_twice``); its files were
                changed since the index was opened (``run_changed``), or cannot be read.
        """
        found = self._find(scene_ids, None if leaves is None else list(dict.fromkeys(["scene_id", *leaves])))
        if unknown := found.unknown(scene_ids):
            raise ConfigError(
                f"{self._run.uri}: the run has no scenes {unknown[:5]}, expected ids of its table {self._table}",
                "scene_unknown",
            )
        table = found.table
        if (np.diff(found.wanted) < 0).any():
            table = table.take(np.argsort(found.wanted))
        return table.select(self._schema(leaves).names)

    def row(self, scene_id: str, leaves: Sequence[str] | None = None) -> Row | None:
        """Returns the row of a scene as a dictionary; None if the table has no such scene.

        Args:
            scene_id: The scene.
            leaves: As in :meth:`rows`.

        Raises:
            ConfigError: As :meth:`unknown`.
        """
        table = self._find([scene_id], None if leaves is None else list(dict.fromkeys(["scene_id", *leaves]))).table
        return dict(table.to_pylist()[0]) if table.num_rows else None

    def unknown(self, scene_ids: Sequence[str]) -> list[str]:
        """Returns those of some ids that the table does not have, each once.

        Raises:
            ConfigError: As :meth:`rows`, but for unknown scenes.
        """
        return self._find(scene_ids, ["scene_id"]).unknown(scene_ids)

    def places(self, scene_ids: Sequence[str]) -> Places:
        """Returns where the rows of some scenes are, in the order of the table; ids that the table does not have are left out.

        Raises:
            ConfigError: As :meth:`unknown`.
        """
        opened, rows = self._opened, np.unique(self._find(scene_ids, ["scene_id"]).rows)
        places: dict[str, dict[int, list[int]]] = {}
        for row, group in zip(rows.tolist(), opened.groups_of(rows).tolist(), strict=True):
            of_file = places.setdefault(opened.paths[int(opened.files[group])], {})
            of_file.setdefault(int(opened.groups[group]), []).append(row - int(opened.starts[group]))
        return {path: {g: np.array(own, np.int64) for g, own in of_file.items()} for path, of_file in places.items()}

    def _find(self, scene_ids: Sequence[str], leaves: Sequence[str] | None) -> "_Found":
        """Reads the rows that state one of some ids.

        Raises:
            ConfigError: As :meth:`unknown`.
        """
        names = pa.array(scene_ids, pa.string())
        found = self._read_all(names, leaves)
        if len(np.unique(found.wanted)) < len(names) and not self._is_checked:
            self._is_checked = True  # once: a damaged index could hide a scene
            if not self._opened.is_whole():
                self._opened = self._make()
                found = self._read_all(names, leaves)
        counts = np.bincount(found.wanted, minlength=len(names))
        if (counts > 1).any():
            name = scene_ids[int(np.argmax(counts))]
            raise ConfigError(
                f"{self._run.uri}: table {self._table} has {counts.max()} rows of the scene {name!r}, expected one; "
                "write the rows of different runs to different folders",
                "scene_twice",
            )
        if found.num_others and not counts.all() and self._run.file_stamps(self._table) != self._stamps:
            raise self._changed()
        return found

    def _read_all(self, names: pa.Array, leaves: Sequence[str] | None) -> "_Found":
        """Reads the rows whose ids have the hashes of some names, and keeps those of these names."""
        opened, (wanted, rows) = self._opened, self._opened.candidates(names)
        schema = self._schema(leaves)
        of_group = opened.groups_of(rows)
        ends = [*(np.flatnonzero(np.diff(opened.files[of_group])) + 1).tolist(), len(rows)] if len(rows) else []
        parts = [slice(start, end) for start, end in pairwise([0, *ends])]

        def read(part: slice) -> pa.Table:
            return self._read(rows[part], of_group[part], leaves, schema)

        if len(parts) > 1:
            with ThreadPoolExecutor(self._num_threads) as pool:
                tables = list(pool.map(read, parts))
        else:
            tables = list(map(read, parts))
        table = pa.concat_tables(tables) if tables else schema.empty_table()
        is_same = pc.fill_null(pc.equal(table["scene_id"], names.take(pa.array(wanted))), False)
        kept = is_same.to_numpy()
        if kept.all():
            return _Found(table, wanted, rows, 0)
        return _Found(table.filter(is_same), wanted[kept], rows[kept], int((~kept).sum()))

    def _read(self, rows: IntArray, of_group: IntArray, leaves: Sequence[str] | None, schema: pa.Schema) -> pa.Table:
        """Reads rows of one file."""
        opened = self._opened
        path, parts = opened.paths[int(opened.files[of_group[0]])], list[pa.Table]()
        try:
            with self._file(path) as file:
                for group in np.unique(of_group).tolist():
                    number, own = int(opened.groups[group]), rows[of_group == group] - opened.starts[group]
                    if number >= file.num_row_groups or own[-1] >= file.metadata.row_group(number).num_rows:
                        raise self._changed()
                    part = read_row_groups(file, path, [number], leaves, use_threads=False)
                    parts.append(part.take(own))  # a copy: a slice would keep its row group in memory
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(self._run.uri, path, error) from error
        return conform_to_schema(pa.concat_tables(parts), schema)

    @contextmanager
    def _file(self, path: str) -> Iterator[pq.ParquetFile]:
        """Opens a file for one thread; recently used files stay open, since a file with many row groups has a large footer."""
        with self._lock:
            file = self._files.pop(path, None)
            self._file_bytes -= 0 if file is None else _size(file)
        if file is None:
            file = open_parquet(path, filesystem=self._run.filesystem, pre_buffer=not self._run.is_local)
            missing = self._check.missing(file, f"{self._run.uri}: {path}")
            warn_of_missing_columns(self._run.uri, self._table, missing)
        yield file
        with self._lock:
            before = self._files.pop(path, None)  # of another thread
            self._files[path] = file
            self._file_bytes += 0 if before is not None else _size(file)
            while len(self._files) > 1 and self._file_bytes > self._cache_bytes:
                self._file_bytes -= _size(self._files.popitem(last=False)[1])

    def _changed(self) -> ConfigError:
        return ConfigError(
            f"{self._run.uri}: files of table {self._table} were changed since its index was opened, expected a run that does not "
            "change; open it again",
            "run_changed",
        )

    @property
    def _num_threads(self) -> int:
        return os.cpu_count() or 1 if self._run.is_local else _AT_ONCE

    def _schema(self, leaves: Sequence[str] | None) -> pa.Schema:
        key = None if leaves is None else tuple(leaves)
        if key not in self._schemas:
            self._schemas = {**dict(list(self._schemas.items())[-4:]), key: leaf_schema(SCHEMAS[self._table], leaves)}
        return self._schemas[key]

    @property
    def _fingerprint(self) -> str:
        """Hash of the files of the table."""
        return content_id(absolute_uri(self._run.uri), self._table, self._stamps)

    def _open(self) -> "_Rows | None":
        """Maps the stored index; None if there is none of these files."""
        rows = _Rows.mapped(self.path, self._fingerprint, [path for path, _, _ in self._stamps])
        if rows is not None:
            with suppress(OSError):
                os.utime(self.path)  # indexes that are used stay
        return rows

    def _make(self) -> "_Rows":
        """Makes the index and stores it, if that is possible."""
        with ThreadPoolExecutor(self._num_threads) as pool:
            listed = list(pool.map(self._list, [path for path, _, _ in self._stamps]))
        hashes = np.concatenate([own for own, _ in listed])
        sizes = [own for _, own in listed]
        del listed
        order = np.argsort(hashes, kind="stable")
        rows = _Rows(
            hashes[order],
            _narrow(order),
            np.cumsum([0, *chain.from_iterable(sizes)], dtype=np.int64),
            np.repeat(np.arange(len(sizes), dtype=np.int64), [len(own) for own in sizes]),
            np.concatenate([np.arange(len(own), dtype=np.int64) for own in sizes]),
            [path for path, _, _ in self._stamps],
        )
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            rows.write(self.path, self._fingerprint)
            trim_folder(self._folder, MAX_INDEX_BYTES)
            # Memory that is mapped is shared by processes, and is given back when others need it.
            return _Rows.mapped(self.path, self._fingerprint, rows.paths) or rows
        return rows

    def _list(self, path: str) -> tuple[Hashes, list[int]]:
        """Returns the hashes of the ids of a file, and the sizes of its row groups."""
        try:
            with open_parquet(path, filesystem=self._run.filesystem, pre_buffer=not self._run.is_local) as file:
                self._check.missing(file, f"{self._run.uri}: {path}")
                sizes = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
                names = read_row_groups(file, path, range(file.num_row_groups), ["scene_id"], use_threads=False)["scene_id"]
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(self._run.uri, path, error) from error
        known = conform_to_schema(pa.table({"scene_id": names}), self._schema(["scene_id"]))
        return _hashes(known["scene_id"]), sizes


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Rows that state the ids that were asked for.

    Attributes:
        table: The rows, in the order of the table.
        wanted: Number of the request that each one answers, (N,) int64.
        rows: Number of each one in the table, (N,) int64.
        num_others: Number of rows with an equal hash and another id.
    """

    table: pa.Table
    wanted: IntArray
    rows: IntArray
    num_others: int

    def unknown(self, scene_ids: Sequence[str]) -> list[str]:
        """Returns the requests without a row."""
        known = set(self.wanted.tolist())
        return list(dict.fromkeys(name for k, name in enumerate(scene_ids) if k not in known))


@dataclass(frozen=True, eq=False)
class _Rows:
    """The content of an index.

    Attributes:
        hashes: Hash of each scene id, ascending, (N,).
        rows: Number of its row in the table, (N,) uint32, or uint64 in a table of more than 2^32 rows.
        starts: Number of the first row of each row group, and the number of rows, (G + 1,) int64.
        files: Number of the file of each row group, (G,) int64, ascending.
        groups: Number of each row group in its file, (G,) int64.
        paths: The files, as the file system names them.
        stated: Checksum of ``hashes`` and ``rows`` that the file states; None: they were not read from a file.
    """

    hashes: Hashes
    rows: RowNumbers
    starts: IntArray
    files: IntArray
    groups: IntArray
    paths: Sequence[str]
    stated: int | None = None

    @classmethod
    def mapped(cls, path: Path, fingerprint: str, paths: Sequence[str]) -> "_Rows | None":
        """Maps the file of an index; None if there is none, or if it is damaged or of other files."""
        try:
            content = np.memmap(path, np.uint8, "r")
        except (OSError, ValueError):
            return None
        size, checked, large = _HEADER.size, 0, 0
        if len(content) < size:
            return None
        magic, stated_for, num_rows, num_groups, width, checked, large = _HEADER.unpack(content[:size].tobytes())
        lengths = [8 * num_rows, width * num_rows + -width * num_rows % 8, 8 * (num_groups + 1), 8 * num_groups, 8 * num_groups]
        ends = list(accumulate([size, *lengths]))
        if magic != _MAGIC or stated_for != fingerprint.encode() or width not in (4, 8) or ends[-1] != len(content):
            return None
        if zlib.crc32(content[ends[2] :].data) != checked:
            return None
        hashes, rows, starts, files, groups = (content[start:end] for start, end in pairwise(ends))
        numbers = rows[: width * num_rows]
        return cls(
            hashes.view(np.uint64),
            numbers.view(np.uint32) if width == 4 else numbers.view(np.uint64),
            starts.view(np.int64),
            files.view(np.int64),
            groups.view(np.int64),
            paths,
            large,
        )

    def write(self, path: Path, fingerprint: str) -> None:
        """Writes the file of an index.

        Raises:
            OSError: The file cannot be written.
        """
        width = self.rows.dtype.itemsize
        small = b"".join(array.tobytes() for array in (self.starts, self.files, self.groups))
        sizes = (len(self.hashes), len(self.groups), width)
        header = _HEADER.pack(_MAGIC, fingerprint.encode(), *sizes, zlib.crc32(small), self._checksum())
        filling = bytes(-width * len(self.rows) % 8)
        temporary = temporary_path(path)
        try:
            with temporary.open("wb") as stream:
                for part in (header, self.hashes.data, self.rows.data, filling, small):
                    stream.write(part)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)

    def is_whole(self) -> bool:
        """Whether the large arrays are those that were written; this reads all of them."""
        return self.stated is None or self._checksum() == self.stated

    def _checksum(self) -> int:
        return zlib.crc32(self.rows.data.cast("B"), zlib.crc32(self.hashes.data.cast("B")))

    def candidates(self, names: pa.Array) -> tuple[IntArray, IntArray]:
        """Returns the rows whose ids have the hashes of some names, in the order of the table.

        Returns:
            Number of a name, and number of a row in the table, (N,) int64 each.
        """
        hashes = _hashes(names)
        low, high = (np.searchsorted(self.hashes, hashes, side) for side in ("left", "right"))
        counts = high - low
        wanted = np.repeat(np.arange(len(names), dtype=np.int64), counts)
        first = np.repeat(low - np.cumsum(counts) + counts, counts)
        rows = self.rows[first + np.arange(len(wanted))].astype(np.int64)
        is_row = rows < self.starts[-1]  # not in a damaged file
        order = np.argsort(rows[is_row], kind="stable")
        return wanted[is_row][order], rows[is_row][order]

    def groups_of(self, rows: IntArray) -> IntArray:
        """Returns the number of the row group of each row, (N,) int64."""
        return np.searchsorted(self.starts, rows, "right") - 1


def _size(file: pq.ParquetFile) -> int:
    """Memory of the footer of an open file, bytes."""
    return _FOOTER_WEIGHT * int(file.metadata.serialized_size)


def _narrow(order: IntArray) -> RowNumbers:
    return order.astype(np.uint32) if len(order) < 2**32 else order.astype(np.uint64)


def _hashes(names: pa.Array | pa.ChunkedArray) -> Hashes:
    return id_hashes(names)[:, 0].copy()  # not a view of both halves
