"""Parquet shards in a run folder, on a local path or an object store.

A run folder::

    manifest.json                  resolved configuration, input fingerprint, code and table versions
    SHA256SUMS                     checksums of the shards
    <table>/part-<id>.parquet      shards, named by a hash of their inputs
    report/index.html

A shard is written to a temporary file and then renamed, so a shard that exists is complete.
"""

import fcntl
import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import chain, islice
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias, cast

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.fs as pafs
import pyarrow.parquet as pq

from stable_data.atomic_files import temporary_path
from stable_data.errors import ConfigError, cannot_read, cannot_write
from stable_data.json_text import document_of
from stable_data.limits import LIMITS
from stable_data.storage.parquet_files import bounded_batches, checked, is_small, open_parquet, read_row_groups
from stable_data.storage.repeated_reads import with_repeated_reads
from stable_data.storage.schema_checks import check_schema, conform_to_schema, missing_columns, warn_of_missing_columns
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import arrow_table

Uri: TypeAlias = str | os.PathLike[str]
"""Address of a run: a local path, or a URI that pyarrow supports, such as ``s3://bucket/prefix``."""

_Columns: TypeAlias = list[str] | Mapping[str, pc.Expression] | None

MAX_BYTES = 96 * 10**6
"""Maximum bytes of a file before compression, so that no file exceeds 100 MB."""

LOCK = ".lock"
"""Name of the file by which a run's folder is locked."""

PART = re.compile(r"part-([^-]+)(?:-(\d+))?\.parquet")
"""Names of the files of shards: the id of the shard, and from the second file on its number."""

_ROW_GROUP = 1024
_GROUP_ROWS = {"scenes": 128, "settled": 128}  # of tables that are read by scene: one row costs the decoding of its group
_WITHOUT_DICTIONARIES = frozenset({"scenes", "episodes"})  # in small row groups they take more bytes and time than they save
_GROUP_BYTES = dict.fromkeys(
    ("meshes", "textures", "episodes"), 8 * 10**6
)  # of a row group: a reader of one row reads its group
_FILES_AT_ONCE = 32  # files of one dataset: their footers are in memory together, and are read concurrently
_AHEAD = 8  # files of an object store that are fetched while another one is processed
_FILE = re.compile(r"[^/]+/" + PART.pattern)


def absolute_uri(place: str) -> str:
    """Returns a folder as an absolute path; a URI stays as it is."""
    return place if "://" in place else str(Path(place).expanduser().resolve())


class RunFolder:
    """The folder of one run.

    Args:
        uri: A local path, or a URI that pyarrow supports such as
            ``s3://bucket/prefix?endpoint_override=http%3A//host%3A9000``; credentials are read from the environment.

    Attributes:
        written: File of a shard, ``table/part-id.parquet`` -> SHA-256, of those that this object has written. What other processes
            wrote is added by whoever learns of it.

    Raises:
        ConfigError: No file system supports the URI.
    """

    def __init__(self, uri: Uri) -> None:
        self.uri = uri = os.fspath(uri)
        self.written = dict[str, str]()
        try:
            if "://" in uri:
                self.filesystem, self.root = pafs.FileSystem.from_uri(uri)
                if not self.is_local:
                    self.filesystem = with_repeated_reads(self.filesystem)
            else:
                self.filesystem, self.root = pafs.LocalFileSystem(), str(Path(uri).expanduser().absolute())
        except (pa.ArrowInvalid, ValueError, OSError) as error:
            raise ConfigError(f"{uri}: {error}; expected a local path or an s3:// or gs:// URI", "output_invalid") from error
        if not self.root:
            raise ConfigError(f"{uri}: has no bucket; expected a local path or an s3:// or gs:// URI", "output_invalid")

    def __reduce__(self) -> tuple[type["RunFolder"], tuple[str]]:
        return type(self), (self.uri,)  # a file system cannot be sent to a worker, so each worker opens one

    @property
    def is_local(self) -> bool:
        """Whether the folder is on a local file system."""
        return isinstance(self.filesystem, pafs.LocalFileSystem)

    def leads_out(self, name: str) -> bool:
        """Whether a file of a local folder is a link, or lies behind one, to a place outside of the folder.

        Such files are read: programs of dataset hubs keep the files of a dataset elsewhere, and links to them in its folder. But what
        they are on this machine is no part of a run that is passed on. The folder itself may be a link.
        """
        return self.is_local and not Path(os.path.realpath(self._path(name))).is_relative_to(os.path.realpath(self.root))

    def refuse_link_out(self, name: str) -> None:
        """Refuses a file that is passed on to another folder if it is a link out of this one: what lies there may be private.

        Raises:
            ConfigError: See :meth:`leads_out` (``link_leaves``).
        """
        if self.leads_out(name):
            raise ConfigError(
                f"{self.uri}/{name}: is a link out of the run, expected a file in its folder; copy the run with cp -rL if you trust it, "
                "and name the copy",
                "link_leaves",
            )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Locks a local folder for one run; the lock ends with the process, also if the process is killed.

        An object store has no lock; concurrent runs of one job write the same bytes under the same names there.

        Raises:
            ConfigError: Another run holds the lock, or the folder cannot be written.
        """
        self.make(".")
        if not self.is_local:
            yield
            return
        try:
            handle = (Path(self.root) / LOCK).open("w")
        except OSError as error:
            raise cannot_write(self.uri, error) from error
        with handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(
                    f"{self.uri}: another run is writing to this folder, expected one run at a time; wait or choose another folder",
                    "locked",
                ) from error
            for pattern in (".*.tmp-*", "*/.*.tmp-*"):
                for stale in Path(self.root).glob(pattern):
                    stale.unlink(missing_ok=True)  # temporary file of a run that was killed
            yield

    def make(self, folder: str) -> None:
        """Creates a folder below the root.

        Raises:
            ConfigError: The folder cannot be created.
        """
        try:
            self.filesystem.create_dir(self._path(folder), recursive=True)
        except OSError as error:
            raise cannot_write(self.uri, error) from error

    def write_bytes(self, name: str, content: bytes) -> None:
        """Writes a file atomically.

        Raises:
            ConfigError: The file cannot be written, for example without permission or if the disk is full.
        """
        target = self._path(name)
        aside = temporary_path(Path(target))
        try:
            if self.is_local:
                aside.parent.mkdir(parents=True, exist_ok=True)
                _write_local(aside, content)
                aside.replace(target)
            else:  # an object becomes visible only when its upload ends
                with self.filesystem.open_output_stream(target) as stream:
                    stream.write(content)
        except OSError as error:
            if self.is_local:
                with suppress(OSError):  # if a folder of the path is a file, there is nothing to remove
                    aside.unlink()
            raise cannot_write(f"{self.uri}/{name}", error) from error
        if _FILE.fullmatch(name):
            self.written[name] = hashlib.sha256(content).hexdigest()

    def has_file(self, name: str) -> bool:
        """Whether there is a file; it is not read.

        Raises:
            ConfigError: The folder cannot be read.
        """
        try:
            return bool(self.filesystem.get_file_info(self._path(name)).type == pafs.FileType.File)
        except OSError as error:
            raise _unreachable(f"{self.uri}/{name}", error) from error

    def read_bytes(self, name: str, most: int | None = None) -> bytes | None:
        """Returns the content of a file, or None if the file does not exist.

        Args:
            name: The file, relative to the folder.
            most: The number of first bytes that are read; None: all.

        Raises:
            ConfigError: The file cannot be read.
        """
        if not self.has_file(name):
            return None
        try:
            with self.filesystem.open_input_stream(self._path(name)) as stream:
                return cast(bytes, stream.read(most))
        except OSError as error:
            raise _unreachable(f"{self.uri}/{name}", error) from error

    def read_document(self, name: str) -> Any:
        """Returns the content of a JSON file, such as the manifest, or None if the file does not exist.

        Raises:
            ConfigError: The file cannot be read.
            ValueError: It is no JSON, or too large (:func:`stable_data.json_text.document_of`).
        """
        content = self.read_bytes(name, LIMITS.text.max_document_bytes + 1)
        return None if content is None else document_of(content)

    def write_shard(self, table: str, shard_id: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Writes one shard of a table, as several files if it exceeds MAX_BYTES.

        The first file is written last: if it exists, the shard is complete.

        Args:
            table: Name in SCHEMAS.
            shard_id: ``content_id`` of the inputs of the rows.
            rows: Column -> value.
        """
        self.write_table(table, shard_id, arrow_table(table, rows))

    def write_table(self, table: str, shard_id: str, rows: pa.Table) -> None:
        """Writes one shard of a table from an Arrow table; see :meth:`write_shard`."""
        pieces = list(_pieces(rows))
        for number, piece in reversed(list(enumerate(pieces))):
            suffix = f"-{number}" if number else ""
            self.write_file(table, f"part-{shard_id}{suffix}.parquet", piece)

    def write_file(self, table: str, name: str, rows: pa.Table) -> None:
        """Writes one file of a table, or replaces it at once."""
        sink = pa.BufferOutputStream()
        with pq.ParquetWriter(sink, rows.schema, **_format_of(table, rows.schema)) as writer:
            if rows.num_rows:  # Hugging Face datasets fails on a row group without rows
                writer.write_table(rows, row_group_size=_rows_of_group(table, rows))
        self.write_bytes(f"{table}/{name}", sink.getvalue().to_pybytes())

    def remove_shards(self, table: str, shard_ids: Set[str]) -> None:
        """Deletes shards of a table; shards that are not there are left out.

        The first file of a shard is deleted first: without it, no other file of the shard is read.

        Raises:
            ConfigError: A file cannot be deleted.
        """
        for path in [path for path in self.files(table) if _shard_of(path) in shard_ids]:
            try:
                self.filesystem.delete_file(path)
            except OSError as error:
                raise cannot_write(path, error) from error

    def tables(self) -> list[str]:
        """Returns the names of the folders that have files of shards, sorted; those of unknown tables too.

        Raises:
            ConfigError: The folder cannot be read.
        """
        try:
            infos = self.filesystem.get_file_info(pafs.FileSelector(self.root, allow_not_found=True))
        except OSError as error:
            raise _unreachable(self.uri, error) from error
        names = sorted(info.base_name for info in infos if info.type == pafs.FileType.Directory)
        return [name for name in names if not name.startswith(".") and self.shard_entries(name)]

    def files_below(self) -> list[tuple[str, str]]:
        """Returns the files of the folder and of all folders in it: name in the folder, and path as the file system names it.

        A link to a folder counts as a file: what is behind it may be very much, or the folder itself.

        Raises:
            ConfigError: The folder cannot be read.
        """
        if self.is_local:
            here = Path(self.root)
            below = (Path(at, name) for at, folders, files in os.walk(here) for name in (*files, *folders))
            return [
                (path.relative_to(here).as_posix(), str(path))
                for path in below
                if path.is_file() or (path.is_symlink() and path.is_dir())
            ]
        try:
            infos = self.filesystem.get_file_info(pafs.FileSelector(self.root, recursive=True))
        except OSError as error:
            raise _unreachable(self.uri, error) from error
        files = (info.path for info in infos if info.type == pafs.FileType.File)
        return [(PurePosixPath(path).relative_to(self.root).as_posix(), path) for path in files]

    def shard_ids(self, table: str) -> set[str]:
        """Returns the ids of the complete shards of a table; see :meth:`files`."""
        names = (Path(path).name for path in self.files(table))
        return {n.removeprefix("part-").removesuffix(".parquet") for n in names if n.count("-") == 1}

    def files(self, table: str) -> list[str]:
        """Returns the paths of the files of complete shards, sorted by shard and number, as the file system names them.

        Raises:
            ConfigError: As :meth:`file_stamps`.
        """
        return [path for path, _, _ in self.file_stamps(table)]

    def file_stamps(self, table: str) -> list[tuple[str, int, int]]:
        """Returns path, size in bytes and time of change in nanoseconds of the files of a table, in the order of :meth:`files`.

        Raises:
            ConfigError: The folder cannot be read, or what has the name of a shard is no file (``shard_not_a_file``), such as a
                named pipe, which would be waited for without end.
        """
        entries = self.shard_entries(table)
        for info in entries:
            if info.type != pafs.FileType.File:
                raise ConfigError(
                    f"{self.uri}/{table}/{info.base_name}: is no regular file, expected a shard; remove it, and run the job of the "
                    "run again",
                    "shard_not_a_file",
                )
        return [(info.path, int(info.size or 0), int(info.mtime_ns or 0)) for info in entries]

    def shard_entries(self, table: str) -> list[pafs.FileInfo]:
        """Returns what has the name of a file of a complete shard, in the order of :meth:`files`, whether or not it is a file.

        Raises:
            ConfigError: The folder cannot be read.
        """
        try:
            infos = self.filesystem.get_file_info(pafs.FileSelector(self._path(table), allow_not_found=True))
        except OSError as error:
            raise _unreachable(f"{self.uri}/{table}", error) from error
        matches = ((PART.fullmatch(info.base_name), info) for info in infos)
        found = {(match[1], int(match[2] or 0)): info for match, info in matches if match}
        return [info for (shard_id, _), info in sorted(found.items(), key=lambda one: one[0]) if (shard_id, 0) in found]

    def dataset(self, table: str) -> ds.Dataset:
        """Returns a table of the run as a lazy dataset, in the order of its files.

        Raises:
            ConfigError: The table is missing, cannot be read, or was written by another version.
        """
        files = self.files(table)
        if not files:
            known = ", ".join(SCHEMAS)
            raise ConfigError(f"{self.uri}: no table {table}, expected a folder of part-*.parquet ({known})", "table_missing")
        try:
            with open_parquet(files[0], filesystem=self.filesystem) as file:
                schema = file.schema_arrow
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(self.uri, files[0], error) from error
        check_schema(schema, table, f"{self.uri}/{table}")
        return ds.dataset(files, format="parquet", filesystem=self.filesystem, schema=SCHEMAS[table])

    def batches(
        self,
        table: str,
        columns: Sequence[str] | None = None,
        where: pc.Expression | None = None,
        shard_ids: Set[str] | None = None,
    ) -> Iterator[pa.RecordBatch]:
        """Yields the batches of a table, or of some of its columns, rows and shards; see :meth:`dataset`.

        Files of a local run are read one at a time, since most callers need less than a read-ahead would load. Files of an
        object store are read several at a time, since each one has a latency.

        Raises:
            ConfigError: As :meth:`dataset`; a file needs too much memory (``shard_too_big``).
        """
        wanted = SCHEMAS[table].names if columns is None else list(columns)
        at_once = 1 if self.is_local else _AHEAD
        ahead = {"batch_readahead": 1, "fragment_readahead": at_once, "cache_metadata": False}
        with ThreadPoolExecutor(_AHEAD) as pool:
            for part in self._parts(table, self._files_of(table, shard_ids)):
                with self._naming_what_is_broken(part):
                    if all(pool.map(is_small, part.get_fragments())):
                        yield from map(checked, part.to_batches(wanted, filter=where, **ahead))
                        continue
                    for start in range(0, len(part.files), at_once):  # a scan would decode a row group as a whole
                        streams = (self._stream(table, path, wanted, where) for path in part.files[start : start + at_once])
                        for stream in pool.map(_begin, streams):
                            yield from stream

    def table(
        self,
        table: str,
        columns: Sequence[str] | Mapping[str, pc.Expression] | None = None,
        where: pc.Expression | None = None,
        shard_ids: Set[str] | None = None,
    ) -> pa.Table:
        """Returns a table of the run, or some of its columns (or expressions of them), rows and shards.

        See :meth:`dataset`. A file that needs too much memory is refused (``shard_too_big``); see :class:`stable_data.limits.TableLimits`.
        """
        wanted = columns if columns is None or isinstance(columns, Mapping) else list(columns)
        files = self._files_of(table, shard_ids)
        if not files:
            return _chosen(SCHEMAS[table].empty_table(), wanted, where)
        rows = list[pa.Table]()
        with ThreadPoolExecutor(_AHEAD) as pool:
            for part in self._parts(table, files):
                with self._naming_what_is_broken(part):
                    if self.is_local and all(pool.map(is_small, part.get_fragments())):
                        # Of local files, one scan costs less for each.
                        rows.append(checked(part.to_table(wanted, filter=where)))
                    else:
                        rows += pool.map(lambda path: self._read(table, path, wanted, where), part.files)
        return pa.concat_tables(rows)

    def read_file(self, table: str, path: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Returns one file of a table, or some of its columns.

        Args:
            table: Name in SCHEMAS.
            path: A path from :meth:`files`.
            columns: Columns, or None for all.

        Raises:
            ConfigError: The file cannot be read, or needs too much memory (``shard_too_big``).
        """
        return self._read(table, path, None if columns is None else list(columns), None)

    def warn_of_missing(self, table: str, condition: Iterable[str] = ()) -> None:
        """Warns of missing columns in a table; see :func:`stable_data.storage.schema_checks.warn_of_missing_columns`.

        Args:
            table: Name in SCHEMAS.
            condition: Columns that a condition on the rows names.
        """
        missing = list[str]()
        with ThreadPoolExecutor(_AHEAD) as pool:
            for part in self._parts(table):
                with self._naming_what_is_broken(part):
                    found = pool.map(lambda fragment: fragment.physical_schema, part.get_fragments())
                    missing += (name for schema in found for name in missing_columns(schema, SCHEMAS[table]))
        warn_of_missing_columns(self.uri, table, missing, condition)

    def num_rows(self, table: str) -> int:
        """Returns the number of rows of a table of the run; see :meth:`dataset`."""
        count = 0
        with ThreadPoolExecutor(_AHEAD) as pool:
            for part in self._parts(table):
                with self._naming_what_is_broken(part):  # a dataset would read one footer after the other
                    count += sum(pool.map(lambda fragment: int(fragment.metadata.num_rows), part.get_fragments()))
        return count

    def _read(self, table: str, path: str, wanted: _Columns, where: pc.Expression | None) -> pa.Table:
        """Reads the requested columns and rows of one file."""
        known = _needed(SCHEMAS[table], wanted, where)
        try:
            with self._open(table, path, where) as (file, groups):
                rows = read_row_groups(file, path, groups, known.names)
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(self.uri, path, error) from error
        return _chosen(conform_to_schema(rows, known), wanted, where)

    def _stream(self, table: str, path: str, wanted: _Columns, where: pc.Expression | None) -> Iterator[pa.RecordBatch]:
        """As :meth:`_read`, a few rows at a time."""
        known = _needed(SCHEMAS[table], wanted, where)
        with self._open(table, path, where) as (file, groups):
            for batch in bounded_batches(file, path, groups, known.names):
                rows = conform_to_schema(pa.Table.from_batches([batch]), known)
                yield from _chosen(rows, wanted, where).to_batches()

    @contextmanager
    def _open(self, table: str, path: str, where: pc.Expression | None) -> Iterator[tuple[pq.ParquetFile, list[int]]]:
        """Opens a file, and names its row groups that may contain requested rows."""
        fragment = ds.ParquetFileFormat().make_fragment(path, self.filesystem)
        fragment = fragment if where is None else fragment.subset(where, schema=SCHEMAS[table])
        with open_parquet(path, filesystem=self.filesystem, metadata=fragment.metadata, pre_buffer=True) as file:
            yield file, [group.id for group in fragment.row_groups]

    def count_values(self, table: str, columns: Sequence[str], shard_ids: Set[str] | None = None) -> dict[str, Counter[Any]]:
        """Counts the values of columns of a table of the run, or of some of its shards, which is read once; see :meth:`batches`."""
        found = {name: Counter[Any]() for name in columns}
        for batch in self.batches(table, columns, shard_ids=shard_ids):
            for name, counts in found.items():
                for entry in pc.value_counts(batch[name]).to_pylist():
                    counts[entry["values"]] += entry["counts"]
        return found

    def _files_of(self, table: str, shard_ids: Set[str] | None) -> list[str]:
        """The files of a table, or of some of its shards."""
        return [path for path in self.dataset(table).files if shard_ids is None or _shard_of(path) in shard_ids]

    def _parts(self, table: str, files: Sequence[str] | None = None) -> Iterator[ds.Dataset]:
        """Yields a table of the run, or some of its files, as datasets of a few files.

        A dataset stores the footer of each file that it has read, and runs have many files.
        """
        files = self.dataset(table).files if files is None else files
        for start in range(0, len(files), _FILES_AT_ONCE):
            part = list(files[start : start + _FILES_AT_ONCE])
            yield ds.dataset(part, format="parquet", filesystem=self.filesystem, schema=SCHEMAS[table])

    @contextmanager
    def _naming_what_is_broken(self, part: ds.Dataset) -> Iterator[None]:
        try:
            yield
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(self.uri, self._broken(part.files) or part.files[0], error) from error

    def _broken(self, files: Sequence[str]) -> str | None:
        """Returns the first file that cannot be read completely, or None."""
        for path in files:
            try:
                file = open_parquet(path, filesystem=self.filesystem)
                read_row_groups(file, path, range(file.num_row_groups))
            except (pa.ArrowException, OSError):
                return path
        return None

    def _path(self, name: str) -> str:
        return self.root if name == "." else f"{self.root}/{name}"


def _begin(stream: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    """The same stream; its first batch, in most files all rows, is read now."""
    return chain(list(islice(stream, 1)), stream)


def _needed(schema: pa.Schema, wanted: _Columns, where: pc.Expression | None) -> pa.Schema:
    """The columns that the requested ones and the condition need."""
    names = _names_in(schema.names if wanted is None else wanted, where)
    return pa.schema([field for field in schema if field.name in names], schema.metadata)


def _shard_of(path: str) -> str:
    return Path(path).stem.split("-")[1]


def _names_in(wanted: Iterable[str] | Mapping[str, pc.Expression], where: pc.Expression | None) -> set[str]:
    """Returns column names and all words of the expressions: Arrow does not list their columns, and extra words only cost time."""
    expressions = list(wanted.values()) if isinstance(wanted, Mapping) else []
    words = re.findall(r"\w+", " ".join(map(str, expressions if where is None else [*expressions, where])))
    return {*words} if isinstance(wanted, Mapping) else {*wanted, *words}


def _chosen(rows: pa.Table, wanted: _Columns, where: pc.Expression | None) -> pa.Table:
    """Selects columns (or expressions of them) and rows of a table."""
    if where is None and not isinstance(wanted, Mapping):
        return rows if wanted is None else rows.select(wanted)
    return ds.dataset(rows).to_table(wanted, filter=where)


def _unreachable(where: str, error: OSError) -> ConfigError:
    """Makes the error for an address that cannot be accessed."""
    reason = error.strerror or str(error).strip().partition("\n")[0]
    return ConfigError(
        f"{where}: cannot be read ({reason}), expected the folder of a run; check the address, the network and your read permissions",
        "output_unreadable",
    )


def _write_local(path: Path, content: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())  # after a crash, the renamed file must not exist without its content


def _format_of(table: str, schema: pa.Schema) -> dict[str, Any]:
    """The settings of a writer: statistics are kept for the columns that a condition can name, since footers are read whole."""
    named = [column.name for column in schema if not pa.types.is_nested(column.type)]
    return {"compression": "zstd", "use_dictionary": table not in _WITHOUT_DICTIONARIES, "write_statistics": named}


def _rows_of_group(table: str, piece: pa.Table) -> int:
    """The number of rows of a row group of a table."""
    if table not in _GROUP_BYTES:
        return _GROUP_ROWS.get(table, _ROW_GROUP)
    return max(1, min(_ROW_GROUP, _GROUP_BYTES[table] * int(piece.num_rows) // max(1, int(piece.nbytes))))


def _pieces(table: pa.Table) -> Iterator[pa.Table]:
    """Halves a table until each slice has at most MAX_BYTES or one row."""
    if table.nbytes <= MAX_BYTES or table.num_rows <= 1:
        yield table
        return
    half = table.num_rows // 2
    yield from _pieces(table.slice(0, half))
    yield from _pieces(table.slice(half))
