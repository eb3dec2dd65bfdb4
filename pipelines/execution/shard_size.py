"""How items are cut into shards, and how many a shard has where no setting says it."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")


def shard_size(count: int, *, parts: int, fewest: int, most: int) -> int:
    """The size of a shard. It follows from the number of items alone, so that rows do not depend on the number of workers.

    Args:
        count: Number of items of the job.
        parts: Number of shards that small jobs are cut into.
        fewest: Smallest size.
        most: Largest size: a lost worker costs at most so many items.
    """
    return min(most, max(fewest, -(-count // parts)))


def split_groups(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Items in their order, so many at a time."""
    return (items[start : start + size] for start in range(0, len(items), size))
