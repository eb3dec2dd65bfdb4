"""Names made of content."""

import hashlib
import json
from typing import Any


def content_id(*parts: Any) -> str:
    """Name of a shard: 16 hex digits of the hash of JSON-able parts."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
