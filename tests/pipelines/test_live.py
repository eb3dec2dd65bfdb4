"""Live progress: where the items of a run are, told by its workers and seen by whoever waits."""

import json
import logging
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import ray

from models.semantic_reasoner.engines import EngineSettings
from models.semantic_reasoner.staged import LayoutTask
from pipelines import live
from pipelines.asset_shelf import AssetShelf
from pipelines.engine_pool import engine_pool
from pipelines.generate import generate
from pipelines.generate_settings import GenerateSettings
from pipelines.generate_step import GenerateWork
from pipelines.generate_tasks import Tasks
from pipelines.live import LiveBar, OwnTally, SharedTally, Telling, Where
from pipelines.runner import Workers
from pipelines.scene_work import SceneShard
from stable_data.errors import ConfigError
from stable_data.scene import Tabletop
from tests.pipelines.runs import content
from tests.pipelines.scripts import one_thing_a_stage

DESK = Tabletop("office_table", (1.2, 0.6))
TASKS = tuple(LayoutTask(f"task_{k}", said, DESK) for k, said in enumerate(("Lift it.", "Turn it.")))


@pytest.fixture
def own_ray() -> Iterator[None]:
    ray.init(address="local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    yield
    ray.shutdown()


@pytest.fixture
def settings(dataset: Path, own_cache: None, tmp_path: Path) -> GenerateSettings:
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetShelf([str(dataset)]).libraries[0].assets[1:4])))
    return GenerateSettings(EngineSettings(f"scripted:{script}"), weights="none", num_pictures=0)


def test_a_tally_adds_up_what_is_told_last_of_each_shard() -> None:
    tally = OwnTally()
    tally.note("a", {"waiting": 3})
    tally.note("b", {"waiting": 1, "done": 2})
    tally.note("a", {"waiting": 1, "done": 2})
    assert tally.total() == {"waiting": 2, "done": 4}
    tally.note("b", {})
    assert tally.total() == {"waiting": 1, "done": 2}


def test_a_shard_is_told_of_now_and_then_and_its_end_always() -> None:
    tally = OwnTally()
    with Telling(tally, "a") as tell:
        tell(waiting=2)
        tell(waiting=1)  # a moment later
        assert tally.total() == {"waiting": 2}
        tell(at_once=True, waiting=1)
        assert tally.total() == {"waiting": 1}
        tell._next = time.perf_counter()
        tell(waiting=0, done=2)
        assert tally.total() == {"waiting": 0, "done": 2}
    assert tally.total() == {}
    with suppress(ConfigError), Telling(tally, "a") as tell:
        tell(waiting=2)
        raise ConfigError("the shard is given up")
    assert tally.total() == {}


def test_the_bar_shows_what_is_in_place_and_where_the_rest_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(live, "_LOG_SECONDS", 0.02)
    tally = OwnTally()
    with LiveBar("generate", "scene", 10, 2, tally) as bar:
        tally.note("a", {"at_the_reasoner": 3, "at_the_corrector": 1, "to_judge": 0})
        time.sleep(0.2)
        assert re.search(r"generate: .* 2/10 .*3 at the reasoner, 1 at the corrector\]", capsys.readouterr().err)
        tally.note("a", {})
        bar.count(4, 1, 1)
        time.sleep(0.2)
    last = capsys.readouterr().err.strip().split("\r")[-1]
    assert re.search(r" 6/10 .* \d+ a minute, 75\.0 % valid, 1 shards to come\]", last)


@pytest.mark.ray
def test_workers_tell_a_tally_on_ray_and_a_lost_one_holds_nothing_up(own_ray: None) -> None:
    tally = SharedTally.started()
    tally.note("a", {"waiting": 3})
    assert tally.total() == {"waiting": 3}
    ray.kill(tally.actor)
    tally.note("a", {"waiting": 2})
    assert tally.total() == {}


@pytest.mark.ray
def test_a_run_tells_where_its_scenes_are(
    settings: GenerateSettings, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "_TELL_SECONDS", 0.0)
    for name, workers in (("here", Workers()), ("ray", Workers(1))):
        told: list[dict[str, int]] = []
        monkeypatch.setattr(live.LiveBar, "_look", lambda bar, told=told: told.extend(looks(bar)))
        generate(Tasks("tasks", list(TASKS)), str(tmp_path / name), settings, workers, [str(dataset)])
        assert {"to_begin": 2} in told  # which lasts, while the worker opens what it needs


def test_scenes_are_told_of_where_they_are(settings: GenerateSettings, dataset: Path, tmp_path: Path) -> None:
    told: list[Where] = []

    class Kept(OwnTally):
        def note(self, shard_id: str, where: Where) -> None:
            told.append(where)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "_TELL_SECONDS", 0.0)
        GenerateWork(str(tmp_path), (str(dataset),), settings, tally=Kept())(SceneShard("0" * 16, TASKS))
    assert [dict(where) for where in told[:2]] == [{"to_begin": 2}, {"at_the_reasoner": 2}]
    queues = [tuple(where.values()) for where in told if len(where) == 3]
    assert list(dict.fromkeys(queues)) == [
        (2, 0, 0),
        (1, 1, 0),
        (0, 2, 0),
        (0, 1, 1),
        (0, 0, 2),
    ]
    assert [dict(where) for where in told[-3:]] == [{"to_judge": 2}, {"to_judge": 1}, {}]


def looks(bar: LiveBar) -> Iterator[dict[str, int]]:
    """What the tally has said until the end."""
    assert bar._tally is not None
    while not bar._end.wait(0.001):
        yield bar._tally.total()


@pytest.mark.ray
def test_a_shard_over_which_workers_died_reaches_nothing_that_workers_share(
    settings: GenerateSettings, dataset: Path, tmp_path: Path, own_ray: None
) -> None:
    def done(out: str, isolated: bool) -> tuple[int, int]:
        pool = engine_pool(settings.engine, 1, 0.0, may_grow=False)
        work = GenerateWork(str(tmp_path / out), (str(dataset),), settings, pool=pool, tally=SharedTally.started())
        call = ray.remote(lambda work, shard, isolated: work(shard, isolated=isolated))
        found: tuple[int, int] = ray.get(call.remote(work, SceneShard("0" * 16, TASKS), isolated))
        return found

    assert done("alone", True) == done("together", False)
    assert content(tmp_path / "alone") == content(tmp_path / "together")
