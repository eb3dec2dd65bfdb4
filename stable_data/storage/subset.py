"""Copies the scenes of a run that pass a condition to another run, with their assets and rows of other tables."""

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_reader import texture_addresses
from stable_data.storage.id_hashes import Hashes, id_hashes
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.storage.table_scan import TableScan

_SHARD_BYTES = 64 * 10**6
_SHARD_BYTES_OF = {"scenes": 16 * 10**6}  # a reader of one scene reads the footer of its file
_ASSET_TABLES = ("assets", "meshes", "sdf", "features")


def count_selected(run: RunFolder, where: str) -> tuple[int, int]:
    """Returns the number of scenes of a run that pass a condition, and the number of all scenes.

    Args:
        run: The run.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.

    Raises:
        ConfigError: The condition is not valid for ``scenes``, or the run has no such table or it cannot be read.
    """
    return TableScan(run, "scenes", where).count()


def select(run: RunFolder, where: str, target: RunFolder) -> dict[str, int]:
    """Writes the scenes that pass a condition to another folder, with their rows of other tables and their assets.

    Rows are written as they are read: the memory does not grow with the number of scenes, but for 16 bytes a selected scene.
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
    scan = TableScan(run, "scenes", where)
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
    chosen = _Chosen()
    _write("scenes", map(chosen.noted, scan.tables()), target)
    chosen.close()
    for table in read:
        if table in _ASSET_TABLES:
            _write(table, _rows(run, table, pc.field("asset_id").isin(_texts(chosen.asset_ids))), target)
        elif table == "textures":
            _write(table, _rows(run, table, pc.field("sha256").isin(_texts(_images_of(run, chosen.asset_ids)))), target)
        elif table != "scenes":
            name = "scene_id" if "scene_id" in SCHEMAS[table].names else "id"
            _write(table, (part.filter(chosen.has(part[name])) for part in _rows(run, table)), target)
    counts = {table: target.num_rows(table) for table in read}
    _write_manifest(target, manifest | {"status": "complete", "counts": counts})
    return counts


class _Chosen:
    """The ids of the selected scenes and of their assets; scenes and assets may be very many, and 16 bytes stand for a scene.

    A scene is known by a hash of 128 bits of its id: two ids of a run with one hash are less likely than an error of the memory.
    """

    def __init__(self) -> None:
        self.asset_ids = set[str]()
        self._parts = list[Hashes]()
        self._first = self._second = np.zeros(0, np.uint64)

    def noted(self, part: pa.Table) -> pa.Table:
        """Notes the scenes of a part of the table ``scenes``, and returns the part."""
        self._parts.append(id_hashes(part["scene_id"]))
        objects = pc.list_flatten(part["objects"])
        for holder in (objects, part["surface"]):
            self.asset_ids.update(pc.unique(pc.struct_field(holder, "asset_id")).drop_null().to_pylist())
        return part

    def close(self) -> None:
        """Makes the scenes known; the ids of assets are ids of rows too, in tables such as ``warnings``."""
        hashes = np.concatenate([*self._parts, id_hashes(_texts(self.asset_ids))])
        self._parts.clear()
        order = np.argsort(hashes[:, 0])
        self._first, self._second = hashes[order, 0], hashes[order, 1]

    def has(self, names: pa.ChunkedArray) -> pa.Array:
        """Whether each name is that of a selected scene or of an asset in use, booleans."""
        first, second = id_hashes(names).T
        places = np.searchsorted(self._first, first)
        found, is_open = np.zeros(len(first), bool), np.ones(len(first), bool)
        while is_open.any():  # one round, unless two ids share half of their hash
            is_open &= places < len(self._first)
            is_open[is_open] = self._first[places[is_open]] == first[is_open]
            found[is_open] = self._second[places[is_open]] == second[is_open]
            is_open &= ~found
            places += 1
        return pa.array(found)


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


def _rows(run: RunFolder, table: str, where: pc.Expression | None = None) -> Iterator[pa.Table]:
    for batch in run.batches(table, where=where):
        yield pa.Table.from_batches([batch])


def _write(table: str, parts: Iterable[pa.Table], target: RunFolder) -> None:
    """Writes rows of a table in shards of about _SHARD_BYTES: few files, and bounded memory."""
    existing = target.shard_ids(table)
    pending: list[pa.Table] = []
    size = number = 0

    def write() -> None:
        nonlocal number, size
        shard_id = content_id(table, number)
        if shard_id not in existing:
            target.write_table(table, shard_id, pa.concat_tables([SCHEMAS[table].empty_table(), *pending]))
        pending.clear()
        number, size = number + 1, 0

    for whole in parts:
        for part in _pieces(whole.replace_schema_metadata(SCHEMAS[table].metadata), _SHARD_BYTES_OF.get(table, _SHARD_BYTES)):
            pending.append(part)
            size += part.nbytes
            if size > _SHARD_BYTES_OF.get(table, _SHARD_BYTES):
                write()
    if pending or not number:  # a table without rows gets one empty shard
        write()


def _pieces(table: pa.Table, max_bytes: int) -> Iterator[pa.Table]:
    """Yields the rows of a table in slices of at most about ``max_bytes``."""
    if not table.num_rows:
        return
    step = max(1, table.num_rows * max_bytes // max(1, table.nbytes))
    yield from (table.slice(start, step) for start in range(0, table.num_rows, step))


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
