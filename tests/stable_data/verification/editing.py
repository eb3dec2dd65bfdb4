"""Ways to damage a run: as a disk or a person does, and as somebody does who also makes all checksums, counts and digests fit."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stable_data.storage.checksums import CHECKSUMS
from stable_data.storage.manifest import read_manifest, write_manifest
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, TABLE_VERSION, Row

Damage: TypeAlias = Callable[[Path], None]
Change: TypeAlias = Callable[[list[Row]], list[Row] | None]


def files_of(run: Path, table: str, *, with_rows: bool = True) -> list[Path]:
    """The files of a table; those without rows are left out."""
    found = sorted((run / table).glob("part-*.parquet"))
    return [path for path in found if not with_rows or pq.read_metadata(path).num_rows]


def flip(table: str, place: float, bit: int = 0x10) -> Damage:
    """Flips a bit of the first file of a table, at a share of its length."""

    def damage(run: Path) -> None:
        path = files_of(run, table, with_rows=False)[0]
        content = bytearray(path.read_bytes())
        content[min(len(content) - 1, int(place * len(content)))] ^= bit
        path.write_bytes(content)

    return damage


def rows(table: str, change: Change, *, number: int = 0, recounts: bool = False, hidden: bool = True) -> Damage:
    """Changes the rows of a file of a table.

    Args:
        table: The table.
        change: Changes the rows in place, or returns other ones.
        number: Number of the file among those with rows.
        recounts: Whether the counts of the manifest are made to fit.
        hidden: Whether checksums and digest are made to fit.
    """

    def damage(run: Path) -> None:
        path = files_of(run, table)[number]
        found = pq.read_table(path).to_pylist()
        changed = change(found)
        content = pa.Table.from_pylist(found if changed is None else changed, schema=SCHEMAS[table])
        RunFolder(str(run)).write_file(table, path.name, content)
        if recounts:
            recount(run)
        if hidden:
            hide(run)

    return damage


def columns(table: str, change: Callable[[pa.Table], pa.Table], *, every: bool = True) -> Damage:
    """Changes the first file of a table, or every one, as an Arrow table, and makes the checksums fit."""

    def damage(run: Path) -> None:
        for path in files_of(run, table, with_rows=False) if every else files_of(run, table)[:1]:
            pq.write_table(change(pq.read_table(path)), path)
        hide(run)

    return damage


def manifest(change: Callable[[dict[str, Any]], None], *, hidden: bool = True) -> Damage:
    """Changes the manifest; ``hidden``: its digest is made to fit."""

    def damage(run: Path) -> None:
        path = run / "manifest.json"
        document = json.loads(path.read_text("utf-8"))
        change(document)
        path.write_text(json.dumps(document), "utf-8")
        if hidden:
            hide(run)

    return damage


def hide(run: Path) -> None:
    """Makes the checksums of all files and the digest of the manifest fit."""
    (run / CHECKSUMS).unlink(missing_ok=True)
    folder = RunFolder(str(run))
    found = read_manifest(folder)
    assert found is not None
    write_manifest(folder, found)


def recount(run: Path) -> None:
    """Makes the numbers of rows in the manifest fit."""
    folder = RunFolder(str(run))
    found = read_manifest(folder)
    assert found is not None
    tables = [table for table in found["counts"] if table in SCHEMAS]
    found["counts"] |= {table: folder.num_rows(table) if folder.files(table) else 0 for table in tables}
    write_manifest(folder, found)


def copied_shard(table: str, source: Sequence[str] = (), *, hidden: bool = True) -> Damage:
    """Adds a copy of a shard under another name; ``source``: of the file with these parts of a path instead."""

    def damage(run: Path) -> None:
        path = Path(*source) if source else files_of(run, table)[0]
        shutil.copy(path, run / table / "part-00000000000000ff.parquet")
        if hidden:
            hide(run)

    return damage


def small_run(folder: Path) -> Path:
    """A whole run of generate with two scenes, which needs no job: a stored older one, with all columns of today."""
    run = Path(shutil.copytree(Path(__file__).parents[2] / "data" / "run_v3" / "generate", folder / "run"))
    found = RunFolder(str(run))
    for table in found.tables():
        for path in found.files(table):
            found.write_file(table, Path(path).name, found.read_file(table, path))
    manifest(lambda document: document.update(upgraded_to=TABLE_VERSION))(run)
    return run


def write_equal_rows(run: Path, table: str, number: int, text: str = "") -> None:
    """Replaces the first file of a table by very many rows of one text, in a few kilobytes; the checksums fit."""
    path = files_of(run, table, with_rows=False)[0]
    schema = pq.read_schema(path)
    empty = pa.DictionaryArray.from_arrays(pa.array(np.zeros(number, np.int32)), pa.array([text]))
    rows_of_table = pa.table(dict.fromkeys(schema.names, empty))
    with pq.ParquetWriter(path, rows_of_table.schema, store_schema=False) as writer:
        writer.add_key_value_metadata({key.decode(): value.decode() for key, value in schema.metadata.items()})
        writer.write_table(rows_of_table, row_group_size=number)
    hide(run)
