"""How items are split into shards, and the default number of items in a shard."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")


def shard_size(count: int, *, parts: int, fewest: int, most: int) -> int:
    """The default size of a shard. It follows from the number of items alone, so that rows do not depend on the workers.

    Args:
        count: Number of items of the job.
        parts: Number of shards of a small job.
        fewest: Smallest size.
        most: Largest size; a lost worker costs at most this many items.
    """
    return min(most, max(fewest, -(-count // parts)))


def split_groups(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Splits items, in their order, into groups of at most ``size``."""
    return (items[start : start + size] for start in range(0, len(items), size))
