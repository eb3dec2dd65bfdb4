"""Hashes of ids, equal on every machine and with every version of the libraries."""

from hashlib import blake2b
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa

Hashes: TypeAlias = npt.NDArray[np.uint64]


def id_hashes(names: pa.Array | pa.ChunkedArray) -> Hashes:
    """Computes a hash of 128 bits of each id, (N, 2) uint64; null counts as an empty id."""
    digests = (blake2b((name or "").encode(), digest_size=16).digest() for name in names.to_pylist())
    return np.frombuffer(b"".join(digests), "<u8").reshape(-1, 2)
