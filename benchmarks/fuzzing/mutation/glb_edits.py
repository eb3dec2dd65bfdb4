"""Edits of binary glTF files: of the JSON as a tree, with lengths that fit; of the numbers and images in the binary chunk; of the head."""

import json
import struct
from collections.abc import Sequence
from random import Random
from typing import Any

from benchmarks.fuzzing.mutation.byte_edits import edited_bytes
from benchmarks.fuzzing.mutation.json_edits import edited_json

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOATS = (float("nan"), float("inf"), -1e38, 1e30, 0.0, -0.0, 1e-40, 1.0, -1.0)


def split_glb(content: bytes) -> tuple[bytes, bytes] | None:
    """Returns the JSON and the binary chunk of a file; None if it is none."""
    if len(content) < 20 or struct.unpack_from("<I", content)[0] != _MAGIC:
        return None
    size, kind = struct.unpack_from("<II", content, 12)
    if kind != _JSON or 20 + size > len(content):
        return None
    rest = content[20 + size :]
    return content[20 : 20 + size], rest[8:] if len(rest) >= 8 else b""


def joined_glb(document: bytes, binary: bytes) -> bytes:
    """Returns a file of a JSON and a binary chunk, with the lengths that they have."""
    document += b" " * (-len(document) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<II", len(document), _JSON) + document
    if binary:
        body += struct.pack("<II", len(binary), _BIN) + binary
    return struct.pack("<III", _MAGIC, 2, 12 + len(body)) + body


def edited_glb(content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes | None:
    """Returns a binary glTF with one edit; None if it is none.

    Args:
        content: The file.
        rng: Chooses the edit.
        donors: Files from which values are copied.
        words: Words of the grammar, such as names of extensions.
    """
    parts = split_glb(content)
    if parts is None:
        return None
    document, binary = parts
    kind = rng.random()
    if kind < 0.6:
        others = [found[0] for donor in donors[:8] if (found := split_glb(donor)) is not None]
        changed = edited_json(document, rng, others, words)
        return None if changed is None else joined_glb(changed, binary)
    if kind < 0.75:
        return joined_glb(document, _edited_numbers(document, binary, rng))
    if kind < 0.9:
        return joined_glb(document, _edited_image(document, binary, rng))
    at = rng.choice((0, 4, 8, 12, 16, 20 + len(document), 24 + len(document)))
    number = rng.choice((0, 1, 2**31, 2**32 - 1, len(content), len(content) - 1, 3, _BIN, _JSON))
    return content[:at] + struct.pack("<I", number) + content[at + 4 :]


def _views(document: bytes) -> tuple[list[Any], dict[str, Any]]:
    try:
        found: dict[str, Any] = json.loads(document)
        return list(found["bufferViews"]), found
    except (ValueError, LookupError, TypeError, RecursionError):
        return [], {}


def _edited_numbers(document: bytes, binary: bytes, rng: Random) -> bytes:
    """Overwrites some numbers of one view of the buffer."""
    views, _ = _views(document)
    spans = [
        (v.get("byteOffset", 0), v["byteLength"]) for v in views if isinstance(v, dict) and isinstance(v.get("byteLength"), int)
    ]
    spans = [(a, n) for a, n in spans if isinstance(a, int) and a >= 0 and 4 <= n <= len(binary) - a]
    start, size = rng.choice(spans) if spans else (0, len(binary))
    if size < 4:
        return edited_bytes(binary, rng)
    changed = bytearray(binary)
    for _ in range(rng.choice((1, 1, 3, 30))):
        at = start + 4 * rng.randrange(size // 4)
        word = (
            struct.pack("<f", rng.choice(_FLOATS))
            if rng.random() < 0.7
            else struct.pack("<I", rng.choice((0, 1, 2, 2**16, 2**32 - 1)))
        )
        changed[at : at + 4] = word
    return bytes(changed)


def _edited_image(document: bytes, binary: bytes, rng: Random) -> bytes:
    """Edits the bytes of an image of the file; of the whole chunk without one."""
    views, found = _views(document)
    numbers = (
        [i.get("bufferView") for i in found.get("images", ()) if isinstance(i, dict)]
        if isinstance(found.get("images"), list)
        else []
    )
    spans = [views[n] for n in numbers if isinstance(n, int) and 0 <= n < len(views) and isinstance(views[n], dict)]
    if not spans:
        return edited_bytes(binary, rng)
    view = rng.choice(spans)
    start, size = view.get("byteOffset", 0), view.get("byteLength", 0)
    if not (isinstance(start, int) and isinstance(size, int) and start >= 0 and 0 < size <= len(binary) - start):
        return edited_bytes(binary, rng)
    changed = edited_bytes(binary[start : start + size], rng)[:size].ljust(size, b"\0")  # the other views stay where they are
    return binary[:start] + changed + binary[start + size :]
