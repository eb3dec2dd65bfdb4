"""The manifest of a run, ``manifest.json``: what made it, what it was planned to have and what it has.

It has a digest of itself, and once the run is complete it states the checksums of all shards (:mod:`stable_data.storage.checksums`) and
the planned items. ``stable-data verify`` compares a run with all of these.
"""

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from stable_data.errors import ConfigError
from stable_data.storage.checksums import complete_checksums
from stable_data.storage.id_hashes import IdSet
from stable_data.storage.run_folder import RunFolder

MANIFEST = "manifest.json"
"""Name of the file in the run's folder."""

COMPLETE = "complete"
"""The ``status`` of a run that has all of its shards."""

DIGEST, PLANNED, CHECKED = "digest", "planned", "checksums"
"""Keys of the manifest: its own hash, the planned items (:class:`PlannedItems`), and what it says of the checksums."""


@dataclass(frozen=True, slots=True)
class PlannedItems:
    """Items of a job, each of which is rows of a table, or a row of ``failures``.

    Attributes:
        table: The table.
        column: Column of their ids; a dot leads to a field of a struct.
        count: Number of different ids.
        digest: :func:`digest_of_ids` of the ids.
        lost: Whether items that failed before shards were planned are among them.
        failed_key: Key of the number of failed items in the manifest's ``counts``; None if it has no such number.
    """

    table: str
    column: str
    count: int
    digest: str
    lost: bool = True
    failed_key: str | None = None

    @classmethod
    def of(
        cls, table: str, column: str, ids: Iterable[str], *, lost: bool = True, failed_key: str | None = None
    ) -> "PlannedItems":
        """Returns the record of items with these ids; the other arguments are the attributes."""
        known = IdSet()
        known.add(pa.array(list(ids), pa.string()))
        return cls(table, column, len(known), digest_of_ids(known), lost, failed_key)


def digest_of_ids(ids: IdSet) -> str:
    """Returns a hash of a set of ids."""
    return hashlib.sha256(ids.hashes.astype("<u8").tobytes()).hexdigest()


def read_manifest(folder: RunFolder) -> dict[str, Any] | None:
    """Returns the manifest of a run, or None if there is none.

    Raises:
        ConfigError: The file is not a manifest (``manifest_invalid``), or cannot be read.
    """
    try:
        document = folder.read_document(MANIFEST)
        if document is None:
            return None
        found = dict(document)
        return found | {key: dict(found.get(key, {})) for key in ("settings", "inputs")}
    except ConfigError:
        raise
    except (ValueError, TypeError) as error:
        raise ConfigError(
            f"{folder.uri}/{MANIFEST}: not a JSON object ({error}); is this the folder of a run?", "manifest_invalid"
        ) from error


def write_manifest(folder: RunFolder, manifest: Mapping[str, Any], others: Collection[str] = ()) -> dict[str, Any]:
    """Writes the manifest of a run; that of a complete run also stores the checksums of its shards.

    Args:
        folder: The run.
        manifest: The manifest. Its digest is replaced, and so is what it says of the checksums.
        others: Files of a complete run that are no shards, and whose checksums are stored too.

    Returns:
        The manifest as it was written.

    Raises:
        ConfigError: A file cannot be written, or a shard without checksum cannot be read.
    """
    content = {key: value for key, value in manifest.items() if key not in (DIGEST, CHECKED)}
    if content.get("status") == COMPLETE:
        content[CHECKED] = complete_checksums(folder, others)
    content[DIGEST] = manifest_digest(content)
    text = json.dumps(content, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
    folder.write_bytes(MANIFEST, text.encode())
    return content


def manifest_digest(manifest: Mapping[str, Any]) -> str:
    """Returns the hash of all entries of a manifest but its digest."""
    entries = {key: value for key, value in manifest.items() if key != DIGEST}
    plain = json.loads(json.dumps(entries))  # as it is read again: keys are text, tuples are lists
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()
