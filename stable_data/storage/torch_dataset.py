"""Tables of runs for training in PyTorch: by index, or as a stream over ranks and workers that resumes exactly.

This is the only module of the library that imports torch. If a run is in an object store, a ``DataLoader`` with workers needs
``multiprocessing_context="spawn"``: the clients of object stores do not work after a fork.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeAlias, TypedDict

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import torch
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from stable_data.errors import ConfigError
from stable_data.scene import IntArray, Scene
from stable_data.storage.epoch_shuffle import EpochOrder
from stable_data.storage.row_groups import TableFiles, check_columns, row_slices, rows_from_table
from stable_data.storage.run_folder import Uri
from stable_data.storage.scene_arrays import ARRAY_LEAVES, SCENE_LEAVES, SceneArrays, scenes_from_table
from stable_data.storage.schemas import Row

Decode: TypeAlias = Callable[[Row], Any]
Collate: TypeAlias = Callable[[list[Any]], Any]

_CACHE_BYTES = 256 * 2**20


class SceneBatch(TypedDict):
    """Scenes as padded tensors. Padding is 0, and -1 in ``stage``; ``mask`` alone tells padding from objects.

    Attributes:
        scene_ids: Identifiers, S.
        instructions: The instruction of each scene's task, or None, S.
        instances: Names of each scene's objects, S tuples, not padded.
        asset_ids: Asset of each object or None, S tuples, not padded.
        table_size: Table extents, (S, 2) float32, metres.
        mask: True for objects, false for padding, (S, N) bool.
        poses: x, y, z in metres and yaw in radians, world frame, (S, N, 4) float32.
        size: Box in the yaw frame, (S, N, 3) float32, metres.
        tilt_quat_xyzw: Rotation before yaw, (S, N, 4) float32.
        stage: Index in ``Stage``, -1 if a scene has no stages, (S, N) int64.
    """

    scene_ids: list[str]
    instructions: list[str | None]
    instances: list[tuple[str, ...]]
    asset_ids: list[tuple[str | None, ...]]
    table_size: torch.Tensor
    mask: torch.Tensor
    poses: torch.Tensor
    size: torch.Tensor
    tilt_quat_xyzw: torch.Tensor
    stage: torch.Tensor


def collate_scenes(scenes: Sequence[Scene]) -> SceneBatch:
    """Converts scenes to padded tensors, in order: ``collate_fn`` of a ``DataLoader``, or ``collate`` of :class:`TableStream`."""
    return _padded(SceneArrays.from_scenes(scenes))


class TableDataset(Dataset[Any]):
    """A table of a run by index, in the order of its files.

    Row groups are read on demand, and the most recently used ones are cached. Access in random order needs another row group
    for almost every row: if the table is larger than the cache, shuffle with :class:`TableStream`.

    Args:
        uri: The run folder, as for :class:`~stable_data.storage.run_folder.RunFolder`, or several, whose rows follow one
            another.
        table: Name in SCHEMAS.
        columns: Columns to read, or None for all.
        decode: Function from a row (column -> value) to an item. By default a row of ``scenes`` with all columns becomes a
            ``Scene`` without ``source`` entries (``decode=scene_from_row`` includes them), and any other row stays a
            dictionary. Lists of float16, float32 and int32 are numpy arrays. Spawned workers need a function of a module.
        split: ``train``, ``validation``, ``test`` or ``unseen`` of ``scenes`` or ``samples``, or None for all rows.
        where: Condition on the rows, such as ``clean and num_stacked >= 2`` (:mod:`stable_data.storage.filter_expression`), or
            None for all rows.
        cache_bytes: Maximum size of the cached row groups; the last one is cached whatever its size.

    Raises:
        ConfigError: The table, a column or the split does not exist, the condition is not valid, or the table was written by
            another version or cannot be read.
    """

    def __init__(
        self,
        uri: Uri | Sequence[Uri],
        table: str = "scenes",
        *,
        columns: Sequence[str] | None = None,
        decode: Decode | None = None,
        split: str | None = None,
        where: str | None = None,
        cache_bytes: int = _CACHE_BYTES,
    ) -> None:
        leaves, self._items = _choose_decoder(table, columns, decode)
        self._files = TableFiles(uri, table, leaves, split, where)
        self._cache_bytes = cache_bytes
        self._cache: OrderedDict[int, pa.Table] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": OrderedDict()}

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Any:
        """Returns the item of a row; a negative index counts from the end."""
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Any]:
        """Returns the items of some rows; a ``DataLoader`` requests a whole batch with this method."""
        rows = np.array([self._row(index) for index in indices], np.int64)
        groups = np.searchsorted(self._files.starts, rows, "right") - 1
        items: list[Any] = [None] * len(rows)
        for group in dict.fromkeys(groups.tolist()):
            places = np.flatnonzero(groups == group)
            chosen = self._group(group).take(rows[places] - self._files.starts[group])
            for place, item in zip(places.tolist(), self._items(chosen), strict=True):
                items[place] = item
        return items

    def _row(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"row {index} of {len(self)}")
        return index % len(self)

    def _group(self, group: int) -> pa.Table:
        """Returns a row group from the cache or the file."""
        if group in self._cache:
            self._cache.move_to_end(group)
            return self._cache[group]
        self._cache[group] = self._files.read([group], use_threads=get_worker_info() is None)
        while len(self._cache) > 1 and sum(table.nbytes for table in self._cache.values()) > self._cache_bytes:
            self._cache.popitem(last=False)
        return self._cache[group]


class TableStream(IterableDataset[Any]):
    """A table of a run as a stream: an epoch contains every row exactly once over all ranks and workers.

    The order of the rows in an epoch depends on ``shuffle_seed`` and the epoch alone. Each rank reads an equal, contiguous part
    of this order. The workers make its batches in turn, and a ``DataLoader`` returns them in order, so the batches do not depend
    on the number of workers, and the number of rows seen defines where to resume. This requires that the stream makes the
    batches: ``DataLoader(stream, batch_size=None, num_workers=...)``. A ``DataLoader`` that makes the batches itself also
    returns every row once, but in an order that depends on the number of workers.

    Args:
        uri: As in :class:`TableDataset`.
        table: Name in SCHEMAS.
        columns: As in :class:`TableDataset`.
        decode: As in :class:`TableDataset`.
        split: As in :class:`TableDataset`.
        where: As in :class:`TableDataset`.
        batch_size: Rows in a batch, or None for single items.
        collate: Function from a list of items to a batch, or None for the list itself. ``collate_scenes`` on ``scenes`` converts
            columns to tensors directly.
        shuffle_seed: None for the order of the files; otherwise row groups are shuffled, and then rows within windows of row
            groups.
        window_rows: Maximum number of rows in a window, which is in memory at once (at least one row group, at most 256 MB).
        rank: Index of this process among the training processes.
        world_size: Number of training processes.
        drop_remainder: Whether every rank gets the same number of rows and only full batches, as collective training requires.
            Fewer than ``world_size * batch_size`` rows are then left out, different ones in each shuffled epoch. Otherwise the
            ranks differ by at most one row.

    Raises:
        ConfigError: As in :class:`TableDataset`; or a setting is out of range, or leaves a rank without a row or a full batch.
    """

    def __init__(
        self,
        uri: Uri | Sequence[Uri],
        table: str = "scenes",
        *,
        columns: Sequence[str] | None = None,
        decode: Decode | None = None,
        split: str | None = None,
        where: str | None = None,
        batch_size: int | None = None,
        collate: Collate | None = None,
        shuffle_seed: int | None = None,
        window_rows: int = 8192,
        rank: int = 0,
        world_size: int = 1,
        drop_remainder: bool = False,
    ) -> None:
        _check_settings(batch_size, shuffle_seed, window_rows, rank, world_size)
        leaves, self._items = _choose_decoder(table, columns, decode)
        self._collate = collate
        self._is_columnar = collate is collate_scenes and leaves is SCENE_LEAVES and batch_size is not None
        self._files = TableFiles(uri, table, ARRAY_LEAVES if self._is_columnar else leaves, split, where)
        self._batch_size, self._step = batch_size, batch_size or 1
        self._order = EpochOrder(self._files.groups, shuffle_seed, window_rows)
        self._rank, self._world_size, self._drop_remainder = rank, world_size, drop_remainder
        self._check_enough(table)
        # Epoch and first row, in shared memory: persistent workers then see the next epoch.
        self._plan = torch.zeros(2, dtype=torch.int64)
        self._plan.share_memory_()  # type: ignore[no-untyped-call]
        self._first, self._given, self._skip, self._num_workers = 0, 0, 0, 1

    @property
    def num_rows(self) -> int:
        """Number of rows of an epoch in this rank."""
        return len(self._rank_rows())

    @property
    def epoch(self) -> int:
        """The epoch of the next iteration."""
        return int(self._plan[0])

    def __len__(self) -> int:
        """Number of items of an epoch in this rank: batches, or rows if the stream makes no batches."""
        return -(-self.num_rows // self._step)

    def set_epoch(self, epoch: int) -> None:
        """Sets the epoch of the next iteration; an epoch other than the current one starts at its first row."""
        if epoch != self.epoch:
            self._start(epoch, 0, 0, 1)

    def resume_from(self, num_rows: int) -> None:
        """Makes the next iteration of this epoch skip the rows that were already seen.

        With workers, every iteration skips them until ``set_epoch`` sets another epoch.

        Args:
            num_rows: Number of rows of this epoch that this rank has seen, with any number of workers.

        Raises:
            ConfigError: The epoch has fewer rows.
        """
        if not 0 <= num_rows <= self.num_rows:
            raise ConfigError(
                f"resume from row {num_rows}, expected 0 to {self.num_rows}, the rows of this rank", "resume_invalid"
            )
        self._start(self.epoch, num_rows, 0, 1)

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the iteration, without workers or in each worker (torchdata's StatefulDataLoader)."""
        state = self._settings() | {"epoch": self.epoch, "num_workers": self._num_workers}
        if self._num_workers > 1:
            return state | {"first": self._first, "given": self._given}
        return state | {"first": min(self._first + self._given * self._step, self.num_rows), "given": 0}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Makes the next iteration continue from a state of :meth:`state_dict`.

        Raises:
            ConfigError: The table or a setting that determines the order has changed (``resume_changed``).
        """
        for key, now in self._settings().items():
            if state.get(key) != now:
                raise ConfigError(
                    f"{self._files.uri}: {key}: {state.get(key)} -> {now}, expected the value of the saved state; start a new epoch",
                    "resume_changed",
                )
        self._start(state["epoch"], state["first"], state["given"], state["num_workers"])

    def __iter__(self) -> Iterator[Any]:
        worker = get_worker_info()
        number, num_workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        skip, self._skip = self._skip, 0
        if skip and num_workers != self._num_workers:
            raise ConfigError(
                f"num_workers: {self._num_workers} -> {num_workers}, expected the number of the saved state", "resume_changed"
            )
        epoch, self._first = self._plan.tolist()
        self._given, self._num_workers = skip, num_workers
        if worker is None:
            self._plan[1] = 0  # the following iteration starts at the first row
        rows = self._rank_rows()[self._first :]
        for item in self._read(epoch, rows, lambda place: (place // self._step - number) % num_workers == 0, skip):
            self._given += 1
            yield item

    def _check_enough(self, table: str) -> None:
        """Checks that every rank gets rows: with none, a training would run without learning anything."""
        least = self._world_size * (self._step if self._drop_remainder else 1)
        if len(self._files) < least:
            of_split = f" of split {self._files.split}" if self._files.split else ""
            of_split += f" where {self._files.where}" if self._files.where else ""
            whole = f" times batch_size {self._step} because of drop_remainder" if self._drop_remainder else ""
            raise ConfigError(
                f"{self._files.uri}: table {table} has {len(self._files)} rows{of_split}, expected at least {least}, world_size "
                f"{self._world_size}{whole}; use a larger run or smaller values",
                "too_few_rows",
            )

    def _start(self, epoch: int, first: int, given: int, num_workers: int) -> None:
        self._plan[0], self._plan[1] = epoch, first
        self._first, self._given, self._skip, self._num_workers = first, given, given, num_workers

    def _settings(self) -> dict[str, Any]:
        """Returns the settings that determine the order of the rows; they must not change within an epoch."""
        return {
            "split": self._files.split,
            "where": self._files.where,
            "table_fingerprint": self._files.fingerprint,
            "shuffle_seed": self._order.seed,
            "window_rows": self._order.window_rows,
            "batch_size": self._batch_size,
            "world_size": self._world_size,
            "drop_remainder": self._drop_remainder,
        }

    def _rank_rows(self) -> range:
        """Returns the positions of this rank's rows in an epoch."""
        total, rank, ranks = len(self._files), self._rank, self._world_size
        if self._drop_remainder:
            share = total // ranks // self._step * self._step
            return range(rank * share, (rank + 1) * share)
        return range(rank * total // ranks, (rank + 1) * total // ranks)

    def _read(self, epoch: int, rows: range, is_ours: Callable[[IntArray], npt.NDArray[np.bool_]], skip: int) -> Iterator[Any]:
        """Yields the items at the positions of an epoch for which ``is_ours`` is true, without the first ``skip`` items."""
        rest, skip_rows = None, skip * self._step
        for window in self._order.windows(epoch):
            places = np.arange(max(window.start, rows.start), min(window.stop, rows.stop))
            places = places[is_ours(places - rows.start)]
            places, skip_rows = places[skip_rows:], max(0, skip_rows - len(places))
            if not len(places):
                continue
            table = self._files.read(window.groups, use_threads=get_worker_info() is None).take(window.rows_at(places))
            if self._batch_size is None:
                for part in row_slices(table):
                    yield from self._items(part)
                continue
            table = table if rest is None else pa.concat_tables([rest, table])
            whole = table.num_rows // self._step * self._step
            yield from self._batches(table.slice(0, whole))
            rest = table.slice(whole)
        if rest is not None:
            yield from self._batches(rest)

    def _batches(self, table: pa.Table) -> Iterator[Any]:
        for start in range(0, table.num_rows, self._step):
            rows = table.slice(start, self._step)
            if self._is_columnar:
                yield _padded(SceneArrays.from_table(rows))
            else:
                items = list(self._items(rows))
                yield items if self._collate is None else self._collate(items)


class _RowDecoder:
    """Applies a user's function to rows; a class, since spawned workers cannot receive a closure."""

    def __init__(self, decode: Decode) -> None:
        self._decode = decode

    def __call__(self, table: pa.Table) -> list[Any]:
        return [self._decode(row) for row in rows_from_table(table)]


def _choose_decoder(
    table: str, columns: Sequence[str] | None, decode: Decode | None
) -> tuple[Sequence[str] | None, Callable[[pa.Table], list[Any]]]:
    """Returns the leaves to read, and the function from a table to items."""
    check_columns(table, columns)
    if decode is not None:
        return columns, _RowDecoder(decode)
    if table == "scenes" and columns is None:
        return SCENE_LEAVES, scenes_from_table
    return columns, rows_from_table


def _check_settings(batch_size: int | None, shuffle_seed: int | None, window_rows: int, rank: int, world_size: int) -> None:
    faults = {
        f"batch_size is {batch_size}, expected None or at least 1": batch_size is not None and batch_size < 1,
        f"shuffle_seed is {shuffle_seed}, expected None or at least 0": shuffle_seed is not None and shuffle_seed < 0,
        f"window_rows is {window_rows}, expected at least 1": window_rows < 1,
        f"rank is {rank} of {world_size}, expected 0 to world_size - 1": not 0 <= rank < world_size,
    }
    for message, is_wrong in faults.items():
        if is_wrong:
            raise ConfigError(message, "setting_invalid")


def _padded(scenes: SceneArrays) -> SceneBatch:
    counts = torch.from_numpy(scenes.counts)
    mask = torch.arange(int(counts.max()) if len(counts) else 0) < counts[:, None]  # (S, N)

    def pad(values: npt.NDArray[Any], fill: int) -> torch.Tensor:
        flat = torch.from_numpy(values)  # (M, ...)
        padded = torch.full((*mask.shape, *flat.shape[1:]), fill, dtype=flat.dtype)
        padded[mask] = flat
        return padded

    ends = list(pairwise([0, *np.cumsum(scenes.counts).tolist()]))
    return SceneBatch(
        scene_ids=scenes.scene_ids,
        instructions=scenes.instructions,
        instances=[tuple(scenes.instances[start:end]) for start, end in ends],
        asset_ids=[tuple(scenes.asset_ids[start:end]) for start, end in ends],
        table_size=torch.from_numpy(scenes.table_size),
        mask=mask,
        poses=pad(scenes.poses, 0),
        size=pad(scenes.size, 0),
        tilt_quat_xyzw=pad(scenes.tilt_quat_xyzw, 0),
        stage=pad(scenes.stage, -1),
    )
