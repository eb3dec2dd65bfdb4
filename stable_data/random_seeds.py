"""Seeds that are named by what they are for, so that a draw depends on nothing but that."""

import hashlib


def named_seed(*parts: object) -> int:
    """The seed that some words name, the same on every machine.

    Args:
        parts: Such as a job's seed, a scene and an attempt; their texts count, and where one ends.

    Returns:
        48 bits, which every generator and every JSON reader takes.
    """
    return int.from_bytes(hashlib.sha256(":".join(map(str, parts)).encode()).digest()[:6], "big")
