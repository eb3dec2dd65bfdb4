"""Shards on Ray and in this process: all done, and one that kills its worker is run item by item."""

import os
import time
from pathlib import Path

import pytest

from pipelines.runner import Workers, alone
from stable_data.errors import ConfigError


class Double:
    def __call__(self, shard: int, *, isolated: bool = False) -> int:
        if shard == 13:
            raise ConfigError("13: the disk is full", "output_unwritable")
        return 2 * shard


class Hostile:
    """Dies unless its items are run alone."""

    def __call__(self, shard: int, *, isolated: bool = False) -> str:
        if shard == 1 and not isolated:
            os.abort()
        return f"{shard} {'alone' if isolated else 'together'}"


class Doomed:
    """Dies however it is run."""

    def __call__(self, shard: int, *, isolated: bool = False) -> int:
        os.abort()


class Slow:
    def __call__(self, shard: int, *, isolated: bool = False) -> str:
        if not isolated:
            time.sleep(600)
        return "alone"


def test_this_process_gives_results_in_order() -> None:
    assert list(Workers().run(Double(), [1, 2, 3])) == [2, 4, 6]


@pytest.mark.ray
def test_ray_does_every_shard_once() -> None:
    assert sorted(Workers(2).run(Double(), list(range(12)))) == list(range(0, 24, 2))


@pytest.mark.ray
def test_an_error_of_the_run_itself_comes_back_as_it_is() -> None:
    with pytest.raises(ConfigError, match="the disk is full") as caught:
        list(Workers(1).run(Double(), [1, 13]))
    assert caught.value.code == "output_unwritable"


@pytest.mark.ray
def test_a_shard_that_kills_its_worker_is_run_again_alone() -> None:
    assert sorted(Workers(2).run(Hostile(), [0, 1, 2])) == ["0 together", "1 alone", "2 together"]


@pytest.mark.ray
def test_a_worker_lost_twice_ends_the_run_with_one_line() -> None:
    with pytest.raises(ConfigError, match="over 7 even with its items run one by one") as caught:
        list(Workers(1).run(Doomed(), [7]))
    assert caught.value.code == "worker_lost"


@pytest.mark.ray
def test_a_shard_that_takes_too_long_is_run_again_alone() -> None:
    assert list(Workers(1, seconds_per_shard=2.0).run(Slow(), [0])) == ["alone"]


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "nowhere"])
def test_a_cluster_that_is_not_there_is_an_error_of_one_line(address: str) -> None:
    with pytest.raises(ConfigError, match="cannot be reached"):
        list(Workers(1, address=address).run(Double(), [1]))


def test_an_item_alone_gives_its_result() -> None:
    assert alone(abs, -3, seconds=60) == 3


def test_an_item_alone_that_dies_gives_nothing() -> None:
    assert alone(os.abort, seconds=60) is None


def test_an_item_alone_that_hangs_gives_nothing() -> None:
    began = time.monotonic()
    assert alone(time.sleep, 300, seconds=5) is None
    assert time.monotonic() - began < 60


def test_a_hostile_item_becomes_a_failure_and_the_rest_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines import preprocess
    from pipelines.plan import PreprocessSettings, Shard
    from stable_data.shards import RunFolder

    monkeypatch.setattr(preprocess, "alone", lambda *_, seconds: None)
    work = preprocess.PreprocessShard("nowhere", str(tmp_path), PreprocessSettings())
    work(Shard("0" * 16, scenes=("office_table_0001",)), isolated=True)
    rows = RunFolder(str(tmp_path)).table("failures").to_pylist()
    assert [(r["id"], r["code"]) for r in rows] == [("office_table_0001", "crashed")]
