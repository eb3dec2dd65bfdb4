"""Checks the files of a published run that are no shards: its card, its pictures, licences, schemas and metadata."""

from collections.abc import Mapping
from pathlib import PurePosixPath

from stable_data.storage.checksums import CHECKSUMS, is_shard_file
from stable_data.storage.manifest import MANIFEST
from stable_data.storage.run_folder import RunFolder
from stable_data.verification.findings import Findings
from stable_data.verification.shard_files import checksum_in_chunks, tell_of_link

_STATED_ELSEWHERE = frozenset({MANIFEST, CHECKSUMS})
"""Files that no checksum is stored of: the manifest has a digest of itself, and the hash of the checksums."""


def check_other_files(folder: RunFolder, checksums: Mapping[str, str], findings: Findings, *, is_published: bool) -> int:
    """Compares the files that are no shards with their checksums, and returns their number.

    A further file in the folder of a published run is damage. Hidden files are left out, because programs of dataset hubs write some.

    Args:
        folder: The run.
        checksums: File -> SHA-256.
        findings: Where damage is noted.
        is_published: Whether the run is a published one; only such a run has checksums of other files.

    Raises:
        ConfigError: The folder cannot be read.
    """
    stated = {name: checksum for name, checksum in checksums.items() if not is_shard_file(name)}
    if is_published and not stated:
        findings.cannot_know(
            f"{CHECKSUMS} names no files but those of the tables: the run was published by an older version, and its card, pictures, "
            "licences and metadata may have been changed"
        )
    tables = frozenset(folder.tables())
    there = {name: path for name, path in folder.files_below() if name.partition("/")[0] not in tables} if stated else {}
    for name, checksum in stated.items():
        if name not in there:
            findings.damage(name, f"is missing, expected the file of {CHECKSUMS}")
            continue
        tell_of_link(folder, name, findings)
        try:
            found = checksum_in_chunks(folder, there[name])
        except OSError as error:
            findings.damage(name, f"cannot be read ({error})")
            continue
        if found != checksum:
            findings.damage(
                name, f"has the SHA-256 {found[:16]}…, expected {checksum[:16]}… as {CHECKSUMS} says; it was changed"
            )
    strange = there.keys() - stated.keys() - _STATED_ELSEWHERE if is_published else set[str]()
    for name in sorted(name for name in strange if not any(part.startswith(".") for part in PurePosixPath(name).parts)):
        findings.damage(name, f"is not in {CHECKSUMS}, expected no further files")
    return len(stated)
