"""Live progress: where the items of a run are, told by its workers and seen by whoever waits."""

import json
import os
import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import ray

from benchmarks.faults.processes import below, usage_of
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution import progress_bar
from pipelines.execution.engine_pool import engine_pool
from pipelines.execution.progress_bar import LocalTally, ProgressBar, ProgressReporter, SharedTally, Where
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_step import Shard, ShardTask, ShardWriter, WrittenShard
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import GenerateWork
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from stable_data.errors import ConfigError
from stable_data.scene import Tabletop
from tests.pipelines.runs import content
from tests.pipelines.scripts import one_thing_a_stage

DESK = Tabletop("office_table", (1.2, 0.6))
TASKS = tuple(LayoutTask(f"task_{k}", said, DESK) for k, said in enumerate(("Lift it.", "Turn it.")))


@pytest.fixture
def settings(dataset: Path, tmp_path: Path) -> GenerateSettings:
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(dataset)]).libraries[0].assets[1:4])))
    return GenerateSettings(EngineSettings(f"scripted:{script}"), weights="none", num_pictures=0)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may start the tally's actor late, and its answers are what these tests are about."""
    monkeypatch.setattr(progress_bar, "_PATIENCE_SECONDS", 120.0)


def until(is_so: Callable[[], bool]) -> None:
    """Waits for another thread or process, however slow the machine is."""
    end = time.monotonic() + 120
    while not is_so():
        assert time.monotonic() < end, "it never came"
        time.sleep(0.01)


class Kept(LocalTally):
    """Keeps all that it is told, and knows what it was asked last."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[dict[str, int]] = []
        self.asked: list[dict[str, int]] = []

    def note(self, shard_id: str, where: Where) -> None:
        self.told.append(dict(where))
        super().note(shard_id, where)

    def total(self) -> dict[str, int]:
        self.asked.append(super().total())
        return self.asked[-1]


def test_a_tally_adds_up_what_is_told_last_of_each_shard() -> None:
    tally = LocalTally()
    tally.note("a", {"propose": 3})
    tally.note("b", {"propose": 1, "judge": 2})
    tally.note("a", {"propose": 1, "judge": 2})
    assert tally.total() == {"propose": 2, "judge": 4}
    tally.note("b", {})
    assert tally.total() == {"propose": 1, "judge": 2}


def test_who_is_not_heard_of_any_more_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(progress_bar, "perf_counter", lambda: now)
    tally = LocalTally()
    tally.note("lost", {"propose": 3})
    now += 50
    tally.note("alive", {"correct": 1})
    assert tally.total() == {"propose": 3, "correct": 1}
    now += 50
    assert tally.total() == {"correct": 1}
    tally.note("lost", {"propose": 2})  # another worker has it
    assert tally.total() == {"propose": 2, "correct": 1}


def test_a_shard_is_told_of_again_and_again_and_its_end_in_any_case(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress_bar, "_REPORT_SECONDS", 0.01)
    tally = Kept()
    with ProgressReporter(tally, "a", propose=2) as tell:
        until(lambda: tally.told.count({"propose": 2}) > 2)
        tell(propose=1, judge=1)
        until(lambda: tally.told[-1] == {"propose": 1, "judge": 1})
    assert tally.told[-1] == tally.total() == {}
    with suppress(ConfigError), ProgressReporter(tally, "a", propose=2):
        until(lambda: tally.total() == {"propose": 2})
        raise ConfigError("the shard is given up")
    assert tally.total() == {}


def test_a_tally_that_is_lost_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    class Lost(LocalTally):
        def note(self, shard_id: str, where: Where) -> None:
            asked.append("note")
            raise ConnectionError("gone")

        def total(self) -> dict[str, int]:
            asked.append("total")
            raise ConnectionError("gone")

    monkeypatch.setattr(progress_bar, "_REPORT_SECONDS", 0.01)
    monkeypatch.setattr(progress_bar, "_LOG_SECONDS", 0.01)
    asked: list[str] = []
    with ProgressBar("generate", "scene", 1, 0, Lost()) as bar, ProgressReporter(Lost(), "a", propose=1):
        until(lambda: set(asked) == {"note", "total"})
        bar.count(1, 0, 0)


def test_the_bar_shows_what_is_in_place_and_where_the_rest_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress_bar, "_LOG_SECONDS", 0.01)
    tally = Kept()
    tally.note("a", {"propose": 3, "correct": 1, "judge": 0})
    with ProgressBar("generate", "scene", 10, 2, tally) as bar:
        until(lambda: len(tally.asked) > 2)  # what was heard before is shown by then
        bar.count(4, 1, 1)
        heard = len(tally.asked)
        until(lambda: len(tally.asked) > heard + 1)
        tally.note("a", {})
    shown = capsys.readouterr().err.strip().split("\r")
    assert any(re.search(r"generate: .* 2/10 scenes \[\S+<\S+, 3 propose, 1 correct\]$", line.rstrip()) for line in shown)
    so_far = r"generate: .* 6/10 scenes \[\S+<\S+, \d+/min, 75\.0 % valid; "
    assert any(re.search(so_far + r"3 propose, 1 correct; 1 shards left\]$", line.rstrip()) for line in shown)
    assert re.search(so_far + r"1 shards left\]$", shown[-1])


@pytest.mark.ray
def test_workers_tell_a_tally_on_ray_which_is_there_again_when_it_is_lost(local_ray: None) -> None:
    tally = SharedTally.started()
    tally.note("a", {"propose": 3})
    assert tally.total() == {"propose": 3}
    ray.kill(tally.actor, no_restart=False)

    def has(where: dict[str, int]) -> bool:
        with suppress(ray.exceptions.RayError):
            return tally.total() == where
        return False

    until(lambda: has({}))  # another, that has heard of nothing
    with ProgressReporter(tally, "a", propose=2):
        until(lambda: has({"propose": 2}))
    assert tally.total() == {}


@pytest.mark.slow
@pytest.mark.ray
def test_the_reports_of_a_long_run_leave_nothing_in_rays_head(local_ray: None) -> None:
    tally = SharedTally.started()
    [head] = [pid for pid, words in below([os.getpid()]).items() if "gcs_server" in words.split()[0]]

    def memory_of_head() -> float:
        for _ in range(5000):
            tally.note("a", {"propose": 3})
        tally.total()  # after all notes
        time.sleep(2)  # the head is told of calls once a second
        return usage_of([head]).memory_mb

    before = memory_of_head()
    assert memory_of_head() - before < 5  # it was 15


@pytest.mark.ray
@pytest.mark.parametrize("workers", [WorkerPool(), pytest.param(WorkerPool(1), marks=pytest.mark.slow)], ids=["here", "ray"])
@pytest.mark.usefixtures("local_ray")
def test_a_run_tells_where_its_scenes_are(
    workers: WorkerPool, settings: GenerateSettings, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dict[str, int]] = []

    def look(bar: ProgressBar) -> None:
        assert bar._tally is not None
        while not seen and not bar._end.wait(0.01):
            seen.extend(filter(None, [bar._tally.total()]))

    monkeypatch.setattr(ProgressBar, "_update", look)
    generate(TaskSource("tasks", list(TASKS)), str(tmp_path / "out"), settings, workers, [str(dataset)])
    assert sum(seen[0].values()) == 2


def test_scenes_are_told_of_where_they_are(
    settings: GenerateSettings, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queues: list[dict[str, int]] = []
    monkeypatch.setattr(ProgressReporter, "__call__", lambda _, **where: queues.append(where))
    GenerateWork((str(dataset),), settings).shard(Shard("0" * 16, TASKS))
    assert [k for n, k in enumerate(queues) if k not in queues[:n]] == [
        {"propose": 2, "correct": 0, "judge": 0},
        {"propose": 1, "correct": 1, "judge": 0},
        {"propose": 0, "correct": 2, "judge": 0},
        {"propose": 0, "correct": 1, "judge": 1},
        {"propose": 0, "correct": 0, "judge": 2},
        {"judge": 2},
        {"judge": 1},
    ]


@pytest.mark.slow
@pytest.mark.ray
def test_a_shard_over_which_workers_died_reaches_nothing_that_workers_share(
    settings: GenerateSettings, dataset: Path, tmp_path: Path, local_ray: None
) -> None:
    def done(out: str, isolated: bool) -> WrittenShard:
        with engine_pool(settings.engine, 1, 0.0, may_grow=False) as pool:
            work = GenerateWork((str(dataset),), settings, pool=pool, tally=SharedTally.started())
            call = ray.remote(lambda write, task, isolated: write(task, isolated=isolated))
            write, task = ShardWriter(str(tmp_path / out), (work,)), ShardTask(0, Shard("0" * 16, TASKS))
            found: WrittenShard = ray.get(call.remote(write, task, isolated))
            return found

    assert done("alone", True) == done("together", False)
    assert content(tmp_path / "alone") == content(tmp_path / "together")
