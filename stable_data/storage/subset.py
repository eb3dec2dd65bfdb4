"""Copies the scenes of runs that pass a condition to another run, with their assets and rows of other tables."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.code_version import code_version
from stable_data.config_diff import refuse_changed
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_reader import texture_addresses
from stable_data.storage.id_hashes import IdSet, id_hashes
from stable_data.storage.manifest import COMPLETE, MANIFEST, PLANNED, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION
from stable_data.storage.table_scan import TableScan

_SHARD_BYTES = 64 * 10**6
_SHARD_BYTES_OF = {"scenes": 16 * 10**6}  # a reader of one scene reads the footer of its file
ASSET_TABLES = ("assets", "meshes", "sdf", "features")


def count_selected(run: RunFolder, where: str) -> tuple[int, int]:
    """Returns the number of scenes of a run that pass a condition, and the number of all scenes.

    Args:
        run: The run.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.

    Raises:
        ConfigError: The condition is not valid for ``scenes``, or the run has no such table or it cannot be read.
    """
    return TableScan(run, "scenes", where).count()


def select(run: RunFolder, where: str, target: RunFolder, joined: Sequence[RunFolder] = ()) -> dict[str, int]:
    """Writes the scenes that pass a condition to another folder, with their rows of other tables and their assets.

    Rows are written as they are read: the memory does not grow with the number of scenes, but for 16 bytes a selected scene, and about
    200 bytes for one that is in several runs. Columns that the run lacks are null in the target; a warning names those of ``scenes``.
    The table ``failures`` is not copied. A scene that is in several runs is taken once, from the first of them, and so are textures and
    the rows of an asset in each table, from the first run that has some; ``doubles`` in the manifest counts the scenes that were left
    out. A repeated call writes only missing shards, and leaves a complete selection of another code version unchanged.

    Args:
        run: The run.
        where: The condition, see :mod:`stable_data.storage.filter_expression`.
        target: The folder to write.
        joined: Further runs; their scenes follow those of ``run``.

    Returns:
        Number of rows by table.

    Raises:
        ConfigError: The condition is not valid for ``scenes``, a run has no such table, or the target has other content; or an asset has
            different meshes in two runs (``asset_differs``).
    """
    runs = [run, *joined]
    scans = [TableScan(one, "scenes", where) for one in runs]
    read = [
        {table: sorted(one.shard_ids(table)) for table in SCHEMAS if one.files(table) and table != "failures"} for one in runs
    ]
    manifest = {
        "job": "query",
        "code_version": code_version(),
        "table_version": TABLE_VERSION,
        "input_fingerprint": content_id(*read),
        "inputs": {"run": run.uri} | ({"joined": [one.uri for one in joined]} if joined else {}),
        "settings": {"where": where},
        PLANNED: [],  # what is selected is what there is
    }
    previous = _previous_manifest(target, manifest)
    if previous and previous["code_version"] != manifest["code_version"]:
        return dict(previous["counts"])
    if not previous:
        _refuse_different_meshes(runs, where)
        write_manifest(target, manifest | {"status": "running"})
    chosen, doubles = [_Chosen() for _ in runs], _Doubles(runs)
    found = zip(chosen, scans, strict=True)
    _write("scenes", (one.noted(doubles.without(part)) for one, scan in found for part in scan.tables()), target)
    _share_assets(runs, chosen)
    tables = [table for table in SCHEMAS if any(table in names for names in read)]
    for table in tables:
        if table != "scenes":
            parts = (part for one, source in zip(chosen, runs, strict=True) for part in _rows_of_chosen(source, table, one))
            _write(table, _without_doubles(parts, "sha256") if table == "textures" else parts, target)
    counts = {table: target.num_rows(table) for table in tables}
    left_out = {"doubles": {"scenes": doubles.count, "different": doubles.num_different}} if joined else {}
    write_manifest(target, manifest | {"status": COMPLETE, "counts": counts} | left_out)
    return counts


def _rows_of_chosen(run: RunFolder, table: str, chosen: "_Chosen") -> Iterator[pa.Table]:
    """The rows of a table that belong to the chosen scenes of a run, or to the assets that it gives."""
    if not run.files(table):
        return
    if table in ASSET_TABLES:
        yield from _rows(run, table, pc.field("asset_id").isin(_texts(chosen.given[table])))
    elif table == "textures":
        yield from _rows(run, table, pc.field("sha256").isin(_texts(images_of(run, chosen.given["meshes"]))))
    else:
        name = "scene_id" if "scene_id" in SCHEMAS[table].names else "id"
        yield from (part.filter(chosen.has(part[name])) for part in _rows(run, table))


def _without_doubles(parts: Iterable[pa.Table], column: str) -> Iterator[pa.Table]:
    """The rows of parts of a table without those whose value in a column was there before."""
    there = set[str]()
    for part in parts:
        names = part[column].to_pylist()
        first = {name: number for number, name in reversed(list(enumerate(names))) if name not in there}
        there.update(first)
        yield part.take(pa.array(sorted(first.values()), pa.int64()))


def _refuse_different_meshes(runs: Sequence[RunFolder], where: str) -> None:
    """Compares the meshes of the assets that scenes of several runs use, before anything is written.

    Raises:
        ConfigError: An asset has different meshes in two runs (``asset_differs``).
    """
    meshes: dict[str, tuple[str | None, str]] = {}
    seen = IdSet()
    for run in runs if len(runs) > 1 else ():
        used = set[str]()
        for part in TableScan(run, "scenes", where).tables(["scene_id", "objects", "surface"]):
            used |= used_assets(part.filter(pa.array(~seen.has(part["scene_id"]))))
            seen.add(part["scene_id"])
        for batch in run.batches("meshes", ["asset_id", "sha256"]) if run.files("meshes") else ():
            for name, sha256 in zip(batch["asset_id"].to_pylist(), batch["sha256"].to_pylist(), strict=True):
                if name in used:
                    there, place = meshes.setdefault(name, (sha256, run.uri))
                    if there != sha256:
                        raise ConfigError(
                            f"asset {name}: its mesh in {run.uri} is not that in {place}, expected one mesh of an asset; make the scenes "
                            "of one run again with the library of the other",
                            "asset_differs",
                        )


def _share_assets(runs: Sequence[RunFolder], chosen: Sequence["_Chosen"]) -> None:
    """Makes the scenes known, and lets the rows of each asset in each table be given by one run: the first one that has some."""
    for table in ASSET_TABLES:
        given = set[str]()
        for run, one in zip(runs, chosen, strict=True):
            there_are = one.asset_ids if len(runs) == 1 else one.asset_ids & _assets_of(run, table)
            one.given[table] = there_are - given
            given |= there_are
    given = set[str]().union(*(one.given["assets"] for one in chosen))
    for one in chosen:
        one.close(one.given["assets"] | (one.asset_ids - given))
        given |= one.asset_ids


def _assets_of(run: RunFolder, table: str) -> set[str]:
    """The ids of the assets that have rows in a table of a run; none without the table."""
    parts = run.batches(table, ["asset_id"]) if run.files(table) else ()
    return {name for part in parts for name in pc.unique(part["asset_id"]).to_pylist()}


class _Doubles:
    """The scenes whose ids are in several of some runs; of these, the one of the first run is taken.

    Args:
        runs: The runs.

    Attributes:
        count: Number of scenes that were left out because they were taken before.
        num_different: Number of these whose rows differ from the taken ones, for example because other settings made them.
    """

    def __init__(self, runs: Sequence[RunFolder]) -> None:
        self.count = self.num_different = 0
        self._repeated: dict[bytes, str | None] = {}  # hash of the id -> hash of the row, None before it was read
        if len(runs) > 1:
            parts = [id_hashes(batch["scene_id"]) for run in runs for batch in run.batches("scenes", ["scene_id"])]
            found, counts = np.unique(np.concatenate(parts), axis=0, return_counts=True)
            self._repeated = dict.fromkeys(row.tobytes() for row in found[counts > 1])

    def without(self, part: pa.Table) -> pa.Table:
        """A part of the table ``scenes`` of a run without the scenes that were taken before."""
        if not self._repeated:
            return part
        is_new = np.ones(len(part), bool)
        for number, key in enumerate(map(np.ndarray.tobytes, id_hashes(part["scene_id"]))):
            if key in self._repeated:
                content, there = content_id(part.slice(number, 1).to_pylist()), self._repeated[key]
                self.count += there is not None
                self.num_different += there is not None and there != content
                is_new[number], self._repeated[key] = there is None, there or content
        return part.filter(pa.array(is_new))


class _Chosen:
    """The ids of the selected scenes of a run and of their assets; scenes may be very many, and 16 bytes stand for one.

    Attributes:
        asset_ids: The assets of the scenes.
        given: Table of :data:`ASSET_TABLES` -> assets whose rows are taken from this run.
    """

    def __init__(self) -> None:
        self.asset_ids, self.given, self._names = set[str](), dict[str, set[str]](), IdSet()

    def noted(self, part: pa.Table) -> pa.Table:
        """Notes the scenes of a part of the table ``scenes``, and returns the part."""
        self._names.add(part["scene_id"])
        self.asset_ids |= used_assets(part)
        return part

    def close(self, asset_ids: set[str]) -> None:
        """Makes assets known too: their ids are ids of rows in tables such as ``warnings``."""
        self._names.add(_texts(asset_ids))

    def has(self, names: pa.ChunkedArray) -> pa.Array:
        """Whether each name is that of a selected scene or of an asset in use, booleans."""
        return pa.array(self._names.has(names))


def used_assets(scenes: pa.Table | pa.RecordBatch) -> set[str]:
    """The ids of the assets of rows of the table ``scenes``: of their objects, and of what they stand on."""
    holders = (pc.list_flatten(scenes["objects"]), scenes["surface"])
    return {name for holder in holders for name in pc.unique(pc.struct_field(holder, "asset_id")).drop_null().to_pylist()}


def images_of(run: RunFolder, asset_ids: set[str]) -> set[str]:
    """The hashes of the images that the looks of some assets name."""
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
    try:
        document = target.read_document(MANIFEST)
        if document is None and not any(target.files(table) for table in SCHEMAS):
            return {}
        previous = dict(document or {})
    except ConfigError:
        raise
    except (ValueError, TypeError):
        previous = {}  # a damaged manifest matches no settings
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
        previous.get("status") == COMPLETE
        and isinstance(counts, dict)
        and counts == {table: target.num_rows(table) for table in counts if target.files(table)}
    )
