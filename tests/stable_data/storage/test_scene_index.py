"""An index answers as a scan of the table does, whatever the ids, files and row groups; it is never used for other files."""

import pickle
import shutil
import struct
import tempfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stable_data as sd
from stable_data.errors import ConfigError, MissingColumnsWarning
from stable_data.storage import run_folder, scene_index
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.scene_index import SceneIndex
from stable_data.storage.schemas import SCHEMAS
from stable_data.storage.torch_dataset import TableDataset
from tests.object_store import object_store
from tests.stable_data.storage.small_run import IDS, SCENES, write, write_run


@pytest.fixture
def run(tmp_path: Path) -> str:
    return write_run(tmp_path / "run")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "stable-data" / "scene_index"


def settled_rows(names: list[str], first: int = 0) -> list[dict[str, object]]:
    blank = dict.fromkeys(SCHEMAS["settled"].names)
    pose = {"instance": "a", "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    return [
        blank | {"scene_id": name, "poses": [pose | {"position": [float(first + k), 0.0, 0.0]}]} for k, name in enumerate(names)
    ]


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_answers_are_those_of_a_scan(data: st.DataObject) -> None:
    """Several files and row groups, ids with any characters, ids that do not exist, ids that are asked for twice."""
    names = data.draw(
        st.lists(st.text(st.characters(exclude_categories=["Cs"]), max_size=40), min_size=1, max_size=40, unique=True)
    )
    cuts = sorted(data.draw(st.lists(st.integers(0, len(names)), max_size=4)))
    group = data.draw(st.integers(1, 7))
    with tempfile.TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_folder, "_GROUP_ROWS", {"settled": group})
        run = RunFolder(place)
        for number, (start, end) in enumerate(zip([0, *cuts], [*cuts, len(names)], strict=True)):
            run.write_shard("settled", f"{number:016x}", settled_rows(names[start:end], start))
        every = {row["scene_id"]: row for row in run.table("settled").to_pylist()}
        assert len(every) == len(names)
        for _ in range(2):  # made, then read from the file
            index = SceneIndex(run, "settled", Path(place) / "indexes")
            assert len(index) == len(names)
            asked = data.draw(st.lists(st.sampled_from(names), max_size=20))
            assert index.rows(asked).to_pylist() == [every[name] for name in asked]
            others = data.draw(st.lists(st.text(st.characters(exclude_categories=["Cs"]), max_size=40), max_size=5))
            assert index.unknown([*asked, *others]) == [name for name in dict.fromkeys(others) if name not in every]
            assert all((name in index) == (name in every) for name in others)
            places = index.places(asked)
            found = [
                run.read_file("settled", path).slice(number * group, group).take(rows)["scene_id"].to_pylist()
                for path, groups in places.items()
                for number, rows in groups.items()
            ]
            assert [name for part in found for name in part] == [name for name in every if name in asked]


def test_scenes_are_those_of_the_loader(run: str) -> None:
    index = sd.SceneIndex(run)
    asked = [IDS[k] for k in (30, 2, 2, 19)]
    loaded = TableDataset(run)
    assert index.scenes(asked) == [loaded[IDS.index(name)] for name in asked]
    assert [o.instance for o in index.scene(IDS[8]).objects] == [o.instance for o in SCENES[8].objects]
    assert index.rows([IDS[3]], ["split"]).column_names == ["split"]
    row = index.row(IDS[3])
    assert row is not None
    assert row["scene_id"] == IDS[3]
    assert index.row("none") is None
    assert index.scenes([]) == []
    again = pickle.loads(pickle.dumps(index))
    assert again.scenes(asked) == index.scenes(asked)
    with pytest.raises(ConfigError, match=r"has no scenes \['no', 'none'\], expected ids of its table scenes") as caught:
        index.scenes(["no", IDS[0], "none"])
    assert caught.value.code == "scene_unknown"


def test_equal_hashes_are_told_apart(run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hashes of two values: every lookup has half of the run as its candidates."""
    hashes = scene_index._hashes
    monkeypatch.setattr(scene_index, "_hashes", lambda names: hashes(names) % np.uint64(2))
    index = SceneIndex(run)
    assert [s.scene_id for s in index.scenes(IDS[::-1])] == IDS[::-1]
    assert index.unknown(["none", IDS[4], "nothing"]) == ["none", "nothing"]
    assert sum(len(rows) for groups in index.places([IDS[4], IDS[9]]).values() for rows in groups.values()) == 2


def test_an_index_of_other_files_is_made_again(run: str, cache: Path) -> None:
    index = SceneIndex(run)
    made = index.path.read_bytes()
    assert index.path.parent == cache
    before = index.path.stat().st_ino
    assert SceneIndex(run).path.stat().st_ino == before  # used as it is
    folder = RunFolder(run)
    rows = folder.table("scenes").slice(0, 1).to_pylist()
    folder.write_shard("scenes", "f" * 16, [rows[0] | {"scene_id": "added"}])
    assert index.unknown(["added"]) == ["added"]  # a snapshot
    grown = SceneIndex(run)
    assert grown.scene("added").objects == grown.scene(IDS[0]).objects
    assert grown.path.read_bytes() != made
    unread = SceneIndex(run)
    (Path(run) / "scenes" / f"part-{'f' * 16}.parquet").unlink()
    assert SceneIndex(run).unknown(["added"]) == ["added"]
    with pytest.raises(ConfigError, match="cannot be read"):
        unread.scene("added")


def test_rows_of_changed_files_are_never_taken_for_others(run: str) -> None:
    """The files of two shards change their names under an open index."""
    index = SceneIndex(run)
    one, other = (Path(run) / "scenes" / f"part-{n:016x}.parquet" for n in (0, 5))
    shutil.move(one, one.with_suffix(".aside"))
    shutil.move(other, one)
    shutil.move(one.with_suffix(".aside"), other)
    for number in (0, 5, 30, 36):
        with pytest.raises(ConfigError, match="were changed since its index was opened") as caught:
            index.scene(IDS[number])
        assert caught.value.code == "run_changed"
    assert [s.scene_id for s in SceneIndex(run).scenes(IDS)] == IDS


def test_a_damaged_or_foreign_index_is_made_again(run: str, tmp_path: Path) -> None:
    path = SceneIndex(run).path
    whole = path.read_bytes()
    other = SceneIndex(write_run(tmp_path / "other", "x")).path.read_bytes()
    swapped = bytearray(whole)
    start = scene_index._HEADER.size
    swapped[start : start + 8 * len(IDS)] = bytes(8 * len(IDS))
    numbers = bytearray(whole)
    numbers[start + 8 * len(IDS) : start + 12 * len(IDS)] = struct.pack(f"<{len(IDS)}I", *([2**32 - 1] * len(IDS)))
    for damaged in (b"", b"x", other, whole[:-8], whole + b"x", whole[:-8] + b"\xff" * 8, bytes(swapped), bytes(numbers)):
        path.write_bytes(damaged)
        index = SceneIndex(run)
        assert [s.scene_id for s in index.scenes(IDS)] == IDS
        assert index.unknown(["none"]) == ["none"]
        assert path.read_bytes() == whole


def test_a_scene_twice_is_refused_and_others_are_read(run: str) -> None:
    folder = RunFolder(run)
    rows = folder.table("scenes").slice(4, 1).to_pylist()
    folder.write_shard("scenes", "e" * 16, rows)
    index = SceneIndex(run)
    with pytest.raises(ConfigError, match=f"has 2 rows of the scene '{rows[0]['scene_id']}', expected one") as caught:
        index.scenes([IDS[1], IDS[4]])
    assert caught.value.code == "scene_twice"
    assert index.scene(IDS[1]).scene_id == IDS[1]


def test_runs_without_scenes_and_tables_without_ids(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no table scenes"):
        SceneIndex(tmp_path / "none")
    run = RunFolder(str(tmp_path / "run"))
    run.write_shard("scenes", "0" * 16, [])
    assert len(SceneIndex(run)) == 0
    assert "a" not in SceneIndex(run)
    with pytest.raises(ConfigError, match="no column scene_id"):
        SceneIndex(run, "assets")


def test_a_cache_that_cannot_be_written_costs_time_only(run: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    assert SceneIndex(run, folder=tmp_path / "file").scene(IDS[5]).scene_id == IDS[5]


def test_indexes_are_bounded(run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    size = SceneIndex(run).path.stat().st_size
    monkeypatch.setattr(scene_index, "MAX_INDEX_BYTES", 2 * size)
    for name in ("a", "b", "c"):
        SceneIndex(write_run(tmp_path / name, name))
    assert len(list(cache.iterdir())) == 2


def test_a_run_on_an_object_store(tmp_path: Path) -> None:
    with object_store() as uri:
        write(RunFolder(uri))
        index = SceneIndex(uri)
        assert [s.scene_id for s in index.scenes(IDS)] == IDS
        assert SceneIndex(uri).scene(IDS[0]).scene_id == IDS[0]
        assert index.unknown(["none"]) == ["none"]


def test_older_files_are_read_with_a_warning(run: str) -> None:
    path = Path(run) / "scenes" / f"part-{0:016x}.parquet"
    old = pq.read_table(path)
    pq.write_table(old.drop_columns(["jitter_mm"]), path)
    index = SceneIndex(run)
    with pytest.warns(MissingColumnsWarning, match="jitter_mm"):
        row = index.row(IDS[0])
    assert row is not None
    assert row["jitter_mm"] is None
    pq.write_table(old.replace_schema_metadata({"stable_data.version": "1"}), path)
    with pytest.raises(ConfigError, match="table version 1"):
        SceneIndex(run)
