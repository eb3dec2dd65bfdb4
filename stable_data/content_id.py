"""Names derived from content."""

import hashlib
import json
from typing import Any


def content_id(*parts: Any) -> str:
    """Returns the name of a shard: 16 hex digits of the hash of its parts, which JSON must be able to represent."""
    # Fixed order and separators: equal parts give equal names on every machine.
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
