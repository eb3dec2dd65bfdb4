"""The scenes of a run that a condition takes, as a run of their own with all that belongs to them."""

import json
from collections.abc import Mapping
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION

_SHARD_BYTES = 64 * 10**6
_OF_ASSETS = ("assets", "meshes", "sdf", "features")


def count_selected(run: RunFolder, where: str) -> tuple[int, int]:
    """How many scenes of a run pass a condition, and how many there are.

    Args:
        run: The run.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.

    Raises:
        ConfigError: It is no condition on ``scenes``, or the run has no such table.
    """
    query = parse_filter(where, SCHEMAS["scenes"])
    run.warn_of_missing("scenes", query.columns)
    return run.table("scenes", ["scene_id"], query.expression).num_rows, run.num_rows("scenes")


def select(run: RunFolder, where: str, target: RunFolder) -> dict[str, int]:
    """Writes the scenes that pass a condition to another folder, with their rows of other tables and the assets that they use.

    Columns that the run lacks are null there; a warning names those of ``scenes``.

    Failures are of the run and stay there. Run again, it writes what is missing; what other code has written whole stays as it
    is.

    Args:
        run: The run.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.
        target: Where to.

    Returns:
        Rows by table.

    Raises:
        ConfigError: It is no condition on ``scenes``, the run has no such table, or the target holds something else.
    """
    query = parse_filter(where, SCHEMAS["scenes"])
    run.warn_of_missing("scenes", query.columns)
    read = {table: sorted(run.shard_ids(table)) for table in SCHEMAS if run.files(table) and table != "failures"}
    manifest = {
        "job": "query",
        "code_version": code_version(),
        "table_version": TABLE_VERSION,
        "input_fingerprint": content_id(read),
        "inputs": {"run": run.uri},
        "settings": {"where": where},
    }
    was = _former(target, manifest)
    if was and was["code_version"] != manifest["code_version"]:
        return dict(was["counts"])
    if not was:
        _write_manifest(target, manifest | {"status": "running"})
    scene_ids, asset_ids = set[str](), set[str]()
    for part in run.batches("scenes", ["scene_id", "objects"], query.expression):
        scene_ids.update(part["scene_id"].to_pylist())
        objects = pc.list_flatten(part["objects"])
        asset_ids.update(pc.struct_field(objects, "asset_id").drop_null().to_pylist())
    for table in read:
        if table == "scenes":
            _write(run, table, query.expression, target)
        elif table in _OF_ASSETS:
            _write(run, table, pc.field("asset_id").isin(_texts(asset_ids)), target)
        elif "scene_id" in SCHEMAS[table].names:
            _write(run, table, pc.field("scene_id").isin(_texts(scene_ids)), target)
        else:
            _write(run, table, pc.field("id").isin(_texts(scene_ids | asset_ids)), target)
    counts = {table: target.num_rows(table) for table in read}
    _write_manifest(target, manifest | {"status": "complete", "counts": counts})
    return counts


def _texts(values: set[str]) -> pa.Array:
    return pa.array(sorted(values), pa.string())


def _write(run: RunFolder, table: str, where: pc.Expression, target: RunFolder) -> None:
    """As few shards as the size of a file allows, so that neither memory nor the number of files grows with the run."""
    there = target.shard_ids(table)
    kept: list[pa.Table] = []
    number = 0

    def write() -> None:
        nonlocal number
        shard_id = content_id(table, number)
        if shard_id not in there:
            target.write_table(table, shard_id, pa.concat_tables([SCHEMAS[table].empty_table(), *kept]))
        kept.clear()
        number += 1

    for batch in run.batches(table, where=where):
        if batch.num_rows:
            kept.append(pa.Table.from_batches([batch]).replace_schema_metadata(SCHEMAS[table].metadata))
        if sum(part.nbytes for part in kept) > _SHARD_BYTES:
            write()
    if kept or not number:
        write()


def _former(target: RunFolder, manifest: dict[str, object]) -> dict[str, Any]:
    """The manifest of the selection that is there; empty where there is none.

    Raises:
        ConfigError: Something else is there, or a selection that other code broke off.
    """
    content = target.read_bytes("manifest.json")
    held = [table for table in SCHEMAS if target.files(table)]
    if content is None and not held:
        return {}
    try:
        was = {} if content is None else dict(json.loads(content))
    except (ValueError, TypeError):
        was = {}
    keys = ("job", "table_version", "input_fingerprint", "settings")
    refuse_changed(target.uri, {key: was.get(key) for key in keys}, {key: manifest[key] for key in keys})
    if was.get("code_version") != manifest["code_version"] and not _is_whole(target, was):
        # Shards are cut, and so named, by the code: rows that are there would be written once more, cut elsewhere.
        raise ConfigError(
            f"{target.uri}: was started by another code version ({was.get('code_version')}), expected {manifest['code_version']}; "
            "choose a new folder",
            "config_changed",
        )
    return was


def _is_whole(target: RunFolder, was: Mapping[str, Any]) -> bool:
    counts = was.get("counts")
    return (
        was.get("status") == "complete"
        and isinstance(counts, dict)
        and counts == {table: target.num_rows(table) for table in counts if target.files(table)}
    )


def _write_manifest(target: RunFolder, manifest: dict[str, object]) -> None:
    target.write_bytes("manifest.json", (json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode())
