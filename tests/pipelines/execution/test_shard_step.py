"""What is written of a shard."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa
import pytest

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.shard_step import ItemStep, Rows, Shard, ShardTask, ShardWriter
from stable_data.errors import Notice
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


@pytest.mark.parametrize("bad", ["half of a pair \ud800", 3, ["a list"]], ids=["text", "number", "list"])
def test_an_item_whose_rows_cannot_be_written_fails_alone(tmp_path: Path, bad: Any) -> None:
    written = ShardWriter(str(tmp_path), (RemarkStep(),))(ShardTask(0, Shard(SHARD, (("a", "one"), ("b", bad), ("c", "two")))))
    assert (written.num_items, written.num_failures) == (3, 1)
    run = RunFolder(tmp_path)
    assert run.table("warnings")["message"].to_pylist() == ["one", "two"]
    (failure,) = run.table("failures").to_pylist()
    assert (failure["id"], failure["step"], failure["code"]) == ("b", "write", "unexpected")
    assert "please report this" in failure["message"]


def test_rows_that_cannot_be_written_and_are_of_no_item_end_the_job(tmp_path: Path) -> None:
    with pytest.raises(pa.ArrowTypeError):
        ShardWriter(str(tmp_path), (UncheckedRemarkStep(),))(ShardTask(0, Shard(SHARD, (("a", "one"), ("b", 3)))))
    assert not RunFolder(tmp_path).shard_ids("warnings")
