"""Edits of Parquet files: of values, columns, types, rows and metadata, written again as valid Parquet."""

import hashlib
import io
from collections.abc import Sequence
from functools import lru_cache
from random import Random
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks.fuzzing.mutation.glb_edits import edited_glb
from benchmarks.fuzzing.mutation.json_edits import edit_tree, edited_json
from benchmarks.fuzzing.mutation.odd_values import odd_text

_TYPES = (
    *(
        pa.int8(),
        pa.uint64(),
        pa.float16(),
        pa.float32(),
        pa.float64(),
        pa.string(),
        pa.large_string(),
        pa.binary(),
        pa.bool_(),
        pa.null(),
    ),
    *(pa.timestamp("ns"), pa.list_(pa.float32()), pa.dictionary(pa.int32(), pa.string()), pa.decimal128(38, 10), pa.date32()),
    *(pa.large_list(pa.float64()), pa.list_(pa.float64(), 3), pa.map_(pa.string(), pa.string())),
)
_ERRORS = (pa.ArrowException, ValueError, TypeError, OverflowError, KeyError, AttributeError, NotImplementedError)


def edited_table(content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes | None:
    """Returns a Parquet file with one edit; None if it is none, or if Arrow cannot write the edit.

    Args:
        content: The file.
        rng: Chooses the edit.
        donors: Files from which columns are copied.
        words: Words of the grammar.
    """
    try:
        table = _table(content)
        if not table.num_columns:
            return None
        changed = _edited(table, rng, donors, words)
        sink = io.BytesIO()
        pq.write_table(
            changed, sink, compression=rng.choice(("zstd", "snappy", "none")), row_group_size=rng.choice((1, 128, 1024))
        )
    except (*_ERRORS, OSError):
        return None
    return sink.getvalue()


@lru_cache(maxsize=64)
def _table(content: bytes) -> pa.Table:
    """The table of a file; those of honest files are read again and again."""
    return pq.read_table(io.BytesIO(content), use_threads=False)


def _edited(table: pa.Table, rng: Random, donors: Sequence[bytes], words: Sequence[str]) -> pa.Table:
    kind, k = rng.random(), rng.randrange(table.num_columns)
    name = table.column_names[k]
    if kind < 0.62:
        return _with_values(table, name, rng, words)
    if kind < 0.68:
        return table.drop_columns([name])
    if kind < 0.72:
        names = list(table.column_names)
        names[k] = rng.choice((rng.choice(table.column_names), odd_text(rng, words)))
        return table.rename_columns(names)
    if kind < 0.8:
        kind_of = rng.choice(_TYPES)
        try:
            column = table[name].cast(kind_of)
        except _ERRORS:
            column = pa.nulls(table.num_rows, kind_of)
        return table.set_column(k, name, column)
    if kind < 0.86:
        rows = list(range(table.num_rows))
        chosen = rng.choice(([], rows[:1], rows[::-1], rows * 2, rows[:1] * 50, [r for r in rows if r]))
        return table.take(pa.array(chosen, pa.int64()))
    if kind < 0.91:
        other = rng.choice(table.column_names)
        return table.set_column(k, name, table[other])
    if kind < 0.95:
        metadata = dict(table.schema.metadata or {})
        key = rng.choice([*metadata, b"x"])
        metadata[key] = rng.choice((b"", b"0", b"99", b"\xff\xfe", b"x" * 10_000, metadata.get(key, b"")[::-1]))
        return table.replace_schema_metadata(metadata if rng.random() < 0.7 else None)
    if donors:
        other_table = _table(rng.choice(donors))
        column = rng.choice(other_table.column_names)
        values = other_table[column].to_pylist()[: table.num_rows]
        padded = pa.array(values + [None] * (table.num_rows - len(values)), other_table.schema.field(column).type)
        return table.set_column(k, column, padded)
    return table.select(table.column_names[::-1])


def _with_values(table: pa.Table, name: str, rng: Random, words: Sequence[str]) -> pa.Table:
    """Edits one value of a column, within its type if that can hold it, else with the type that follows from the values."""
    field = table.schema.field(name)
    values = table[name].to_pylist()
    if not values:
        return table
    if name == "glb" and "sha256" in table.column_names and rng.random() < 0.9:
        return _with_mesh(table, values, rng)
    if name.endswith("_json") and (found := _edited_text(values, rng, words)) is not None:
        return table.set_column(table.schema.get_field_index(name), field, pa.array(found, field.type))
    document = [values]
    for _ in range(rng.choice((1, 1, 2, 4))):
        edit_tree(document, rng, (), words)
    changed = document[0] if isinstance(document[0], list) else values
    changed = (changed + [None] * len(values))[: len(values)]
    try:
        column: Any = pa.array(changed, field.type)
    except _ERRORS:
        column = pa.array(changed)
        field = pa.field(name, column.type)
    return table.set_column(table.schema.get_field_index(name), field, column)


def _edited_text(values: list[Any], rng: Random, words: Sequence[str]) -> list[Any] | None:
    """Edits one text that is JSON."""
    k = rng.randrange(len(values))
    if not isinstance(values[k], str):
        return None
    changed = edited_json(values[k].encode(), rng, (), words)
    return None if changed is None else [*values[:k], changed.decode("utf-8", "replace"), *values[k + 1 :]]


def _with_mesh(table: pa.Table, values: list[Any], rng: Random) -> pa.Table:
    """Edits one GLB and states its new hash, without which no reader looks at it."""
    k = rng.randrange(len(values))
    changed = edited_glb(values[k], rng) if isinstance(values[k], bytes) else None
    if changed is None:
        return table
    hashes = table["sha256"].to_pylist()
    values[k], hashes[k] = changed, hashlib.sha256(changed).hexdigest()
    for name, column in (("glb", values), ("sha256", hashes)):
        at = table.schema.get_field_index(name)
        table = table.set_column(at, table.schema.field(name), pa.array(column, table.schema.field(name).type))
    return table
