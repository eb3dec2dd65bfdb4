"""What is written of a shard."""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pytest

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows, Shard, ShardResult, ShardStep, ShardTask, ShardWriter
from stable_data.errors import Notice
from stable_data.limits import MIB, resident_memory
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import notice_row

SHARD = "0" * 16


@dataclass(frozen=True, slots=True)
class RemarkStep(ItemStep[tuple[str, Any]]):
    """Remarks on an item, which has a name and a message that is whatever it is."""

    TABLES: ClassVar = ("failures", "warnings")

    def item_id(self, item: tuple[str, Any]) -> str:
        return item[0]

    def item_rows(self, item: tuple[str, Any], progress: ItemProgress) -> Rows:
        return {"warnings": [{**notice_row(Notice(item[0], "remark", "said", "")), "message": item[1]}]}


@dataclass(frozen=True, slots=True)
class UncheckedRemarkStep(RemarkStep):
    """The same without a look at the rows of single items."""

    def _isolated_rows(self, item: tuple[str, Any]) -> Rows:
        return self.item(item)


def test_items_whose_rows_cannot_be_written_fail_alone(tmp_path: Path) -> None:
    remarks: tuple[Any, ...] = ("one", "half of a pair \ud800", 3, ["a list"], "two")
    items = tuple(zip("abcde", remarks, strict=True))
    written = ShardWriter(str(tmp_path), (RemarkStep(),))(ShardTask(0, Shard(SHARD, items)))
    assert (written.num_items, written.num_failures) == (5, 3)
    run = RunFolder(tmp_path)
    assert run.table("warnings")["message"].to_pylist() == ["one", "two"]
    failures = run.table("failures").to_pylist()
    assert [(row["id"], row["step"], row["code"]) for row in failures] == [(name, "write", "unexpected") for name in "bcd"]
    assert all("please report this" in row["message"] for row in failures)


def test_rows_that_cannot_be_written_and_are_of_no_item_end_the_job(tmp_path: Path) -> None:
    with pytest.raises(pa.ArrowTypeError):
        ShardWriter(str(tmp_path), (UncheckedRemarkStep(),))(ShardTask(0, Shard(SHARD, (("a", "one"), ("b", 3)))))
    assert not RunFolder(tmp_path).shard_ids("warnings")


@dataclass(frozen=True, slots=True)
class WastefulStep(ShardStep[int]):
    """Leaves memory that is free, except for 64 KiB of each megabyte, and large arrays between small pieces that stay.

    Attributes:
        resident: Memory of this process before and after the pieces of each shard, MB.
        gaps: Memory that the large arrays leave, MB.
        kept: The pieces that stay.
    """

    TABLES: ClassVar = ("warnings",)

    resident: list[float] = field(default_factory=list)
    gaps: list[float] = field(default_factory=list)
    kept: list[bytes] = field(default_factory=list)

    def shard(self, shard: Shard[int], *, isolated: bool = False) -> ShardResult:
        np.ones(2**25 - 2**16, np.uint8)  # from now on glibc takes such arrays from its heap, if it may
        before, arrays = resident_mb(), list[Any]()
        for _ in range(16):
            arrays.append(np.ones(2**23, np.uint8))
            self.kept.append(os.urandom(100_000))
        del arrays
        self.gaps.append(resident_mb() - before)
        self.resident.append(resident_mb())
        pieces = [os.urandom(2**16) for _ in range(2**11)]  # of 64 KiB, which malloc takes from its heap
        self.kept.extend(pieces[::16])
        del pieces
        self.resident.append(resident_mb())
        return ShardResult({})


def resident_mb() -> float:
    resident = resident_memory()
    assert resident is not None
    return resident / MIB


def wasted(out: str) -> tuple[list[float], list[float]]:
    """What two shards of :class:`WastefulStep` measure."""
    step = WastefulStep()
    for _ in range(2):
        ShardWriter(out, (step,))(ShardTask(0, Shard(SHARD, (1,))))
    return step.resident, step.gaps


@pytest.mark.skipif(sys.platform != "linux", reason="glibc returns what is free")
def test_what_a_shard_has_freed_is_returned_to_the_system(tmp_path: Path) -> None:
    # In a new process: the heap of this one may have room for large arrays that other tests have freed.
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        (_, first_after, second_before, _), gaps = pool.submit(wasted, str(tmp_path)).result()
    assert second_before < first_after - 90  # of the 128 MB, 8 are kept
    assert max(gaps) < 8
