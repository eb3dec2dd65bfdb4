"""The order of a table's rows in an epoch: fixed by a seed and the epoch, made window by window."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from stable_data.scene import IntArray
from stable_data.table_files import RowGroup

_WINDOW_BYTES = 256 * 2**20


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Row groups that are held together.

    Attributes:
        start: Where the first of their rows stands in the epoch.
        stop: Where the first row after them stands.
        groups: Numbers of the row groups.
        seed: What their rows are shuffled by, or None.
    """

    start: int
    stop: int
    groups: tuple[int, ...]
    seed: tuple[int, ...] | None

    def rows_at(self, places: IntArray) -> IntArray:
        """Which of the window's rows, counted over its groups, stand at some places of the epoch."""
        inside = places - self.start
        if self.seed is None:
            return inside
        shuffled: IntArray = np.random.default_rng(self.seed).permutation(self.stop - self.start)
        return shuffled[inside]


@dataclass(frozen=True, slots=True, eq=False)
class EpochOrder:
    """Row groups in an order of their own each epoch, then rows within windows of row groups.

    Attributes:
        groups: The row groups of a table.
        seed: None: the order of the files, a window for each row group.
        window_rows: Rows that a window holds at most; it holds one row group at least, and 256 MB at most.
    """

    groups: Sequence[RowGroup]
    seed: int | None
    window_rows: int

    def windows(self, epoch: int) -> Iterator[Window]:
        """The windows of an epoch; every row group is in one of them."""
        start, window = 0, list[int]()
        for index in self._groups_of(epoch):
            if window and not self._has_room(window, index):
                yield self._window(epoch, start, window)
                start, window = start + self._num_rows(window), []
            window.append(index)
        if window:
            yield self._window(epoch, start, window)

    def _groups_of(self, epoch: int) -> Sequence[int]:
        order = np.arange(len(self.groups))
        if self.seed is not None:
            np.random.default_rng((self.seed, epoch)).shuffle(order)
        return [int(index) for index in order]

    def _has_room(self, window: list[int], index: int) -> bool:
        num_bytes = sum(self.groups[group].num_bytes for group in (*window, index))
        return self.seed is not None and self._num_rows([*window, index]) <= self.window_rows and num_bytes <= _WINDOW_BYTES

    def _num_rows(self, window: Sequence[int]) -> int:
        return sum(self.groups[group].num_rows for group in window)

    def _window(self, epoch: int, start: int, window: list[int]) -> Window:
        seed = None if self.seed is None else (self.seed, epoch, start)
        return Window(start, start + self._num_rows(window), tuple(window), seed)
