"""Hashes of ids, equal on every machine and with every version of the libraries, and sets of ids that are known by them."""

from hashlib import blake2b
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

Hashes: TypeAlias = npt.NDArray[np.uint64]
"""Hashes of ids, (N, 2) uint64."""


def id_hashes(names: pa.Array | pa.ChunkedArray) -> Hashes:
    """Computes a hash of 128 bits of each id, (N, 2) uint64; null counts as an empty id."""
    digests = (blake2b((name or "").encode(), digest_size=16).digest() for name in names.to_pylist())
    return np.frombuffer(b"".join(digests), "<u8").reshape(-1, 2)


class IdSet:
    """A set of ids, of which 16 bytes each are kept, because runs have very many.

    An id is known by a hash of 128 bits: two ids of a run with one hash are less likely than an error of the memory.
    """

    def __init__(self) -> None:
        self._parts = list[Hashes]()
        self._sorted: Hashes = np.zeros((0, 2), np.uint64)

    def add(self, names: pa.Array | pa.ChunkedArray) -> None:
        """Adds ids."""
        self._parts.append(id_hashes(names.unique()))  # a small file may hold one id very many times

    @property
    def hashes(self) -> Hashes:
        """The hashes of the ids, sorted, each once."""
        if self._parts:
            self._sorted = np.unique(np.concatenate([self._sorted, *self._parts]), axis=0)
            self._parts.clear()
        return self._sorted

    def __len__(self) -> int:
        """Number of ids."""
        return len(self.hashes)

    @classmethod
    def union(cls, *sets: "IdSet") -> "IdSet":
        """Returns the ids of some sets as one set."""
        found = cls()
        found._parts += [each.hashes for each in sets]
        return found

    def has(self, names: pa.Array | pa.ChunkedArray) -> npt.NDArray[np.bool_]:
        """Returns whether each id is in the set, (N,) bool."""
        return self.has_hashes(id_hashes(names))

    def has_hashes(self, wanted: Hashes) -> npt.NDArray[np.bool_]:
        """Returns whether each id is in the set, by their hashes, (N,) bool."""
        known = self.hashes
        places = np.searchsorted(known[:, 0], wanted[:, 0])
        found, is_open = np.zeros(len(wanted), bool), np.ones(len(wanted), bool)
        while is_open.any():  # one round, unless two ids share half of their hash
            is_open &= places < len(known)
            is_open[is_open] = known[places[is_open], 0] == wanted[is_open, 0]
            found[is_open] = known[places[is_open], 1] == wanted[is_open, 1]
            is_open &= ~found
            places += 1
        return found
