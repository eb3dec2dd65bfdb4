"""Names derived from content."""

import hashlib
import json
from collections.abc import Iterable
from typing import Any

# Fixed order and separators: equal parts give equal names on every machine.
_ENCODER = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def content_id(*parts: Any) -> str:
    """Returns the name of a shard: 16 hex digits of the hash of its parts, which JSON must be able to represent."""
    return hashlib.sha256(_ENCODER.encode(parts).encode()).hexdigest()[:16]


def content_id_of_items(items: Iterable[Any], *parts: Any) -> str:
    """Returns ``content_id([*items], *parts)``; needs the memory of one item at a time."""
    digest = hashlib.sha256(b"[[")
    for number, item in enumerate(items):
        digest.update(f"{',' if number else ''}{_ENCODER.encode(item)}".encode())
    digest.update("".join(["]", *(f",{_ENCODER.encode(part)}" for part in parts), "]"]).encode())
    return digest.hexdigest()[:16]
