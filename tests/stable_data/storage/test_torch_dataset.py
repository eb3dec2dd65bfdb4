"""Tables as torch datasets: every row once, in an order that can be resumed."""

import itertools
import pickle
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from stable_data.errors import ConfigError
from stable_data.storage import epoch_shuffle, row_groups
from stable_data.storage.epoch_shuffle import EpochOrder
from stable_data.storage.row_groups import RowGroup, rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import arrow_table, scene_from_row
from stable_data.storage.torch_dataset import TableDataset, TableStream, collate_scenes
from tests.object_store import object_store
from tests.stable_data.storage.small_run import IDS, NUM_ROWS, SCENES, ids, scene_id, split_of, stream, write, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_run(tmp_path_factory.mktemp("run") / "run")


# By index


def test_scenes_come_by_index(run: str) -> None:
    data = TableDataset(run)
    assert len(data) == NUM_ROWS
    assert [data[i] for i in range(NUM_ROWS)] == SCENES
    assert data[-1] == SCENES[-1]
    assert data[0].source is None
    assert TableDataset(run, decode=scene_from_row)[3].source == {"n": 3}
    for index in (NUM_ROWS, -NUM_ROWS - 1):
        with pytest.raises(IndexError, match=f"of {NUM_ROWS}"):
            data[index]


@given(st.lists(st.integers(-NUM_ROWS, NUM_ROWS - 1), max_size=12))
@settings(max_examples=25, deadline=None)
def test_a_batch_by_index_is_its_items(run: str, indices: list[int]) -> None:
    assert TableDataset(run, cache_bytes=0).__getitems__(indices) == [SCENES[i] for i in indices]


def test_only_as_many_row_groups_are_kept_as_fit(run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: Counter[int] = Counter()
    read = row_groups.TableFiles.read

    def count(self: row_groups.TableFiles, groups: list[int], **options: Any) -> Any:
        reads.update(groups)
        return read(self, groups, **options)

    monkeypatch.setattr(row_groups.TableFiles, "read", count)
    roomy, tight = TableDataset(run), TableDataset(run, cache_bytes=0)
    for _ in range(2):
        assert [roomy[0], roomy[10], roomy[1]] == [SCENES[0], SCENES[10], SCENES[1]]
    assert set(reads.values()) == {1}
    reads.clear()
    assert [tight[i] for i in (0, 1, 10, 11, 2)] == [SCENES[i] for i in (0, 1, 10, 11, 2)]
    assert reads == {0: 2, 2: 1}
    assert len(tight._cache) == 1


def test_columns_give_rows(run: str) -> None:
    assert TableDataset(run, columns=["scene_id", "oc"])[4] == {"scene_id": "scene-004", "oc": 0.0}
    assert TableDataset(run, columns=["scene_id"], decode=scene_id)[4] == "scene-004"
    assert set(TableDataset(run, decode=dict)[0]) == set(SCHEMAS["scenes"].names)


def test_clouds_and_features_come_as_arrays_that_torch_takes(run: str) -> None:
    row = TableDataset(run, "features")[2]
    assert isinstance(row["feature"], np.ndarray)
    assert row["log_extents"] == [0.0, 1.0, 2.0]
    [batch] = DataLoader(TableDataset(run, "features", columns=["asset_id", "feature"]), batch_size=5)
    assert torch.equal(batch["feature"], torch.arange(5.0)[:, None].expand(5, 64))


def test_arrays_may_be_null_or_empty() -> None:
    blank = dict.fromkeys(SCHEMAS["features"].names)
    table = arrow_table("features", [blank | {"feature": feature} for feature in ([1.0, 2.0], None, [], [3.0])])
    found = [row["feature"] for row in rows_from_table(table.slice(1))]
    assert found[0] is None
    assert [f.tolist() for f in found[1:]] == [[], [3.0]]


def test_a_table_that_is_not_there_is_refused(run: str) -> None:
    for kind in (TableDataset, TableStream):
        with pytest.raises(ConfigError, match="no table samples") as caught:
            kind(run, "samples")
        assert caught.value.code == "table_missing"
        with pytest.raises(ConfigError, match=r"no columns \['scale'\], expected some of scene_id") as caught:
            kind(run, columns=["scene_id", "scale"])
        assert caught.value.code == "column_unknown"


def test_a_shard_of_another_version_is_refused_wherever_it_lies(tmp_path: Path) -> None:
    folder = RunFolder(str(tmp_path))
    write(folder)
    path = folder.files("scenes")[2]
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({"stable_data.version": "0"}), path)
    with pytest.raises(ConfigError, match="written as table version 0"):
        TableStream(folder.uri)


def test_a_shard_that_breaks_or_goes_is_named(tmp_path: Path) -> None:
    folder = RunFolder(str(tmp_path))
    write(folder)
    stream, path = TableStream(folder.uri), Path(folder.files("scenes")[-1])
    path.unlink()
    with pytest.raises(ConfigError, match=rf"{path.name} cannot be read"):
        list(stream)
    path.write_bytes(b"PAR1 no more")
    with pytest.raises(ConfigError, match=rf"{path.name} cannot be read") as caught:
        TableStream(folder.uri)
    assert caught.value.code == "shard_unreadable"


# As a stream


def test_without_a_seed_the_order_is_that_of_the_files(run: str) -> None:
    assert list(TableStream(run)) == SCENES
    assert ids(TableStream(run, batch_size=4)) == IDS


@given(
    seed=st.none() | st.integers(0, 9),
    epoch=st.integers(0, 3),
    batch_size=st.none() | st.integers(1, 11),
    window_rows=st.sampled_from([1, 10, 100]),
    world_size=st.integers(1, 5),
    drop=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_every_row_is_given_once_over_the_ranks(
    run: str, seed: int | None, epoch: int, batch_size: int | None, window_rows: int, world_size: int, drop: bool
) -> None:
    assume(not drop or world_size * (batch_size or 1) <= NUM_ROWS)
    shares = []
    for rank in range(world_size):
        part = TableStream(
            run,
            shuffle_seed=seed,
            batch_size=batch_size,
            window_rows=window_rows,
            rank=rank,
            world_size=world_size,
            drop_remainder=drop,
        )
        part.set_epoch(epoch)
        items = list(part)
        assert len(items) == len(part)
        assert len(ids(items)) == part.num_rows
        if batch_size:
            assert all(len(batch) == batch_size for batch in (items if drop else items[:-1]))
        shares.append(ids(items))
    seen, sizes = [name for share in shares for name in share], [len(share) for share in shares]
    assert len(set(seen)) == len(seen)
    assert max(sizes) - min(sizes) <= (0 if drop else 1)
    assert (NUM_ROWS - len(seen) < world_size * (batch_size or 1)) if drop else (sorted(seen) == IDS)


def test_epochs_differ_and_repeat(run: str) -> None:
    one = stream(run)
    first, again = ids(one), ids(one)
    one.set_epoch(1)
    second = ids(one)
    assert first == again != second
    assert sorted(first) == sorted(second) == IDS
    assert ids(stream(run, shuffle_seed=6)) != first


def test_rows_of_a_shard_do_not_stay_together(run: str) -> None:
    order = ids(stream(run, window_rows=100))
    neighbours = [abs(int(a[-3:]) - int(b[-3:])) for a, b in itertools.pairwise(order)]
    assert np.mean(neighbours) > NUM_ROWS / 5  # of a random order: a third


def test_a_window_is_bounded_by_rows_and_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    groups = [RowGroup(0, "f", i, 10, 100) for i in range(20)] + [RowGroup(0, "f", 20, 500, 100)]
    windows = list(EpochOrder(groups, 0, 35).windows(0))
    assert sorted(g for window in windows for g in window.groups) == list(range(21))
    assert all(w.stop - w.start <= 35 or len(w.groups) == 1 for w in windows)
    assert [w.start for w in windows] == [0, *[w.stop for w in windows[:-1]]]
    monkeypatch.setattr(epoch_shuffle, "_WINDOW_BYTES", 250)
    assert max(len(w.groups) for w in EpochOrder(groups, 0, 10**6).windows(0)) == 2


@pytest.mark.parametrize("num_workers", [1, 2])
def test_batches_do_not_depend_on_the_number_of_workers(run: str, num_workers: int) -> None:
    one = stream(run, batch_size=4, collate=collate_scenes)
    loader = DataLoader(one, batch_size=None, num_workers=num_workers)
    assert len(loader) == len(one)
    assert ids(loader) == ids(stream(run, batch_size=4))
    assert ids(DataLoader(stream(run, decode=None), batch_size=3, num_workers=num_workers, collate_fn=list)) != []


def test_a_loader_that_batches_by_itself_gives_every_row_once(run: str) -> None:
    loader = DataLoader(stream(run), batch_size=5, num_workers=2, collate_fn=collate_scenes)
    assert sorted(ids(loader)) == IDS


def test_workers_that_stay_see_the_next_epoch(run: str) -> None:
    one = stream(run, batch_size=4, collate=collate_scenes)
    loader = DataLoader(one, batch_size=None, num_workers=2, persistent_workers=True)
    expected = stream(run)
    for epoch in (0, 3):
        one.set_epoch(epoch)
        expected.set_epoch(epoch)
        assert ids(loader) == ids(expected)
    one.resume_from(8)
    assert ids(loader) == ids(expected)[8:]


def test_datasets_travel_to_spawned_workers(run: str) -> None:
    data = TableDataset(run)
    data[0]
    copy = pickle.loads(pickle.dumps(data))
    assert not copy._cache
    assert copy[8] == SCENES[8]
    assert pickle.loads(pickle.dumps(TableDataset(run, decode=scene_id)))[8] == "scene-008"
    assert ids(pickle.loads(pickle.dumps(stream(run, batch_size=4, collate=collate_scenes)))) == ids(stream(run))
    assert ids(DataLoader(data, batch_size=8, num_workers=1, collate_fn=collate_scenes)) == IDS


@given(
    seen=st.integers(0, NUM_ROWS),
    batch_size=st.none() | st.integers(1, 9),
    rank=st.integers(0, 1),
    drop=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_a_saved_state_continues_exactly(run: str, seen: int, batch_size: int | None, rank: int, drop: bool) -> None:
    options: dict[str, Any] = {"batch_size": batch_size, "rank": rank, "world_size": 2, "drop_remainder": drop}
    one = stream(run, **options)
    one.set_epoch(2)
    whole = ids(one)
    iterator: Iterator[Any] = iter(one)
    before = list(itertools.islice(iterator, seen))
    other = stream(run, **options)
    other.load_state_dict(pickle.loads(pickle.dumps(one.state_dict() if seen else other.state_dict() | {"epoch": 2})))
    assert other.epoch == 2
    assert ids(before) + ids(other) == whole
    assert ids(other) == whole  # the iteration after that is a whole one


def test_a_state_saved_after_an_epoch_leaves_nothing_of_it(run: str) -> None:
    one = stream(run, batch_size=4)
    list(one)
    other = stream(run, batch_size=4)
    other.load_state_dict(one.state_dict())
    assert ids(other) == []
    other.load_state_dict(one.state_dict())
    other.set_epoch(1)
    assert sorted(ids(other)) == IDS


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_row_count_continues_exactly_with_any_number_of_workers(run: str, num_workers: int) -> None:
    whole = ids(stream(run, batch_size=4))
    one = stream(run, batch_size=4)
    one.resume_from(12)
    assert ids(DataLoader(one, batch_size=None, num_workers=num_workers)) == whole[12:]
    one.set_epoch(1)
    assert len(ids(one)) == NUM_ROWS
    with pytest.raises(ConfigError, match=f"expected 0 to {NUM_ROWS}"):
        one.resume_from(NUM_ROWS + 1)


class StatePerBatch(TableStream):
    """What torchdata's loader does: each worker hands its state over with every batch."""

    def __iter__(self) -> Iterator[Any]:
        for batch in super().__iter__():
            worker = torch.utils.data.get_worker_info()
            assert worker is not None
            yield worker.id, batch, self.state_dict()


class ResumedWorkers(TableStream):
    """Each worker continues from its own saved state."""

    states: dict[int, dict[str, Any]]

    def __iter__(self) -> Iterator[Any]:
        worker = torch.utils.data.get_worker_info()
        assert worker is not None
        if worker.id in self.states:
            self.load_state_dict(self.states[worker.id])
        yield from super().__iter__()


@pytest.mark.parametrize("seen", [2, 3, 6])
def test_the_states_of_workers_continue_exactly(run: str, seen: int) -> None:
    options: dict[str, Any] = {"batch_size": 4, "shuffle_seed": 5, "window_rows": 10}
    loader = DataLoader(StatePerBatch(run, **options), batch_size=None, num_workers=2)
    taken = list(itertools.islice(loader, seen))
    resumed = ResumedWorkers(run, **options)
    resumed.states = {worker: state for worker, _, state in taken}
    rest = ids(DataLoader(resumed, batch_size=None, num_workers=2))
    before = ids(batch for _, batch, _ in taken)
    whole = ids(stream(run, batch_size=4))
    assert before == whole[: 4 * seen]
    assert sorted(before + rest) == IDS
    alone = stream(run, batch_size=4)
    alone.load_state_dict(resumed.states[0])
    with pytest.raises(ConfigError, match="num_workers: 2 -> 1"):
        next(iter(alone))


@pytest.mark.parametrize(
    "change", [{"shuffle_seed": 6}, {"batch_size": 3}, {"window_rows": 9}, {"world_size": 2}, {"drop_remainder": True}]
)
def test_a_state_of_other_settings_is_refused(run: str, change: dict[str, Any]) -> None:
    [key] = change
    with pytest.raises(ConfigError, match=f"{key}: .* -> {change[key]}") as caught:
        stream(run, **change).load_state_dict(stream(run).state_dict())
    assert caught.value.code == "resume_changed"


def test_a_state_of_another_table_is_refused(run: str) -> None:
    with pytest.raises(ConfigError, match="table_fingerprint"):
        stream(run, table="features").load_state_dict(stream(run).state_dict())


@pytest.mark.parametrize(
    "wrong", [{"batch_size": 0}, {"shuffle_seed": -1}, {"window_rows": 0}, {"rank": 2, "world_size": 2}, {"rank": -1}]
)
def test_a_setting_that_cannot_be_is_refused(run: str, wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(wrong))} is .* expected") as caught:
        stream(run, **wrong)
    assert caught.value.code == "setting_invalid"


# One split


@pytest.mark.parametrize("name", ["train", "validation", "unseen"])
def test_a_split_is_its_rows_alone(run: str, name: str) -> None:
    expected = [s for s in SCENES if split_of(s) == name]
    assert list(TableStream(run, split=name)) == expected
    data = TableDataset(run, split=name)
    assert [data[i] for i in range(len(data))] == expected
    assert data[-1] == expected[-1]
    parts = [stream(run, split=name, batch_size=3, collate=collate_scenes, rank=rank, world_size=2) for rank in range(2)]
    assert sorted(one for part in parts for one in ids(part)) == [s.scene_id for s in expected]


def test_rows_of_other_splits_are_not_made_into_anything(run: str) -> None:
    decoded: list[str] = []

    def decode(row: Row) -> str:
        decoded.append(row["split"])
        return scene_id(row)

    list(stream(run, split="validation", columns=["scene_id", "split"], decode=decode))
    assert set(decoded) == {"validation"}
    assert len(decoded) == sum(split_of(s) == "validation" for s in SCENES)


def test_a_condition_gives_its_rows_alone(run: str) -> None:
    where = "scene_id >= 'scene-010' and scene_id != 'scene-012'"
    expected = [s for s in SCENES if s.scene_id >= "scene-010" and s.scene_id != "scene-012"]
    assert list(TableStream(run, where=where)) == expected
    data = TableDataset(run, where=where)
    assert [data[i] for i in range(len(data))] == expected
    both = TableStream(run, split="train", where=where)
    assert list(both) == [s for s in expected if split_of(s) == "train"]
    parts = [stream(run, where=where, batch_size=3, collate=collate_scenes, rank=rank, world_size=2) for rank in range(2)]
    assert sorted(one for part in parts for one in ids(part)) == [s.scene_id for s in expected]
    either = TableStream(run, split="unseen", where="scene_id < 'scene-004' or scene_id > 'scene-007'")
    assert [s.scene_id for s in either] == ["scene-000", "scene-008"]


def test_what_statistics_rule_out_is_not_opened(run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[int] = []
    look = row_groups._row_group

    def count(run: int, path: str, file: Any, index: int, *rest: Any) -> RowGroup:
        opened.append(index)
        return look(run, path, file, index, *rest)

    monkeypatch.setattr(row_groups, "_row_group", count)
    last = IDS[-1]
    assert [s.scene_id for s in TableStream(run, where=f"scene_id == '{last}'")] == [last]
    assert len(opened) == 1


def test_a_condition_resumes_and_is_not_another(run: str) -> None:
    one = stream(run, where="scene_id > 'scene-005'", batch_size=4)
    whole = ids(one)
    one.resume_from(8)
    assert ids(one) == whole[8:]
    with pytest.raises(ConfigError, match="where: scene_id > 'scene-005' -> None"):
        stream(run, batch_size=4).load_state_dict(one.state_dict())
    with pytest.raises(ConfigError, match="names steady, expected"):
        TableStream(run, where="steady > 1")
    with pytest.raises(ConfigError, match="0 rows where"):
        TableStream(run, where="scene_id == 'x'")


def test_a_split_resumes_as_the_whole_does(run: str) -> None:
    one = stream(run, split="train", batch_size=4)
    whole = ids(one)
    one.resume_from(8)
    assert ids(one) == whole[8:]
    with pytest.raises(ConfigError, match="split: train -> validation"):
        stream(run, split="validation", batch_size=4).load_state_dict(one.state_dict())


@pytest.mark.parametrize(
    ("table", "split", "message"),
    [
        ("scenes", "val", "split is 'val', expected one of train, validation, test, unseen"),
        ("features", "train", "table features has no splits"),
    ],
)
def test_a_split_that_is_not_there_is_refused(run: str, table: str, split: str, message: str) -> None:
    for kind in (TableDataset, TableStream):
        with pytest.raises(ConfigError, match=message) as caught:
            kind(run, table, split=split)
        assert caught.value.code == "split_unknown"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"split": "test"}, "has 0 rows of split test, expected at least 1"),
        ({"batch_size": 64, "drop_remainder": True}, f"has {NUM_ROWS} rows, expected at least 64, .* times batch_size 64"),
        ({"batch_size": 20, "world_size": 2, "drop_remainder": True}, "expected at least 40"),
        ({"world_size": 38}, "expected at least 38, world_size 38"),
    ],
)
def test_a_stream_that_would_give_nothing_is_refused(run: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        stream(run, **options)
    assert caught.value.code == "too_few_rows"
    assert len(stream(run, batch_size=64)) == 1  # one batch that is not whole is still one


def test_an_object_store_streams_the_same(run: str) -> None:
    with object_store() as uri:
        write(RunFolder(uri))
        assert [TableDataset(uri)[i] for i in (0, 20)] == [SCENES[0], SCENES[20]]
        remote = stream(uri, batch_size=4, collate=collate_scenes)
        expected = ids(stream(run))
        assert ids(remote) == expected
        assert ids(DataLoader(remote, batch_size=None, num_workers=1, multiprocessing_context="spawn")) == expected
