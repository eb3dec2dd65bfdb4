"""Random seeds derived from names, so that a draw depends only on the parts of its name."""

import hashlib


def named_seed(*parts: object) -> int:
    """Returns the seed of a name, the same on every machine.

    Args:
        parts: Such as a job's seed, a scene and an attempt; their texts are joined by ``:`` and hashed.

    Returns:
        48 bits, which every random generator and every JSON reader accepts.
    """
    return int.from_bytes(hashlib.sha256(":".join(map(str, parts)).encode()).digest()[:6], "big")
