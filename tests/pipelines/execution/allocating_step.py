"""A step whose items allocate memory; a worker imports this module, so that it needs as little as it can."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch  # noqa: F401 - an item has not the memory to import it

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows, Shard
from tests.bounds import limit
from tests.pipelines.execution.allocating import MIB, allocate, allocate_tensor


@dataclass(frozen=True, slots=True)
class AllocationStep(ItemStep[int]):
    """Allocates so many MiB for an item, with torch and without, where an item has 64 MiB."""

    TABLES: ClassVar = ("failures",)

    def item_rows(self, item: int, progress: ItemProgress) -> Rows:
        (allocate_tensor if item % 2 else allocate)(item * MIB)
        return {}

    def __call__(self, shard: Shard[int], *, isolated: bool = False) -> list[tuple[str, str]]:
        with pytest.MonkeyPatch.context() as patch:
            limit(patch, "item", max_memory_bytes=64 * MIB)  # the workers have the limits of the session
            return [(row["id"], row["code"]) for row in self.shard(shard, isolated=isolated).rows.get("failures", ())]
