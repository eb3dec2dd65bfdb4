"""Writes a run as a folder for a dataset hub: card, Parquet by split, pictures, schemas, licences and Croissant metadata."""

import json
import os
import re
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from glob import escape
from itertools import chain
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stable_data.assets.licences import attribution_text, normalise_licence
from stable_data.atomic_files import temporary_path
from stable_data.code_version import code_version
from stable_data.content_id import content_id
from stable_data.errors import ConfigError, cannot_write
from stable_data.publishing.asset_licences import AssetLicence, asset_licences, licence_table, refuse_licences
from stable_data.publishing.croissant import FIRST_VERSION, CroissantFile, croissant_document, missing_entries
from stable_data.publishing.dataset_card import (
    ATTRIBUTION_FILE,
    CROISSANT_FILE,
    LICENCE_FILE,
    NOT_KNOWN,
    UNSPLIT,
    CardContent,
    PublishedTable,
    SplitNames,
    card_text,
    list_licences,
)
from stable_data.publishing.previews import SHEET, previews
from stable_data.publishing.private_paths import public_value, rows_without_folders, without_folders
from stable_data.storage.checksums import CHECKSUMS, checksum_of
from stable_data.storage.id_hashes import IdSet
from stable_data.storage.json_schemas import write_contracts
from stable_data.storage.manifest import CHECKED, COMPLETE, DIGEST, MANIFEST, PLANNED, read_manifest, write_manifest
from stable_data.storage.run_folder import LOCK, RunFolder, Uri
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.verification.findings import Finding
from stable_data.verification.verifier import Progress, Verification, VerifyOptions, verify_run

_SHARD_BYTES, _SHARD_BYTES_OF = 64 * 10**6, {"scenes": 16 * 10**6}
_DATASET_VERSION = re.compile(r"(0|[1-9]\d*)(\.(0|[1-9]\d*)){2}", re.ASCII)
_VERDICTS = ("clean", "stable", "task_reachable", "task_graspable")


@dataclass(frozen=True, slots=True)
class PublishOptions:
    """What the publisher says.

    Attributes:
        title: Title of the dataset; empty: the name of the run.
        licence: Licence of the rows themselves; empty if the publisher states none.
        url: Where the dataset will be; empty if it is not known.
        creators: Names of the people who made the dataset.
        organizations: Names of the organizations that made it.
        citation: How to cite it; empty if the publisher does not say.
        version: Version of the dataset, of three numbers.
        allow_unknown_licences: Whether assets without a known licence are published.
        allow_no_derivatives: Whether assets are published that must not be passed on changed.
        unverified: Whether a run is published that is not known to be whole; the card says so.
        verify: How the run is verified.
    """

    title: str = ""
    licence: str = ""
    url: str = ""
    creators: tuple[str, ...] = ()
    organizations: tuple[str, ...] = ()
    citation: str = ""
    version: str = FIRST_VERSION
    allow_unknown_licences: bool = False
    allow_no_derivatives: bool = False
    unverified: bool = False
    verify: VerifyOptions = field(default_factory=VerifyOptions)


@dataclass(frozen=True, slots=True)
class Publication:
    """The result of :func:`publish`.

    Attributes:
        tables: The tables that were written.
        verification: The verification of the run.
        num_previews: Pictures of the card.
        left_out: Tables that this library does not know.
        missing: What ``croissant.json`` must have by its specification, and the publisher did not say.
    """

    tables: tuple[PublishedTable, ...]
    verification: Verification
    num_previews: int
    left_out: tuple[str, ...]
    missing: tuple[str, ...]


def publish(
    run: RunFolder,
    out: Uri,
    options: PublishOptions,
    tell: Callable[[Finding], None],
    progress: Progress | None = None,
) -> Publication:
    """Writes a run as a folder for a dataset hub; the folder is put in place at once.

    It is a run itself, whose shards are named by the split of their rows. What is private stays out: paths of files in messages and
    settings, the timing of shards and the report.

    Args:
        run: The run.
        out: The folder, a local one; it may not exist, or must be empty. What a killed call left beside it is removed.
        options: What the publisher says.
        tell: Called with each finding of the verification.
        progress: As for :func:`verify_run`, and called after each table.

    Raises:
        ConfigError: The run is not known to be whole (``not_whole``), a licence is unknown (``licence_unknown``) or forbids it
            (``licence_forbids``), the stated licence is none (``licence_invalid``), a file of the run is a link to a place outside of
            it (``link_leaves``), the version is none (``version_invalid``), or the folder is no local one
            (``output_invalid``), is written by another process (``locked``) or cannot be written.
    """
    if options.licence and normalise_licence(options.licence) is None:
        raise ConfigError(
            f"--licence {options.licence!r}: is no known licence, expected a name such as CC-BY-4.0", "licence_invalid"
        )
    if not _DATASET_VERSION.fullmatch(options.version):
        raise ConfigError(
            f"--dataset-version {options.version!r}: is no version, expected three numbers such as 1.1.0", "version_invalid"
        )
    if "://" in os.fspath(out):
        raise ConfigError(
            f"{out}: is the address of a store, expected a local folder; the program of the store or hub uploads it afterwards",
            "output_invalid",
        )
    target = Path(out).expanduser().absolute()
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError(f"{out}: is not empty, expected a new folder; choose another one", "output_not_empty")
    _refuse_links(run)
    licences = asset_licences(run)
    refuse_licences(licences, allow_unknown=options.allow_unknown_licences, allow_no_derivatives=options.allow_no_derivatives)
    verification = verify_run(run, tell, options.verify, progress)
    if not (verification.is_whole or options.unverified):
        raise ConfigError(f"{verification}; repair it first, or publish it all the same with --unverified", "not_whole")
    manifest = read_manifest(run) or {}
    with _new_folder(target) as folder:
        return _write(run, RunFolder(str(folder)), folder, manifest, licences, verification, options, progress)


def _refuse_links(run: RunFolder) -> None:
    """Refuses a run with links: what lies behind them may be private, and is this machine's, not the run's.

    Raises:
        ConfigError: A file that is read for the dataset lies outside of the run (``link_leaves``).
    """
    shards = (f"{table}/{Path(path).name}" for table in SCHEMAS for path in run.files(table))
    for name in chain((MANIFEST, CHECKSUMS, SHEET), shards):
        run.refuse_link_out(name)


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """Yields a folder beside another one, which it replaces at the end; after an error nothing is left."""
    aside = temporary_path(out)
    try:
        _remove_stale(out)
        aside.mkdir(parents=True)
        with RunFolder(aside).locked():
            yield aside
            (aside / LOCK).unlink()
            if out.exists():
                out.rmdir()
            aside.replace(out)
    except OSError as error:
        raise cannot_write(str(out), error) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _remove_stale(out: Path) -> None:
    """Removes what a killed call left beside a folder.

    Raises:
        ConfigError: It is still being written (``locked``).
        OSError: It cannot be removed.
    """
    for stale in out.parent.glob(f".{escape(out.name)}.tmp-*"):
        if stale.is_dir():
            try:
                with RunFolder(stale).locked():
                    shutil.rmtree(stale)
            except ConfigError as error:
                raise ConfigError(f"{out}: another process is writing it, expected one; wait for it", error.code) from error


def _write(
    run: RunFolder,
    target: RunFolder,
    folder: Path,
    manifest: Mapping[str, Any],
    licences: list[AssetLicence],
    verification: Verification,
    options: PublishOptions,
    progress: Progress | None,
) -> Publication:
    names = [name for name in SCHEMAS if run.files(name)]
    figures, written = _Figures(), list[PublishedTable]()
    for number, name in enumerate(names):
        written.append(_write_table(run, target, name, figures))
        if progress is not None:
            progress("tables", number + 1, len(names))
    tables = tuple(table for table in written if table.num_rows)
    if not tables:
        raise ConfigError(f"{run.uri}: has no rows, expected some to publish", "source_empty")
    origin = _origin(manifest)
    write_contracts(folder / "schemas")
    pictures = previews(run)
    for path, content in pictures.items():
        target.write_bytes(path, content)
    title = options.title or Path(run.root).name
    by_licence = Counter(one.licence or NOT_KNOWN for one in licences)
    card = CardContent(
        title,
        origin,
        tables,
        by_licence,
        normalise_licence(options.licence) if options.licence else None,
        without_folders(str(verification).removeprefix(f"{run.uri}: ").replace(run.uri, "the run")),
        figures.lines(),
        list(pictures),
        options.citation,
    )
    target.write_bytes("README.md", card_text(card).encode())
    files = _write_licences(target, folder, licences)
    description = f"{card.main.num_rows} rows of {card.main.name}, made by {origin.get('job')} of stable-data"
    document = croissant_document(
        title,
        description,
        list_licences(card),
        tables,
        files,
        options.creators,
        options.organizations,
        options.url,
        options.citation,
        datetime.now(UTC).date().isoformat(),
        options.version,
    )
    target.write_bytes(CROISSANT_FILE, (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode())
    write_manifest(
        target,
        {
            "job": "publish",
            "status": COMPLETE,
            "code_version": code_version(),
            "code_versions": [code_version()],
            "table_version": TABLE_VERSION,
            "dataset": str(origin.get("dataset", "")),
            "inputs": {"run": manifest.get(DIGEST)},
            "input_fingerprint": content_id({"run": manifest.get(DIGEST)}),
            "settings": {"title": options.title, "licence": options.licence},
            "counts": {table.name: table.num_rows for table in written},
            PLANNED: [],
            "origin": origin,
        },
        [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() and path.name != LOCK],
    )
    return Publication(
        tables, verification, len(pictures), tuple(set(run.tables()) - set(names)), tuple(missing_entries(document))
    )


def _write_licences(target: RunFolder, folder: Path, licences: list[AssetLicence]) -> list[CroissantFile]:
    """Writes the table and the page of the licences, if there are assets."""
    if not licences:
        return []
    sink = pa.BufferOutputStream()
    pq.write_table(licence_table(licences), sink, compression="zstd")
    target.write_bytes(LICENCE_FILE, sink.getvalue().to_pybytes())
    target.write_bytes(ATTRIBUTION_FILE, attribution_text([one.annotation() for one in licences]).encode())
    return [_described(folder, LICENCE_FILE, "licences of the assets", "application/x-parquet")]


def _described(folder: Path, name: str, description: str, media_type: str) -> CroissantFile:
    content = (folder / name).read_bytes()
    return CroissantFile(name, description, media_type, checksum_of(content), len(content))


def _write_table(run: RunFolder, target: RunFolder, name: str, figures: "_Figures") -> PublishedTable:
    """Writes the rows of a table in shards of about _SHARD_BYTES, by split."""
    limit = _SHARD_BYTES_OF.get(name, _SHARD_BYTES)
    pending: dict[str, list[pa.Table]] = defaultdict(list)
    rows, numbers, there, names = Counter[str](), Counter[str](), IdSet(), SplitNames()

    def flush(split: str) -> None:
        shard = pa.concat_tables([SCHEMAS[name].empty_table(), *pending.pop(split)])
        target.write_table(name, f"{split}.{numbers[split]:05d}", shard)
        numbers[split] += 1

    for batch in run.batches(name):
        part = pa.Table.from_batches([batch]).replace_schema_metadata(SCHEMAS[name].metadata)
        figures.note(name, part)
        if name == "textures":  # in a run each shard has those of its assets
            part = part.filter(pa.array(~there.has(part["sha256"])))
            there.add(part["sha256"])
        for split, own in _by_split(rows_without_folders(part), names):
            rows[split] += own.num_rows
            pending[split].append(own)
            if sum(each.nbytes for each in pending[split]) > limit:
                flush(split)
    for split in list(pending):
        flush(split)
    if not rows:  # a table without rows stays one
        pending[UNSPLIT] = []
        flush(UNSPLIT)
    size = sum(size for _, size, _ in target.file_stamps(name))
    return PublishedTable(name, dict(rows), size)


def _by_split(rows: pa.Table, names: SplitNames) -> Iterator[tuple[str, pa.Table]]:
    """The rows of each split, with the name of the split."""
    if "split" not in rows.column_names:
        if rows.num_rows:
            yield UNSPLIT, rows
        return
    splits = pc.fill_null(rows["split"], "")
    for split in pc.unique(splits).to_pylist():
        yield names.of(split), rows.filter(pc.equal(splits, split))


def _origin(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What a published run says of the run that it was made of: its manifest without checksums, and without paths and addresses."""
    left_out = {DIGEST, PLANNED, CHECKED, "work", "command"}
    return {key: public_value(value) for key, value in manifest.items() if key not in left_out}


class _Figures:
    """Counts the verdicts of the scenes of a run for its card."""

    def __init__(self) -> None:
        self._count, self._true, self._known = 0, Counter[str](), Counter[str]()

    def note(self, name: str, rows: pa.Table) -> None:
        """Counts the rows of a part of a table."""
        if name == "scenes":
            self._count += rows.num_rows
            for column in _VERDICTS:
                self._true[column] += pc.sum(rows[column]).as_py() or 0
                self._known[column] += rows.num_rows - rows[column].null_count

    def lines(self) -> list[str]:
        """A line for each verdict that is known of at least one scene."""
        return [
            f"`{column}`: {self._true[column]:,} of {self._known[column]:,} scenes"
            + (f"; not known of {self._count - self._known[column]:,}" if self._known[column] < self._count else "")
            for column in _VERDICTS
            if self._known[column]
        ]
