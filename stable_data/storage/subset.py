"""Copies the scenes of a run that pass a condition to another run, with their assets and rows of other tables."""

import json
from collections.abc import Mapping
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_reader import texture_addresses
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION

_SHARD_BYTES = 64 * 10**6
_ASSET_TABLES = ("assets", "meshes", "sdf", "features")


def count_selected(run: RunFolder, where: str) -> tuple[int, int]:
    """Returns the number of scenes of a run that pass a condition, and the number of all scenes.

    Args:
        run: The run.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.

    Raises:
        ConfigError: The condition is not valid for ``scenes``, or the run has no such table.
    """
    query = parse_filter(where, SCHEMAS["scenes"])
    run.warn_of_missing("scenes", query.columns)
    return run.table("scenes", ["scene_id"], query.expression).num_rows, run.num_rows("scenes")


def select(run: RunFolder, where: str, target: RunFolder) -> dict[str, int]:
    """Writes the scenes that pass a condition to another folder, with their rows of other tables and their assets.

    Columns that the run lacks are null in the target; a warning names those of ``scenes``. The table ``failures`` is not
    copied. A repeated call writes only missing shards, and leaves a complete selection of another code version unchanged.

    Args:
        run: The run.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.
        target: The folder to write.

    Returns:
        Number of rows by table.

    Raises:
        ConfigError: The condition is not valid for ``scenes``, the run has no such table, or the target has other content.
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
    previous = _previous_manifest(target, manifest)
    if previous and previous["code_version"] != manifest["code_version"]:
        return dict(previous["counts"])
    if not previous:
        _write_manifest(target, manifest | {"status": "running"})
    scene_ids, asset_ids = set[str](), set[str]()
    for part in run.batches("scenes", ["scene_id", "objects", "surface"], query.expression):
        scene_ids.update(part["scene_id"].to_pylist())
        objects = pc.list_flatten(part["objects"])
        for holder in (objects, part["surface"]):
            asset_ids.update(pc.struct_field(holder, "asset_id").drop_null().to_pylist())
    for table in read:
        if table == "scenes":
            _write(run, table, query.expression, target)
        elif table in _ASSET_TABLES:
            _write(run, table, pc.field("asset_id").isin(_texts(asset_ids)), target)
        elif table == "textures":
            _write(run, table, pc.field("sha256").isin(_texts(_images_of(run, asset_ids))), target)
        elif "scene_id" in SCHEMAS[table].names:
            _write(run, table, pc.field("scene_id").isin(_texts(scene_ids)), target)
        else:
            _write(run, table, pc.field("id").isin(_texts(scene_ids | asset_ids)), target)
    counts = {table: target.num_rows(table) for table in read}
    _write_manifest(target, manifest | {"status": "complete", "counts": counts})
    return counts


def _images_of(run: RunFolder, asset_ids: set[str]) -> set[str]:
    """The images that the looks of some assets name."""
    found = set[str]()
    if not run.files("meshes"):
        return found
    for batch in run.batches("meshes", ["look"], pc.field("asset_id").isin(_texts(asset_ids))):
        for look in batch["look"]:
            found.update(texture_addresses(look.as_py()))
    return found


def _texts(values: set[str]) -> pa.Array:
    return pa.array(sorted(values), pa.string())


def _write(run: RunFolder, table: str, where: pc.Expression, target: RunFolder) -> None:
    """Writes the selected rows of a table in shards of about _SHARD_BYTES: few files, and bounded memory."""
    existing = target.shard_ids(table)
    pending: list[pa.Table] = []
    number = 0

    def write() -> None:
        nonlocal number
        shard_id = content_id(table, number)
        if shard_id not in existing:
            target.write_table(table, shard_id, pa.concat_tables([SCHEMAS[table].empty_table(), *pending]))
        pending.clear()
        number += 1

    for batch in run.batches(table, where=where):
        if batch.num_rows:
            pending.append(pa.Table.from_batches([batch]).replace_schema_metadata(SCHEMAS[table].metadata))
        if sum(part.nbytes for part in pending) > _SHARD_BYTES:
            write()
    if pending or not number:  # a table without rows gets one empty shard
        write()


def _previous_manifest(target: RunFolder, manifest: dict[str, object]) -> dict[str, Any]:
    """Returns the manifest of an earlier selection in the target; empty if the target is empty.

    Raises:
        ConfigError: The target has other content, or an incomplete selection of another code version.
    """
    content = target.read_bytes("manifest.json")
    if content is None and not any(target.files(table) for table in SCHEMAS):
        return {}
    try:
        previous = {} if content is None else dict(json.loads(content))
    except (ValueError, TypeError):
        previous = {}
    keys = ("job", "table_version", "input_fingerprint", "settings")
    refuse_changed(target.uri, {key: previous.get(key) for key in keys}, {key: manifest[key] for key in keys})
    if previous.get("code_version") != manifest["code_version"] and not _is_complete(target, previous):
        # Another code version may divide the rows into other shards, so existing rows could be written twice.
        raise ConfigError(
            f"{target.uri}: was started by another code version ({previous.get('code_version')}), "
            f"expected {manifest['code_version']}; choose a new folder",
            "config_changed",
        )
    return previous


def _is_complete(target: RunFolder, previous: Mapping[str, Any]) -> bool:
    counts = previous.get("counts")
    return (
        previous.get("status") == "complete"
        and isinstance(counts, dict)
        and counts == {table: target.num_rows(table) for table in counts if target.files(table)}
    )


def _write_manifest(target: RunFolder, manifest: dict[str, object]) -> None:
    target.write_bytes("manifest.json", (json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode())
