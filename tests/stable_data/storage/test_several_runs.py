"""Several runs as one for training: every row of each once, resumed exactly, one here and one on an object store."""

import itertools
from pathlib import Path

import pytest
from torch.utils.data import DataLoader

from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.torch_dataset import TableDataset, TableStream, collate_scenes
from tests.object_store import object_store
from tests.stable_data.storage.small_run import IDS, SCENES, ids, scene_id, split_of, stream, write, write_run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Two runs whose scenes have other names in files of the same names."""
    root = tmp_path_factory.mktemp("runs")
    return [write_run(root / "one"), write_run(root / "other", suffix="_seed7")]


ALL_IDS = [*IDS, *(f"{name}_seed7" for name in IDS)]


def test_rows_of_several_runs_come_one_run_after_the_other(runs: list[str]) -> None:
    data = TableDataset(runs, columns=["scene_id"], decode=scene_id)
    assert [data[i] for i in range(len(data))] == ALL_IDS
    assert ids(TableStream(tuple(Path(run) for run in runs))) == ALL_IDS
    assert ids(TableStream(Path(runs[0]))) == IDS
    assert len(TableDataset(runs, "features")) == 10
    chosen = [s.scene_id for s in SCENES if split_of(s) == "train" and s.scene_id >= "scene-021"]
    found = ids(TableStream(runs, split="train", where="scene_id >= 'scene-021'"))
    assert found == [*chosen, *(f"{name}_seed7" for name in chosen)]


@pytest.mark.parametrize("num_workers", [0, 2])
def test_several_runs_are_shuffled_into_each_other_and_given_once_over_the_ranks(runs: list[str], num_workers: int) -> None:
    ranks = [stream(runs, batch_size=4, collate=collate_scenes, rank=rank, world_size=3) for rank in range(3)]
    found = [ids(DataLoader(rank, batch_size=None, num_workers=num_workers)) for rank in ranks]
    assert sorted(itertools.chain(*found)) == sorted(ALL_IDS)
    assert any(0 < sum(name.endswith("_seed7") for name in names) < len(names) for names in found)


def test_a_state_of_several_runs_continues_exactly_and_with_no_others(runs: list[str]) -> None:
    whole, first = ids(stream(runs)), stream(runs)
    seen = ids(itertools.islice(first, 50))
    again = stream(runs)
    again.load_state_dict(first.state_dict())
    assert seen + ids(again) == whole
    for others in (runs[:1], runs[1:]):
        with pytest.raises(ConfigError, match="table_fingerprint"):
            stream(others).load_state_dict(first.state_dict())


def test_no_run_and_a_run_twice_are_refused_and_a_missing_one_is_named(runs: list[str], tmp_path: Path) -> None:
    for wrong in ([], [runs[0], runs[1], f"{runs[0]}/"]):
        with pytest.raises(ConfigError, match="expected at least one run and no duplicates") as caught:
            TableStream(wrong)
        assert caught.value.code == "runs_invalid"
    with pytest.raises(ConfigError, match=f"{tmp_path}.*no table scenes"):
        TableStream([*runs, str(tmp_path)])


def test_one_run_may_lie_here_and_one_on_an_object_store(runs: list[str]) -> None:
    with object_store() as uri:
        write(RunFolder(uri), suffix="_seed7")
        assert ids(TableStream([runs[0], uri])) == ALL_IDS
        assert sorted(ids(stream([runs[0], uri]))) == sorted(ALL_IDS)
