"""The files of the tables of a run: listed, compared with their checksums, and read row group by row group."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.fs as pafs
import pyarrow.parquet as pq

from stable_data.errors import ConfigError
from stable_data.limits import LIMITS
from stable_data.storage.checksums import CHECKSUMS, checksum_of, is_shard_file
from stable_data.storage.page_headers import check_pages
from stable_data.storage.parquet_files import bounded_batches, open_parquet
from stable_data.storage.run_folder import PART, RunFolder
from stable_data.verification.findings import Findings

_WHOLE = 256 * 2**20  # a file up to this size is read once, for its checksum and its rows; a larger one twice
_CHUNK = 4 * 2**20
_MOST_TIMES = 100  # the bytes of a file that its rows may have; those of jobs have about ten times as many


@dataclass(frozen=True, slots=True)
class ShardFile:
    """A file of a table.

    Attributes:
        name: Its name in the run's folder, ``table/part-id.parquet``.
        table: The table.
        shard_id: The shard.
        path: As the file system names it.
        size: Bytes.
    """

    name: str
    table: str
    shard_id: str
    path: str
    size: int


def list_files(folder: RunFolder, findings: Findings) -> list[ShardFile]:
    """Lists the files of all tables, also of unknown ones.

    A file in the folder of a table that is no part of a shard is damage, and so is what has the name of one and is no file.

    Raises:
        ConfigError: The folder cannot be read.
    """
    found = list[ShardFile]()
    for table in folder.tables():
        names = {info.base_name for info in folder.shard_entries(table)}
        for info in sorted(
            folder.filesystem.get_file_info(pafs.FileSelector(f"{folder.root}/{table}")), key=lambda i: i.base_name
        ):
            if info.base_name in names and info.type != pafs.FileType.File:
                findings.damage(f"{table}/{info.base_name}", "is no regular file, expected a shard")
            elif info.base_name in names:
                match = PART.fullmatch(info.base_name)
                assert match is not None  # RunFolder.files lists no others
                name = f"{table}/{info.base_name}"
                tell_of_link(folder, name, findings)
                found.append(ShardFile(name, table, match[1], info.path, int(info.size or 0)))
            elif not info.base_name.startswith("."):  # temporary files of a killed run are hidden, and no reader sees them
                findings.damage(f"{table}/{info.base_name}", "is no file of a complete shard, but readers of *.parquet see it")
    return found


def tell_of_link(folder: RunFolder, name: str, findings: Findings) -> None:
    """Notes damage if a file of a run is a link out of it: the run is not whole without what lies there."""
    if folder.leads_out(name):
        findings.damage(
            name, "is a link out of the run, expected a file in its folder; copy the run with cp -rL if you trust it"
        )


def compare_with_checksums(files: list[ShardFile], checksums: Mapping[str, str], findings: Findings) -> None:
    """Compares which files of shards there are with those that have a checksum."""
    there = {file.name for file in files}
    for name in sorted(name for name in checksums.keys() - there if is_shard_file(name)):
        findings.damage(name, f"is missing, expected the file of {CHECKSUMS}")
    for name in sorted(there - checksums.keys()):
        findings.damage(name, f"is not in {CHECKSUMS}, expected no further files")


def open_file(folder: RunFolder, file: ShardFile, checksum: str | None, findings: Findings) -> pq.ParquetFile | None:
    """Opens a file of a shard after its checksum is compared; None, and a finding, if it is no Parquet file.

    Args:
        folder: The run.
        file: The file.
        checksum: Its checksum; None if the run has none.
        findings: Where damage is noted.
    """
    at_hand: Path | bytes | None
    try:
        if file.size <= _WHOLE:
            content = at_hand = folder.read_bytes(file.name)
            if content is None:
                findings.damage(file.name, "was removed while it was read")
                return None
            found, source = checksum_of(content), pa.BufferReader(content)
        else:
            found, source = checksum_in_chunks(folder, file.path), folder.filesystem.open_input_file(file.path)
            at_hand = Path(file.path) if folder.is_local else None
        if checksum is not None and found != checksum:
            findings.damage(
                file.name, f"has the SHA-256 {found[:16]}…, expected {checksum[:16]}… as {CHECKSUMS} says; it was changed"
            )
        opened = open_parquet(source)
        if at_hand is not None:
            check_pages(at_hand)
        return opened
    except (pa.ArrowException, OSError, ConfigError, ValueError) as error:
        findings.damage(file.name, f"is no readable Parquet file ({_line(error)})")
        return None


def row_groups(opened: pq.ParquetFile, file: ShardFile, findings: Findings) -> Iterator[tuple[int, pa.Table]]:
    """Yields the rows of a file, a row group or a part of one at a time, each with the number of its first row.

    At a row group that cannot be read there is damage, and the end. A small file may hold very many rows, so that they are never in memory
    together. If they have more bytes than a table may have in memory and a hundred times those of the file, that is damage too: no job
    writes such a file, and to look at all of them would take for ever.
    """
    size, most = 0, max(LIMITS.table.max_decoded_bytes, _MOST_TIMES * file.size)
    start, groups = 0, range(opened.num_row_groups)
    batches = bounded_batches(opened, file.name, groups)
    while True:
        try:
            batch = next(batches, None)
        except (pa.ArrowException, OSError, ConfigError, ValueError) as error:
            ends = np.cumsum([opened.metadata.row_group(group).num_rows for group in groups])
            group = int(np.searchsorted(ends, start, side="right"))
            findings.damage(file.name, f"row group {group} of {len(groups)} cannot be read ({_line(error)})", start)
            return
        if batch is None:
            break
        size += batch.nbytes
        if size > most:
            what = f"its rows have more than {most:,} bytes, expected at most {_MOST_TIMES} times those of the file"
            findings.damage(file.name, what, start)
            return
        yield start, pa.Table.from_batches([batch])
        start += batch.num_rows
    if start != opened.metadata.num_rows:
        findings.damage(file.name, f"has {start} rows, expected {opened.metadata.num_rows} as its footer says")


def as_array(values: pa.ChunkedArray | pa.Array) -> pa.Array:
    """Returns a column of a row group as one array."""
    found = values.combine_chunks() if isinstance(values, pa.ChunkedArray) else values
    return pa.concat_arrays(found.chunks) if isinstance(found, pa.ChunkedArray) else found


def checksum_in_chunks(folder: RunFolder, path: str) -> str:
    """Returns the checksum of a file of any size, by its path as the file system names it.

    Raises:
        OSError: The file cannot be read.
    """
    digest = hashlib.sha256()
    with folder.filesystem.open_input_stream(path) as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def _line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
