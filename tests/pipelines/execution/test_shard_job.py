"""What the jobs share: whose fault an error is, and that every item is one row."""

import errno
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.resume import OF_DATASET, count_items
from pipelines.execution.shard_step import NOT_OF_AN_ITEM, Rows, rows_or_failure
from stable_data.errors import ConfigError, Notice
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.table_rows import notice_row


class FailsOnce:
    """Rows whose first making fails as a disk or a network does."""

    calls = 0

    def __call__(self) -> Rows:
        self.calls += 1
        if self.calls == 1:
            raise OSError(errno.EIO, "Input/output error")
        return {"scenes": []}


def test_an_error_of_an_item_from_outside_is_its_row() -> None:
    (row,) = rows_or_failure("scene_1", ItemProgress("read"), FailsOnce())["failures"]
    assert (row["id"], row["step"], row["code"]) == ("scene_1", "read", "unexpected")
    assert "Input/output error" in row["message"]


def test_an_error_that_is_the_runs_is_no_row_and_another_time_there_is_none() -> None:
    make = FailsOnce()
    with pytest.raises(OSError, match="Input/output error"):
        rows_or_failure("scene_1", ItemProgress("read"), make, of_the_run=NOT_OF_AN_ITEM)
    assert rows_or_failure("scene_1", ItemProgress("read"), make, of_the_run=NOT_OF_AN_ITEM) == {"scenes": []}


def run_of(out: Path, scenes: list[str], failures: list[str], of_assets: Sequence[str] = ()) -> RunFolder:
    """A run with one shard of scenes and one of assets, of which some fail."""
    folder = RunFolder(str(out))
    blank = dict.fromkeys(SCHEMAS["scenes"].names)
    folder.write_shard("scenes", "0" * 16, [blank | {"scene_id": scene_id} for scene_id in scenes])
    for shard_id, failed in (("0" * 16, failures), ("1" * 16, of_assets)):
        rows = [notice_row(Notice(item_id, "read", "lost", f"{item_id}: is lost")) for item_id in failed]
        folder.write_shard("failures", shard_id, rows)
    return folder


def test_items_that_failed_are_counted(tmp_path: Path) -> None:
    folder = run_of(tmp_path, ["a", "b"], ["c"])
    assert count_items(folder, "scenes", "scene_id", ["a", "b", "c"]) == 1
    assert count_items(run_of(tmp_path / "none", [], ["a"]), "scenes", "scene_id", ["a"]) == 1


def test_what_is_lost_of_the_input_as_a_whole_counts(tmp_path: Path) -> None:
    folder = run_of(tmp_path, ["a"], [])
    folder.write_shard("failures", OF_DATASET, [notice_row(Notice("b", "read", "lost", "b: is lost"))])
    assert count_items(folder, "scenes", "scene_id", ["a", "b"], with_lost=True) == 1


def test_an_asset_that_failed_under_the_name_of_a_scene_is_no_failure_of_the_scene(tmp_path: Path) -> None:
    folder = run_of(tmp_path, ["a"], [], of_assets=["a", "a", "b"])
    assert count_items(folder, "scenes", "scene_id", ["a"]) == 0
    with pytest.raises(ConfigError, match="1 scenes such as b"):
        count_items(folder, "scenes", "scene_id", ["a", "b"])


def test_a_scene_that_is_lost_under_the_name_of_an_asset_is_no_failure_of_the_asset(tmp_path: Path) -> None:
    folder = run_of(tmp_path, ["a"], [], of_assets=[])
    folder.write_shard("assets", "1" * 16, [dict.fromkeys(SCHEMAS["assets"].names) | {"asset_id": "b"}])
    folder.write_shard("failures", OF_DATASET, [notice_row(Notice("b", "read", "layout_missing", "b: is lost"))])
    assert count_items(folder, "assets", "asset_id", ["b"]) == 0
    assert count_items(folder, "scenes", "scene_id", ["a", "b"], with_lost=True) == 1


@pytest.mark.parametrize(
    ("scenes", "failures", "odd"),
    [
        (["a", "b"], ["b"], "b"),  # both usable and failed
        (["a", "a", "b"], [], "a"),
        (["a"], ["b", "b"], "b"),
        (["a"], [], "b"),
        (["a", "b", "c"], [], "c"),  # nobody asked for it
    ],
)
def test_an_item_that_is_not_exactly_one_row_is_refused(
    scenes: list[str], failures: list[str], odd: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=f"1 scenes such as {odd} are not in exactly one row of scenes or failures") as caught:
        count_items(run_of(tmp_path, scenes, failures), "scenes", "scene_id", ["a", "b"])
    assert caught.value.code == "rows_differ"
