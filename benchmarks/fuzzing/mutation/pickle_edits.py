"""Edits of pickles by their operations."""

import gzip
import pickle
import pickletools
import struct
import zlib
from collections.abc import Sequence
from random import Random

from benchmarks.fuzzing.mutation.byte_edits import edited_bytes

_GZIP = b"\x1f\x8b"
_OPERATIONS = (
    *(
        b"cos\nsystem\n",
        b"cbuiltins\neval\n",
        b"cnumpy\nndarray\n",
        b"cnumpy\ndtype\n",
        b"c_codecs\nencode\n",
        b"cnumpy.core.multiarray\nscalar\n",
    ),
    *(
        b"R",
        b"b",
        b"o",
        b"\x81",
        b"(",
        b"t",
        b"l",
        b"d",
        b"]",
        b"}",
        b")",
        b"0",
        b"2",
        b"1",
        b"a",
        b"e",
        b"s",
        b"u",
        b"N",
        b"\x88",
        b"\x94",
    ),
    *(b"ios\nsystem\n", b"P1\n", b"Q", b"\x8f", b"\x91", b"\x90", b"\x85", b"\x86", b"\x87", b"\x93", b".", b"\x97", b"\x98"),
    *(
        b"r\xff\xff\xff\x7f",
        b"p999999999\n",
        b"j\xff\xff\xff\x7f",
        b"h\x05",
        b"q\x05",
        b"\x80\x05",
        b"\x95" + b"\xff" * 8,
        b"I" + b"9" * 5000 + b"\n",
    ),
    *(
        b"\x8d" + struct.pack("<Q", 2**62),
        b"\x8e" + struct.pack("<Q", 2**40),
        b"X\xff\xff\xff\x7f",
        b"B\xff\xff\xff\x7f",
        b"\x8b\xff\xff\xff\x7f",
    ),
    *(
        b"G\x7f\xf8\0\0\0\0\0\0",
        b"K\x05",
        b"J\xff\xff\xff\xff",
        b"U\x02f4",
        b"X\x02\0\0\0f4",
        b"X\x03\0\0\0<U9",
        b"X\x02\0\0\0O8",
    ),
)


def edited_pickle(content: bytes, rng: Random, donors: Sequence[bytes] = ()) -> bytes | None:
    """Returns a pickle, packed as it was, with one edit of its operations; None if it is none.

    Args:
        content: The pickle, plain or gzip.
        rng: Chooses the edit.
        donors: Pickles from which operations are copied.
    """
    plain = _unpacked(content)
    if plain is None:
        return None
    parts = _operations(plain)
    if not parts:
        return None
    k, kind = rng.randrange(len(parts)), rng.random()
    if kind < 0.3:
        parts.insert(k, rng.choice(_OPERATIONS))
    elif kind < 0.5:
        parts[k] = rng.choice(_OPERATIONS)
    elif kind < 0.65:
        del parts[k : k + rng.choice((1, 1, 3))]
    elif kind < 0.75:
        parts[k:k] = parts[k : k + rng.choice((1, 2, 5))] * rng.choice((1, 2, 100, 1000))
    elif kind < 0.85:
        other = rng.randrange(len(parts))
        parts[k], parts[other] = parts[other], parts[k]
    elif kind < 0.9 and donors:
        there = _operations(_unpacked(rng.choice(donors)) or b"") or [b"N"]
        parts[k] = rng.choice(there)
    else:
        parts[k] = parts[k][:1] + edited_bytes(parts[k][1:], rng)
    changed = b"".join(parts)
    if content[:2] != _GZIP:
        return changed
    return gzip.compress(changed, 1, mtime=0) if rng.random() < 0.9 else edited_bytes(content, rng)


def _unpacked(content: bytes) -> bytes | None:
    if content[:2] != _GZIP:
        return content
    try:
        return gzip.decompress(content)
    except (OSError, EOFError, zlib.error):
        return None


def _operations(content: bytes) -> list[bytes]:
    """The operations of a pickle, each with its argument; what follows one that cannot be read is one part."""
    starts: list[int] = []
    try:
        starts.extend(position or 0 for _, _, position in pickletools.genops(content))
    except (ValueError, pickle.UnpicklingError, EOFError, LookupError, OverflowError, MemoryError):
        if not starts:
            return []
    return [content[a:b] for a, b in zip(starts, [*starts[1:], len(content)], strict=True)]
