"""The order of a table's rows in an epoch, determined by a seed and the epoch and computed one window at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stable_data.scene import IntArray
from stable_data.storage.row_groups import RowGroup

_WINDOW_BYTES = 256 * 2**20


@dataclass(frozen=True, slots=True, eq=False)
class RowGroupWindow:
    """Row groups that are in memory at the same time.

    Attributes:
        start: Position of the first row in the epoch.
        stop: Position after the last row.
        groups: Indices of the row groups.
        seed: Seed of the shuffle of their rows, or None for no shuffle.
    """

    start: int
    stop: int
    groups: tuple[int, ...]
    seed: tuple[int, ...] | None

    def rows_at(self, places: IntArray) -> IntArray:
        """Returns the rows of the window, counted over its groups, that are at some positions of the epoch."""
        inside = places - self.start
        if self.seed is None:
            return inside
        shuffled: IntArray = np.random.default_rng(self.seed).permutation(self.stop - self.start)
        return shuffled[inside]


@dataclass(frozen=True, slots=True, eq=False)
class EpochOrder:
    """The order of an epoch: shuffled row groups, then shuffled rows within windows of row groups.

    Attributes:
        groups: The row groups of a table.
        seed: Seed of the shuffle, or None for the order of the files with one window for each row group.
        window_rows: Maximum number of rows in a window; a window has at least one row group and at most 256 MB.
    """

    groups: Sequence[RowGroup]
    seed: int | None
    window_rows: int

    def windows(self, epoch: int) -> Iterator[RowGroupWindow]:
        """Yields the windows of an epoch; every row group is in exactly one of them."""
        window: list[int] = []
        start = stop = num_bytes = 0
        for index in self._groups_of(epoch):
            group = self.groups[index]
            is_full = stop - start + group.num_rows > self.window_rows or num_bytes + group.num_bytes > _WINDOW_BYTES
            if window and (is_full or self.seed is None):
                yield self._window(epoch, start, stop, window)
                window, start, num_bytes = [], stop, 0
            window.append(index)
            stop, num_bytes = stop + group.num_rows, num_bytes + group.num_bytes
        if window:
            yield self._window(epoch, start, stop, window)

    def _groups_of(self, epoch: int) -> Sequence[int]:
        order = np.arange(len(self.groups))
        if self.seed is not None:
            np.random.default_rng((self.seed, epoch)).shuffle(order)
        return [int(index) for index in order]

    def _window(self, epoch: int, start: int, stop: int, groups: list[int]) -> RowGroupWindow:
        return RowGroupWindow(start, stop, tuple(groups), None if self.seed is None else (self.seed, epoch, start))
