"""Changes of a run in its own folder: an older one is brought up to date, or what was rejected is deleted from it.

Both replace one file after another, each at once. A change that was stopped is completed by the same call.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from stable_data.errors import ConfigError, cannot_read
from stable_data.storage.checksums import CHECKSUMS, refuse_changed_files, take_checksums
from stable_data.storage.manifest import (
    COMPLETE,
    DIGEST,
    MANIFEST,
    PLANNED,
    manifest_digest,
    read_manifest,
    write_manifest,
)
from stable_data.storage.parquet_files import open_parquet, read_row_groups
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schema_checks import check_required, check_schema, conform_to_schema, is_older_version, version_of
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.storage.subset import ASSET_TABLES, images_of, used_assets

PRUNED = "pruned"
"""The key of a manifest which says that rejected scenes were deleted, with the numbers of rows by table."""

_OF_SCENES = ("settled", "grasps", "rejected")

_WITHOUT_NUMBERS = frozenset({"query", "draft-edits", "import scenes", "supports"})
"""Jobs whose older manifests do not state the number of their items."""


@dataclass(frozen=True, slots=True)
class Upgrade:
    """What an upgrade has changed.

    Attributes:
        num_files: Files that were of an older version.
        has_new_checksums: Whether the run had no checksums.
        has_new_plan: Whether its manifest said nothing of planned items, so that those that are there count as all of them.
    """

    num_files: int
    has_new_checksums: bool
    has_new_plan: bool

    def __str__(self) -> str:
        """Returns in one line what was changed."""
        found = [f"{self.num_files} files were of an older version"] * bool(self.num_files)
        found += ["its files had no checksums, and have those of today"] * self.has_new_checksums
        found += ["its manifest did not say which items were planned: those that are there count as all"] * self.has_new_plan
        return "; ".join(found) or "is up to date"


def upgrade(run: RunFolder) -> Upgrade:
    """Brings the tables of a run to the present version; columns that did not exist are null, unknown.

    A run without checksums gets those of its files as they are now, and one whose job states no number of items an empty plan. The
    job that wrote a run of an older version does not continue it afterwards; its manifest keeps the version with which it was written.

    Args:
        run: The run.

    Raises:
        ConfigError: It is no run, a file cannot be read or was changed since it was written (``shard_changed``), or its version is
            unknown or newer (``table_version``); files that were brought up to date before stay so.
    """
    count = 0
    with run.locked():
        manifest = _manifest_of(run)
        refuse_changed_files(run, SCHEMAS)
        is_complete = manifest.get("status") == COMPLETE
        has_checksums = run.has_file(CHECKSUMS)
        known = take_checksums(run, SCHEMAS)
        for table in SCHEMAS:
            count += _change(run, table, partial(_to_present_version, table, f"{run.uri}/{table}"), known)
        manifest |= {"upgraded_to": TABLE_VERSION} if manifest.get("table_version") != TABLE_VERSION else {}
        gets_plan = is_complete and PLANNED not in manifest and str(manifest.get("job")) in _WITHOUT_NUMBERS
        manifest |= {PLANNED: []} if gets_plan else {}
        write_manifest(run, manifest)
    return Upgrade(count, is_complete and not has_checksums, gets_plan)


def prune(run: RunFolder) -> dict[str, int]:
    """Deletes the rejected scenes of a run, and the assets and textures that no accepted scene uses.

    What was asked and answered for the rejected scenes, in ``turns`` and ``failures``, is kept.

    Args:
        run: The run, complete.

    Returns:
        The number of deleted rows by table, also of those that a call which was stopped has deleted before.

    Raises:
        ConfigError: It is no run, it is not complete (``run_incomplete``), it has no table ``rejected`` (``table_missing``), or a
            file was changed since it was written (``shard_changed``).
    """
    with run.locked():
        manifest = _manifest_of(run)
        if manifest.get("status") != "complete":
            raise ConfigError(f"{run.uri}: is not complete, expected a complete run; run its job again first", "run_incomplete")
        if not run.files("rejected"):
            found = "has no table rejected, expected a run of generate, which alone has rejected scenes"
            raise ConfigError(f"{run.uri}: {found}; there is nothing to delete", "table_missing")
        tables = [table for table in (*ASSET_TABLES, "textures", *_OF_SCENES) if run.files(table)]
        refuse_changed_files(run, tables)
        # The manifest still counts what a call that was stopped has deleted.
        before = {table: max(run.num_rows(table), manifest["counts"].get(table, 0)) for table in tables}
        write_manifest(run, manifest | {PRUNED: dict(manifest.get(PRUNED, {}))})  # from now on, shards do not contain all rows
        scenes, asset_ids = _in_use(run)
        kept, known = pa.array(sorted(asset_ids), pa.string()), take_checksums(run, tables)
        for table in ASSET_TABLES:
            _change(run, table, lambda rows: rows.filter(pc.is_in(rows["asset_id"], kept)), known)
        if "textures" in tables:
            images = pa.array(sorted(images_of(run, asset_ids)), pa.string())
            _change(run, "textures", lambda rows: rows.filter(pc.is_in(rows["sha256"], images)), known)
        for table in _OF_SCENES:  # rejected last: as long as its rows are there, a repeated call deletes the rest
            _change(run, table, lambda rows: rows.filter(pc.is_in(rows["scene_id"], scenes)), known)
        deleted = {table: count - run.num_rows(table) for table, count in before.items()}
        was = manifest.get(PRUNED, {})
        counts = manifest["counts"] | {table: count - deleted[table] for table, count in before.items()}
        pruned = {table: deleted[table] + was.get(table, 0) for table in tables}
        write_manifest(run, manifest | {"counts": counts, PRUNED: pruned})
    return deleted


def _manifest_of(run: RunFolder) -> dict[str, Any]:
    found = read_manifest(run)
    if found is None:
        raise ConfigError(f"{run.uri}: has no manifest.json, expected the folder of a run", "not_a_run")
    if found.get(DIGEST) not in (None, manifest_digest(run.read_document(MANIFEST))):
        raise ConfigError(
            f"{run.uri}/{MANIFEST}: was edited after it was written, and a change of the run would hide it; undo that first",
            "manifest_changed",
        )
    return found


def _change(run: RunFolder, table: str, change: Callable[[pa.Table], pa.Table], known: Mapping[str, str]) -> int:
    """Replaces the files of a table of which a function changes the rows or the schema; returns their number.

    Other files keep the checksum that is known of them.
    """
    count = 0
    for path in run.files(table):
        try:
            file = open_parquet(path, filesystem=run.filesystem)
            rows = read_row_groups(file, path, range(file.num_row_groups)).replace_schema_metadata(file.schema_arrow.metadata)
        except (pa.ArrowException, OSError) as error:
            raise cannot_read(run.uri, path, error) from error
        changed = change(rows)
        if changed.num_rows != rows.num_rows or not changed.schema.equals(rows.schema, check_metadata=True):
            run.write_file(table, Path(path).name, changed)
            count += 1
        elif (name := f"{table}/{Path(path).name}") in known:
            run.written[name] = known[name]
    return count


def _to_present_version(table: str, where: str, rows: pa.Table) -> pa.Table:
    """A table with the present version; unchanged if it has it."""
    if is_older_version(version_of(rows.schema)):
        check_required(rows.schema, table, where)
        return conform_to_schema(rows, SCHEMAS[table])
    check_schema(rows.schema, table, where)
    return rows


def _in_use(run: RunFolder) -> tuple[pa.Array, set[str]]:
    """The ids of the scenes of a run, and of the assets that they use."""
    scenes, asset_ids = list[str](), set[str]()
    for batch in run.batches("scenes", ["scene_id", "objects", "surface"]):
        scenes += batch["scene_id"].to_pylist()
        asset_ids |= used_assets(batch)
    return pa.array(sorted(scenes), pa.string()), asset_ids
