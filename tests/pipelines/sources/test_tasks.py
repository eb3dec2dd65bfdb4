"""A file of tasks: rows of any of its kinds become tasks, and what is none is named."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.sources.tasks import read_tasks, write_tasks
from stable_data.errors import ConfigError, Notice
from stable_data.scene import Tabletop
from tests.bounds import limit

GOOD = {"instruction": "Lift it.", "table_type": "office_table", "table_size_cm": [120, 60]}


def task_file(folder: Path, rows: Sequence[Any]) -> Path:
    path = folder / "tasks.jsonl"
    path.write_text("".join(f"{row if isinstance(row, str) else json.dumps(row)}\n" for row in rows))
    return path


def test_each_row_is_a_task_or_says_why_not(tmp_path: Path) -> None:
    rows = [
        GOOD,
        "no JSON",
        {**GOOD, "scene_id": "mine", "restricted_zone_cm": [0, 40, 40, 60]},
        {**GOOD, "scene_id": "mine"},
        {**GOOD, "scene_id": "../mine"},
        {**GOOD, "instruction": " "},
        {**GOOD, "table_size_cm": [120]},
        {**GOOD, "table_type": "a/b"},
        {**GOOD, "colour": "red"},
    ]
    found = list(read_tasks(task_file(tmp_path, rows)))
    assert found[:1] + found[2:3] == [
        LayoutTask("task_000001", "Lift it.", Tabletop("office_table", (1.2, 0.6))),
        LayoutTask("mine", "Lift it.", Tabletop("office_table", (1.2, 0.6), (0.0, 0.4, 0.4, 0.6))),
    ]
    assert {lost.item_id: lost.code for lost in found if isinstance(lost, Notice)} == {
        "row 000002": "task_invalid",
        "row 000004": "task_invalid",
        "row 000005": "task_invalid",
        "row 000006": "instruction_invalid",
        "row 000007": "table_invalid",
        "row 000008": "table_invalid",
        "row 000009": "task_invalid",
    }


_START = '{"instruction": "Lift it.", "table_type": "office_table", "table_size_cm": '


@pytest.mark.parametrize(
    "row",
    [
        r'{"instruction": "\ud800 Lift it.", "table_type": "office_table", "table_size_cm": [120, 60]}',
        r'{"instruction": "Lift it.", "table_type": "\udfff", "table_size_cm": [120, 60]}',
        f"{_START}[{10**400}, 5]}}",
        f"{_START}[{'9' * 5000}, 5]}}",
        f'{_START}[120, 60], "restricted_zone_cm": [0, {10**400}, 0, 1]}}',
        f"{_START}[NaN, 1e999]}}",
        f'{_START}[120, 60], "scene_id": {10**400}}}',
        "[" * 100_000,
    ],
    ids=range(8),
)
def test_a_hostile_row_is_a_failure_of_its_own(row: str, tmp_path: Path) -> None:
    first, lost, last = read_tasks(task_file(tmp_path, [GOOD, row, GOOD]))
    assert isinstance(lost, Notice)
    assert lost.item_id == "row 000002"
    assert len(lost.message.encode()) < 2000
    assert isinstance(first, LayoutTask)
    assert isinstance(last, LayoutTask)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_file_of_another_kind_says_the_same(ending: str, tmp_path: Path) -> None:
    rows = [{"scene_id": "a", **GOOD, "restricted_zone_cm": [0.0, 40.0, 10.5, 20.0]}, GOOD, {**GOOD, "instruction": ""}]
    path = tmp_path / f"tasks.{ending}"
    if ending == "parquet":
        pq.write_table(pa.Table.from_pylist(rows), path)
    else:
        with path.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, rows[0])
            writer.writeheader()
            for row in rows:
                sizes = {"table_size_cm": "120 x 60"} | (
                    {"restricted_zone_cm": "[0, 40, 10.5, 20]"} if "scene_id" in row else {}
                )
                writer.writerow(row | sizes)
    expected = [*read_tasks(task_file(tmp_path, rows))]
    found = [*read_tasks(path)]
    assert found[:2] == expected[:2]
    last, other = found[2], expected[2]
    assert isinstance(last, Notice)
    assert isinstance(other, Notice)
    assert (last.item_id, last.code) == (other.item_id, other.code) == ("row 000003", "instruction_invalid")


def test_no_task_has_the_name_of_a_row_that_is_none(tmp_path: Path) -> None:
    names = ["row_000002", "row 000002", "row_000004", "task_000006"]
    rows = [*({**GOOD, "scene_id": name} for name in names), {**GOOD, "instruction": ""}, GOOD, "no JSON"]
    found = list(read_tasks(task_file(tmp_path, rows)))
    tasks = [task.scene_id for task in found if isinstance(task, LayoutTask)]
    lost = {notice.item_id: notice.message for notice in found if isinstance(notice, Notice)}
    assert tasks == ["row_000002", "row_000004", "task_000006"]
    assert list(lost) == ["row 000002", "row 000005", "row 000006", "row 000007"]
    assert "scene_id task_000006 is used twice, expected a unique id" in lost["row 000006"]  # first come keeps the name


def test_an_empty_instruction_is_shown_as_it_is(tmp_path: Path) -> None:
    (lost,) = read_tasks(task_file(tmp_path, [{**GOOD, "instruction": ""}]))
    assert isinstance(lost, Notice)
    assert "instruction is '', expected" in lost.message


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_column_that_is_none_of_a_tasks_is_refused_at_once(ending: str, tmp_path: Path) -> None:
    """Else the rows alone would be lost that fill it."""
    path = tmp_path / f"tasks.{ending}"
    rows = [{"instruction": "Lift it.", "table_type": "desk", "table_size_cm": "120 x 60", "note": note} for note in ("", "a")]
    if ending == "csv":
        path.write_text("\n".join(",".join(row.values()) for row in ({key: key for key in rows[0]}, *rows)))
    else:
        pq.write_table(pa.Table.from_pylist(rows), path)
    with pytest.raises(ConfigError, match="has a column 'note', expected tasks"):
        list(read_tasks(path))


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe{", b"instruction,table_type\na,b\n", b"PAR1 and no more"])
@pytest.mark.parametrize("ending", ["jsonl", "csv", "parquet", "xlsx"])
def test_a_file_that_holds_no_tasks_is_refused(content: bytes | None, ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"tasks.{ending}"
    if content is not None:
        path.write_bytes(content)
    if ending == "jsonl" and content:
        assert all(isinstance(found, Notice) for found in read_tasks(path))
        return
    with pytest.raises(ConfigError) as caught:
        list(read_tasks(path))
    assert caught.value.code == "tasks_invalid"
    assert "\n" not in str(caught.value)


def test_tasks_that_are_written_are_read_again(tmp_path: Path) -> None:
    tables = Tabletop("bathroom_vanity", (1.2345, 0.5), (0.3, 0.7, 0.05, 0.45)), Tabletop("table", (0.8, 0.6))
    tasks = [LayoutTask(f"task_{k}", f"Lift the café cup {k}.", table) for k, table in enumerate(tables)]
    path = tmp_path / "made" / "tasks.jsonl"
    assert write_tasks(path, tasks) == 2
    found = list(read_tasks(path))
    assert all(isinstance(task, LayoutTask) for task in found)
    for task, again in zip(tasks, found, strict=True):
        assert isinstance(again, LayoutTask)
        assert (again.scene_id, again.instruction, again.table.table_type) == (
            task.scene_id,
            task.instruction,
            task.table.table_type,
        )
        assert again.table.size_xy == pytest.approx(task.table.size_xy, abs=1e-9)
        assert again.table.restricted_zone == (
            None if task.table.restricted_zone is None else pytest.approx(task.table.restricted_zone, abs=1e-9)
        )
    with pytest.raises(ConfigError, match="jsonl"):
        write_tasks(tmp_path / "tasks.csv", tasks)


@pytest.mark.parametrize("suffix", ["jsonl", "csv"])
def test_a_line_without_an_end_is_a_failure_of_its_row(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "text", max_line=1000)
    path = tmp_path / f"tasks.{suffix}"
    if suffix == "jsonl":
        good = json.dumps(GOOD)
        path.write_text(f'{good}\n{{"instruction": "{"x" * 5000}\n{good}\n')
    else:
        good = "Lift it.,office_table,120 60"
        path.write_text(f"instruction,table_type,table_size_cm\n{good}\n{'x' * 5000},office_table,120 60\n{good}\n")
    first, lost, last = read_tasks(path)
    assert isinstance(lost, Notice)
    assert isinstance(first, LayoutTask)
    assert isinstance(last, LayoutTask)
    assert "at most 1,000 characters (text.max_line in STABLE_DATA_LIMITS)" in lost.message


@pytest.mark.parametrize("suffix", ["jsonl", "csv", "parquet"])
def test_a_file_of_too_many_lines_is_refused(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of its lines may be a failure, which takes hundreds of times its bytes."""
    path = tmp_path / f"tasks.{suffix}"

    def write(lines: int) -> None:
        if suffix == "parquet":
            pq.write_table(pa.table(dict.fromkeys(("instruction", "table_type", "table_size_cm"), [None] * lines)), path)
        else:
            path.write_text("instruction,table_type,table_size_cm\n" * lines)

    limit(monkeypatch, "text", max_lines=3)
    write(3)
    assert len(list(read_tasks(path))) == (2 if suffix == "csv" else 3)
    write(4)
    with pytest.raises(
        ConfigError, match=r"has more lines or rows, expected at most 3 \(text\.max_lines in STABLE_DATA_LIMITS\)"
    ) as caught:
        list(read_tasks(path))
    assert caught.value.code == "too_many_lines"


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    "long",
    [
        f'"put a mug, {"x" * 5000}",office_table,120 60',
        f'"put a ""mug"", {"x" * 5000}",office_table,120 60',
        f'"put a mug,@{"x" * 5000}",office_table,120 60',
        f'"put a mug,{"x" * 5000}@on it",office_table,120 60',
        f'"put a mug,@{"x" * 5000}@on it",office_table,120 60',
    ],
)
def test_a_long_line_of_csv_swallows_no_other_row(long: str, end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With and without quotation marks, which may be opened and closed on other lines (@)."""
    limit(monkeypatch, "text", max_line=1000)
    path, good = tmp_path / "tasks.csv", "Lift it.,office_table,120 60"
    lines = ["instruction,table_type,table_size_cm", good, *long.split("@"), good, good]
    path.write_bytes("".join(line + end for line in lines).encode())
    first, lost, *last = read_tasks(path)
    assert isinstance(lost, Notice)
    assert "text.max_line in STABLE_DATA_LIMITS" in lost.message
    assert [type(task) for task in (first, *last)] == [LayoutTask] * 3


def test_a_field_of_csv_may_be_as_long_as_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, "text", max_instruction=10**6)
    path = tmp_path / "tasks.csv"
    path.write_text(f"instruction,table_type,table_size_cm\n{'x' * 200_000},office_table,120 60\n", "utf-8")
    (task,) = read_tasks(path)
    assert isinstance(task, LayoutTask)


def test_an_instruction_has_a_limited_length(tmp_path: Path) -> None:
    """The time to read it grows with a power of its length."""
    (lost,) = read_tasks(task_file(tmp_path, [{**GOOD, "instruction": "pour water on " * 1000}]))
    assert isinstance(lost, Notice)
    assert lost.code == "instruction_invalid"
    assert "text.max_instruction in STABLE_DATA_LIMITS" in lost.message


def test_a_small_parquet_file_of_long_rows_is_read_a_few_rows_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = pa.Table.from_pylist([{**GOOD, "instruction": "x" * 10**5}])
    path = tmp_path / "tasks.parquet"
    pq.write_table(pa.concat_tables([rows] * 1000), path, compression="zstd")
    limit(monkeypatch, "table", max_decoded_bytes=2 * 10**6)
    before = pa.total_allocated_bytes()
    needed = [pa.total_allocated_bytes() - before for _ in read_tasks(path)]
    assert len(needed) == 1000
    assert max(needed) < 10**7
