"""Edits of safetensors files: of the header as a tree, of the JSON texts in its notes, of the numbers, of the lengths."""

import json
import struct
from collections.abc import Sequence
from random import Random

from benchmarks.fuzzing.mutation.json_edits import edited_json

_NOTES = "__metadata__"
_FLOATS = (float("nan"), float("inf"), 1e38, -1e38, 0.0, 1e-40)


def edited_tensors(content: bytes, rng: Random, donors: Sequence[bytes] = (), words: Sequence[str] = ()) -> bytes | None:
    """Returns a safetensors file with one edit; None if it is none.

    Args:
        content: The file.
        rng: Chooses the edit.
        donors: Files from which headers are copied.
        words: Words of the grammar.
    """
    parts = _split(content)
    if parts is None:
        return None
    header, data = parts
    kind = rng.random()
    if kind < 0.35:
        return _with_note(header, data, rng, words)
    if kind < 0.75:
        others = [found[0] for donor in donors[:4] if (found := _split(donor)) is not None]
        changed = edited_json(header, rng, others, words)
        return None if changed is None else _joined(changed, data)
    if kind < 0.92 and len(data) >= 4:
        numbers = bytearray(data)
        for _ in range(rng.choice((1, 1, 10))):
            at = 4 * rng.randrange(len(data) // 4)
            numbers[at : at + 4] = struct.pack("<f", rng.choice(_FLOATS))
        return _joined(header, bytes(numbers))
    if kind < 0.96:
        return _joined(
            header, data[: rng.randrange(len(data) + 1)] if rng.random() < 0.5 else data + b"\0" * rng.randrange(1, 100)
        )
    size = rng.choice((0, 1, max(0, len(header) - 1), len(header) + 1, len(content), 2**31, 2**63, 2**64 - 1))
    return struct.pack("<Q", size) + content[8:]


def _split(content: bytes) -> tuple[bytes, bytes] | None:
    size = int.from_bytes(content[:8], "little")
    return (content[8 : 8 + size], content[8 + size :]) if len(content) >= 8 and size <= len(content) - 8 else None


def _joined(header: bytes, data: bytes) -> bytes:
    header += b" " * (-len(header) % 8)
    return struct.pack("<Q", len(header)) + header + data


def _with_note(header: bytes, data: bytes, rng: Random, words: Sequence[str]) -> bytes | None:
    """Edits the JSON in a note, or the note itself."""
    try:
        document = json.loads(header)
        notes = document[_NOTES]
        name = rng.choice(sorted(notes))
        changed = edited_json(str(notes[name]).encode(), rng, (), words)
    except (ValueError, LookupError, TypeError, RecursionError):
        return None
    notes[name] = rng.choice(("", "x", "{}", "null", "0")) if changed is None else changed.decode("utf-8", "replace")
    return _joined(json.dumps(document).encode(), data)
