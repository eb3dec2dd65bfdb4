"""The benchmark of queries measures each task on a small run; its scenes are those of a run with other numbers."""

from pathlib import Path

import pytest

from benchmarks.query import TASKS, measure, rows_of, scene_name, write_rows
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_index import SceneIndex
from tests.stable_data.storage.small_run import write_run


def test_rows_are_the_same_for_the_same_start_and_valid(tmp_path: Path) -> None:
    source = RunFolder(write_run(tmp_path / "source"))
    target = RunFolder(str(tmp_path / "large"))
    write_rows(source, target, 3000)
    assert target.num_rows("scenes") == 3000
    base = source.table("scenes").combine_chunks()
    assert rows_of(base, 2048, 952).equals(rows_of(base, 2048, 952))
    index = SceneIndex(target, folder=tmp_path)
    assert [s.scene_id for s in index.scenes([scene_name(2999), scene_name(0)])] == [scene_name(2999), scene_name(0)]


@pytest.mark.slow
def test_each_task_is_measured(tmp_path: Path) -> None:
    target = RunFolder(str(tmp_path / "large"))
    write_rows(RunFolder(write_run(tmp_path / "source")), target, 3000)
    figures, sizes = measure(target.uri, tmp_path, [])
    assert {f.task for f in figures} >= {name for name, _, _, _ in TASKS}
    assert sizes["rows"] == 3000
    found = {(f.task, f.way): f.rows for f in figures}
    for task in ("scenes counted by condition", "scenes selected by condition"):
        assert found[task, "query"] == found[task, "scan"] > 0
