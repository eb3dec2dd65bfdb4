"""A scan answers as Arrow does on the whole table, whatever the condition, the files and the row groups."""

import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.errors import ConfigError, MissingColumnsWarning
from stable_data.storage import run_folder, subset
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.id_hashes import Hashes, id_hashes
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.subset import count_selected, select
from stable_data.storage.table_scan import TableScan
from tests.stable_data.storage.small_run import SHARDS, write_run

CONDITIONS = (
    "stable",
    "not stable",
    "stable is None",
    "num_stacked >= 2 and stable",
    "num_stacked < 1 or oc > 0.5",
    "not (num_stacked in [0, 2])",
    "oc is not None and scene_id != 's3'",
    "scene_id in ['s1', 's7', 'none']",
)


def rows(data: st.DataObject) -> list[dict[str, object]]:
    one = st.fixed_dictionaries(
        {
            "stable": st.sampled_from([True, False, None]),
            "num_stacked": st.none() | st.integers(0, 3),
            "oc": st.none() | st.floats(0.0, 1.0),
        }
    )
    found = data.draw(st.lists(one, max_size=30))
    blank = dict.fromkeys(SCHEMAS["scenes"].names) | {"table_size": [1.0, 1.0], "objects": []}
    return [blank | {"scene_id": f"s{k}"} | row for k, row in enumerate(found)]


@given(st.data(), st.sampled_from(CONDITIONS), st.integers(1, 6), st.integers(1, 12))
@settings(max_examples=30, deadline=None)
def test_counts_and_rows_are_those_of_the_whole_table(data: st.DataObject, where: str, group: int, size: int) -> None:
    every = rows(data)
    with tempfile.TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_folder, "_GROUP_ROWS", {"scenes": group})
        run = RunFolder(place)
        for start in range(0, max(1, len(every)), size):
            run.write_shard("scenes", f"{start:016x}", every[start : start + size])
        expected = run.table("scenes", where=parse_filter(where, SCHEMAS["scenes"]).expression)
        scan = TableScan(run, "scenes", where)
        assert scan.count() == (expected.num_rows, len(every))
        assert pa.concat_tables(scan.tables()).equals(expected)


def test_a_column_that_files_lack_is_null_and_named(tmp_path: Path) -> None:
    run = RunFolder(write_run(tmp_path / "run"))
    path = run.files("scenes")[0]
    pq.write_table(pq.read_table(path).drop_columns(["oc"]), path)
    with pytest.warns(MissingColumnsWarning, match="before oc existed"):
        assert count_selected(run, "num_objects >= 0") == (run.num_rows("scenes"),) * 2
    with pytest.warns(MissingColumnsWarning, match="the condition names oc"):
        found, _ = TableScan(run, "scenes", "oc is None").count()
    assert found == SHARDS[0]


def test_what_cannot_be_scanned_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no table scenes"):
        TableScan(RunFolder(str(tmp_path / "none")), "scenes", "stable")
    run = RunFolder(write_run(tmp_path / "run"))
    with pytest.raises(ConfigError, match="expected stable or stable_share"):
        TableScan(run, "scenes", "stabel")
    Path(run.files("scenes")[2]).write_bytes(b"PAR1 damaged")
    for scan in (lambda: count_selected(run, "stable"), lambda: select(run, "stable", RunFolder(str(tmp_path / "out")))):
        with pytest.raises(ConfigError, match="cannot be read"):
            scan()


def test_selected_scenes_are_known_by_their_whole_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first half of every hash is one of two values, so that the other half has to tell."""

    def weak(names: pa.Array) -> Hashes:
        found = id_hashes(names).copy()
        found[:, 0] %= np.uint64(2)
        return found

    monkeypatch.setattr(subset, "id_hashes", weak)
    chosen = subset._Chosen()
    names = [f"s{k}" for k in range(40)]
    blank = dict.fromkeys(SCHEMAS["scenes"].names)
    chosen.noted(pa.Table.from_pylist([blank | {"scene_id": name, "objects": []} for name in names[::2]], SCHEMAS["scenes"]))
    chosen.close(set())
    assert chosen.has(pa.chunked_array([names])).to_pylist() == [k % 2 == 0 for k in range(40)]
