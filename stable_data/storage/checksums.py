"""The checksums of the shards of a run: the file ``SHA256SUMS``, which ``sha256sum -c SHA256SUMS`` checks too.

That of a published run also has those of its other files: card, pictures, licences, schemas and metadata.

A checksum is that of the bytes as they were written: no file is read for it. Whoever writes a shard has it
(:attr:`stable_data.storage.run_folder.RunFolder.written`), and the driver of a job stores it. Only where a driver was killed before it
stored the last ones, or where a run is older than this file, are shards read once.
"""

import hashlib
import io
import re
from collections.abc import Collection, Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from pathlib import PurePosixPath
from typing import Any

from stable_data.errors import ConfigError
from stable_data.limits import LIMITS, at_most
from stable_data.storage.run_folder import PART, RunFolder

CHECKSUMS = "SHA256SUMS"
"""Name of the file in the run's folder."""

_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")
_REMEDY = "delete the file and run the job again, which makes it anew"
_AT_ONCE = 8  # files of an object store have a latency


def read_checksums(folder: RunFolder) -> dict[str, str] | None:
    """Returns the checksums of a run by file, such as ``table/part-id.parquet`` -> SHA-256; None if the run has none.

    Raises:
        ConfigError: The file has another form or is too large (``checksums_invalid``), or cannot be read.
    """
    content = read_checksum_file(folder)
    return None if content is None else checksums_in(content, folder)


def read_checksum_file(folder: RunFolder) -> bytes | None:
    """Returns the content of the file of checksums; None if there is none.

    Raises:
        ConfigError: It is too large (``checksums_invalid``), or cannot be read.
    """
    content = folder.read_bytes(CHECKSUMS, LIMITS.text.max_checksum_bytes + 1)
    if content is not None and len(content) > LIMITS.text.max_checksum_bytes:
        raise ConfigError(
            f"{folder.uri}/{CHECKSUMS}: is larger, expected {at_most(LIMITS.text, 'max_checksum_bytes', 'bytes')}; {_REMEDY}",
            "checksums_invalid",
        )
    return content


def checksums_in(content: bytes, folder: RunFolder) -> dict[str, str]:
    """Returns the checksums in the content of the file of a run; see :func:`read_checksums`.

    Raises:
        ConfigError: It has another form (``checksums_invalid``).
    """
    found = dict[str, str]()
    for number, row in enumerate(io.BytesIO(content), 1):  # a list of all lines could need much more memory than the file
        line = row.rstrip(b"\r\n").decode("utf-8", "replace")
        match = _LINE.fullmatch(line)
        if match is None or match[2] in found:
            raise ConfigError(
                f"{folder.uri}/{CHECKSUMS}: line {number} is {line[:80]!r}, expected a SHA-256, two spaces and a file, each file once; "
                f"{_REMEDY}",
                "checksums_invalid",
            )
        found[match[2]] = match[1]
    return found


def save_checksums(folder: RunFolder) -> None:
    """Stores the checksums of what was written meanwhile, beside those that are stored already; shards need not be complete.

    Raises:
        ConfigError: The file cannot be written, or has another form.
    """
    if folder.written:
        _write(folder, (read_checksums(folder) or {}) | folder.written)


def take_checksums(folder: RunFolder, tables: Collection[str]) -> dict[str, str]:
    """Removes the checksums of some tables from the file, before shards of them are replaced, and returns them.

    A replacement that is stopped leaves no checksum of a file that it has replaced.

    Raises:
        ConfigError: The file cannot be read or written, or has another form.
    """
    known = read_checksums(folder) or {}
    taken = {name: checksum for name, checksum in known.items() if name.partition("/")[0] in tables}
    if taken:
        _write(folder, {name: checksum for name, checksum in known.items() if name not in taken})
    return taken


def forget_shards(folder: RunFolder, shards: Mapping[str, Set[str]]) -> None:
    """Removes the checksums of shards that are made anew, before they are.

    A driver that is killed then leaves no checksum of a file that was replaced.

    Args:
        folder: The run.
        shards: Table -> ids of its shards.

    Raises:
        ConfigError: As :func:`take_checksums`.
    """
    known = read_checksums(folder) or {}
    kept = {name: checksum for name, checksum in known.items() if _shard_of(name) not in shards.get(name.partition("/")[0], ())}
    if len(kept) < len(known):
        _write(folder, kept)


def refuse_changed_files(folder: RunFolder, tables: Collection[str]) -> None:
    """Refuses shards that are not as they were written, before shards of these tables are replaced: that would hide it.

    Raises:
        ConfigError: A file is missing or has another checksum than the one that is stored of it (``shard_changed``), or cannot be
            read.
    """
    known = {name: c for name, c in (read_checksums(folder) or {}).items() if name.partition("/")[0] in tables}
    there = {f"{table}/{PurePosixPath(path).name}" for table in tables for path in folder.files(table)}
    names = sorted(known.keys() & there)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        found = pool.map(lambda name: _checksum(folder, name), names)
        changed = [name for name, checksum in zip(names, found, strict=True) if checksum != known[name]]
    if changed := [*changed, *sorted(known.keys() - there)]:
        raise ConfigError(
            f"{folder.uri}: {len(changed)} files such as {changed[0]} are not as they were written, expected those of {CHECKSUMS}; see "
            "stable-data verify RUN, delete the changed ones, and run the job of the run again",
            "shard_changed",
        )


def complete_checksums(folder: RunFolder, others: Collection[str] = ()) -> dict[str, Any]:
    """Stores the checksums of all shards that are there; those that are not known are computed from the files.

    Checksums of files that are no shards, such as the card of a published run, stay as they are stored.

    Args:
        folder: The run.
        others: Files that are no shards, and whose checksums are stored too.

    Returns:
        What the manifest says of them: the number of ``files``, and the ``sha256`` of the file with the checksums.

    Raises:
        ConfigError: A shard cannot be read, or the file cannot be written.
    """
    known = (read_checksums(folder) or {}) | folder.written
    names = [f"{table}/{PurePosixPath(path).name}" for table in folder.tables() for path in folder.files(table)]
    names += sorted({*others, *(name for name in known if not is_shard_file(name))})
    unknown = [name for name in names if name not in known]
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        known |= zip(unknown, pool.map(lambda name: _checksum(folder, name), unknown), strict=True)
    return {"files": len(names), "sha256": _write(folder, {name: known[name] for name in names})}


def is_shard_file(name: str) -> bool:
    """Whether a file of a run, by its name in the folder, is one of a shard, ``table/part-id.parquet``."""
    return name.count("/") == 1 and PART.fullmatch(PurePosixPath(name).name) is not None


def checksum_of(content: bytes) -> str:
    """Returns the checksum of the content of a file, 64 hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def _checksum(folder: RunFolder, name: str) -> str:
    content = folder.read_bytes(name)
    if content is None:
        raise ConfigError(f"{folder.uri}/{name}: was removed meanwhile, expected a shard; run again", "shard_missing")
    return checksum_of(content)


def _shard_of(name: str) -> str:
    match = PART.fullmatch(PurePosixPath(name).name)
    return "" if match is None else match[1]


def _write(folder: RunFolder, checksums: Mapping[str, str]) -> str:
    """Writes the file; returns its own checksum."""
    content = "".join(f"{checksums[name]}  {name}\n" for name in sorted(checksums)).encode()
    folder.write_bytes(CHECKSUMS, content)
    return checksum_of(content)
