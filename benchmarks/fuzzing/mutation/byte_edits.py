"""Edits of bytes, whatever they mean."""

import struct
from collections.abc import Sequence
from random import Random

_WORDS = (
    *(b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\x01\0\0\0", b"\0\0\x80\x7f", b"\0\0\xc0\x7f"),
    *(b"\0\0\x01\0", b"\x7f\xff\xff\xff", b"\0\0\0\x01", b"\xff\xff", b"\0\0", b"\xff", b"\0", b"\x80", b"\x7f"),
    struct.pack("<d", float("nan")),
    struct.pack("<d", 1e308),
    struct.pack("<q", 2**62),
)


def edited_bytes(content: bytes, rng: Random, donors: Sequence[bytes] = ()) -> bytes:
    """Returns bytes with one edit: bits, numbers, parts that are cut, repeated, inserted, moved, or copied from another input.

    Args:
        content: The bytes.
        rng: Chooses the edit.
        donors: Other inputs of the form.
    """
    if not content:
        return bytes(rng.randrange(256) for _ in range(rng.randrange(1, 64)))
    kind, at = rng.randrange(9), rng.randrange(len(content))
    size = min(len(content) - at, rng.choice((1, 2, 4, 16, 64, 512, 4096)))
    if kind == 0:
        return content[:at] + bytes((content[at] ^ (1 << rng.randrange(8)),)) + content[at + 1 :]
    if kind == 1:
        return content[:at] + bytes((rng.randrange(256),)) + content[at + 1 :]
    if kind == 2:
        word = rng.choice(_WORDS)
        return content[:at] + word + content[at + len(word) :]
    if kind == 3:
        return content[:at]
    if kind == 4:
        return content[:at] + content[at + size :]
    if kind == 5:
        part = content[at : at + size]
        return content[:at] + part * rng.choice((2, 3, 10, 100)) + content[at + size :]
    if kind == 6:
        return content[:at] + bytes(rng.randrange(256) for _ in range(min(size, 64))) + content[at:]
    if kind == 7 and donors:
        donor = rng.choice(donors)
        start = rng.randrange(len(donor) + 1)
        return content[:at] + donor[start : start + size] + content[at + (size if rng.random() < 0.7 else 0) :]
    to = rng.randrange(len(content))
    rest = content[:at] + content[at + size :]
    return rest[:to] + content[at : at + size] + rest[to:]
