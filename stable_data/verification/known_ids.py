"""The ids of the rows of a run: each once, and each reference to another row resolved.

Of an id 16 bytes are kept (:class:`stable_data.storage.id_hashes.IdSet`), so that the memory hardly grows with the run.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from stable_data.scene import IntArray
from stable_data.storage.id_hashes import Hashes, IdSet, id_hashes
from stable_data.verification.findings import Findings
from stable_data.verification.shard_files import ShardFile, as_array

KEYS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("scenes", "rejected", "corrections", "settled"), ("scene_id",)),
    "turns": ("scene_id", "turn"),
    "grasps": ("scene_id", "instance", "number"),
    "ratings": ("scene_id", "judge", "judge_version"),
    "samples": ("scene_id", "stage", "task.task"),
    "edits": ("edit_id",),
    **dict.fromkeys(("assets", "meshes", "measured"), ("asset_id",)),
    "sdf": ("asset_id", "aspect"),
    "features": ("asset_id", "aspect", "tilt_quat_xyzw"),
    "textures": ("sha256",),
    "episodes": ("episode_id",),
    "views": ("scene_id", "extractor_fingerprint"),
}
"""Name of a table -> the columns that no two rows have in common. Rows of ``warnings`` and ``failures`` may be equal."""

_OF_A_SHARD = frozenset({"textures"})  # several shards may have a row that several assets share
_SEPARATOR = "\x1f"


@dataclass(slots=True)
class KnownIds:
    """The ids that rows of a run refer to, by table.

    Attributes:
        of: Name of a table, or of a further set of ids -> the ids.
        there: The tables that the run has.
    """

    there: frozenset[str]
    of: dict[str, IdSet] = field(default_factory=dict)

    def add(self, name: str, ids: pa.Array | pa.ChunkedArray) -> None:
        """Adds ids of a table."""
        self.of.setdefault(name, IdSet()).add(ids)

    def missing(self, ids: pa.Array, names: Collection[str]) -> npt.NDArray[np.bool_]:
        """Returns which ids are in none of some tables, (N,) bool."""
        found = np.zeros(len(ids), bool)
        for name in names:
            if name in self.of:
                found |= self.of[name].has(ids)
        return ~found


class KeyCheck:
    """Looks for two rows of a table with the same key.

    Args:
        table: The table.
        findings: Where damage is noted.
    """

    def __init__(self, table: str, findings: Findings) -> None:
        self._table, self._findings = table, findings
        self._parts, self._places = list[Hashes](), list[tuple[ShardFile, Sequence[int] | IntArray]]()

    def note(self, rows: pa.Table, start: int, file: ShardFile) -> None:
        """Notes the keys of some rows of a file, whose first row has a number in the file."""
        keys = key_texts(rows, KEYS[self._table])
        numbers: Sequence[int] | IntArray = range(start, start + rows.num_rows)
        if len(unique := keys.unique()) < len(keys):  # what a small file may hold very many times is kept once
            firsts = pc.index_in(unique, keys).to_numpy()
            for number in np.setdiff1d(np.arange(len(keys)), firsts).tolist():
                self._damage(file, start + number)
            keys, numbers = unique, start + firsts.astype(np.int64)
        self._parts.append(id_hashes(keys))
        self._places.append((file, numbers))

    def close(self) -> None:
        """Reports each row whose key an earlier row has."""
        if not self._parts:
            return
        hashes = np.concatenate(self._parts)
        lengths = [len(numbers) for _, numbers in self._places]
        scope = np.repeat(np.arange(len(lengths)), lengths)
        if self._table in _OF_A_SHARD:
            shards = {name: k for k, name in enumerate(dict.fromkeys(file.shard_id for file, _ in self._places))}
            hashes = hashes.copy()
            hashes[:, 1] ^= np.array([shards[self._places[k][0].shard_id] for k in scope], np.uint64)
        order = np.lexsort((np.arange(len(hashes)), hashes[:, 1], hashes[:, 0]))
        is_again = np.zeros(len(hashes), bool)
        is_again[order[1:]] = (hashes[order[1:]] == hashes[order[:-1]]).all(axis=1)
        starts = np.cumsum([0, *lengths])
        for place in np.nonzero(is_again)[0].tolist():
            file, numbers = self._places[int(scope[place])]
            self._damage(file, int(numbers[place - int(starts[scope[place]])]))

    def _damage(self, file: ShardFile, number: int) -> None:
        columns = ", ".join(KEYS[self._table])
        self._findings.damage(file.name, f"an earlier row has the same {columns}, expected each once", number)


def key_texts(rows: pa.Table, columns: Sequence[str]) -> pa.Array:
    """Returns the values of some columns of each row as one text."""
    parts = []
    for name in columns:
        values = rows[name.partition(".")[0]]
        for each in name.split(".")[1:]:
            values = pc.struct_field(values, each)
        if pa.types.is_list(values.type):
            parts.append(pa.array([repr(value) for value in values.to_pylist()], pa.string()))
        else:
            parts.append(pc.fill_null(pc.cast(as_array(values), pa.string()), ""))
    return pc.binary_join_element_wise(*parts, _SEPARATOR)


def leaves(rows: pa.Table, path: str, start: int) -> tuple[pa.Array, IntArray]:
    """Returns the values of a column, or of a field of its structs, that are not null, and the row of each.

    Args:
        rows: Rows of a file.
        path: The column; a dot leads to a field of a struct, or of the structs of a list.
        start: Number of the first row in the file.
    """
    first, *fields = path.split(".")
    values, numbers = as_array(rows[first]), np.arange(start, start + rows.num_rows)
    for name in (*fields, ""):
        while True:
            if values.null_count:
                numbers = numbers[values.is_valid().to_numpy(zero_copy_only=False)]
                values = values.drop_null()
            if not pa.types.is_list(values.type):
                break
            numbers = np.repeat(numbers, pc.list_value_length(values).to_numpy(zero_copy_only=False))
            values = values.flatten()
        if name:
            values = as_array(pc.struct_field(values, name))
    return values, numbers


@dataclass(frozen=True, slots=True)
class ForeignKey:
    """A column whose values are ids of rows.

    Attributes:
        path: The column.
        tables: Tables, one of which has the id; see :class:`KnownIds`.
        apart: A shard whose values are none; empty: there is none.
    """

    path: str
    tables: tuple[str, ...]
    apart: str = ""

    def check(self, rows: pa.Table, start: int, file: ShardFile, known: KnownIds, findings: Findings) -> None:
        """Reports the rows whose ids are in none of the tables; does nothing if the run has none of them."""
        is_none = known.there.isdisjoint(self.tables) or self.path.partition(".")[0] not in rows.column_names
        if is_none or file.shard_id == self.apart:
            return
        ids, numbers = leaves(rows, self.path, start)
        is_missing = known.missing(ids, self.tables)
        named = dict[tuple[int, str], None]()
        for place in np.nonzero(is_missing)[0].tolist():
            named[int(numbers[place]), str(ids[place].as_py())] = None
        for row, name in named:
            findings.damage(file.name, f"{self.path} is {name!r:.80}, which is in no row of {' or '.join(self.tables)}", row)
