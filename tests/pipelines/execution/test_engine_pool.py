"""Engines that workers share: placed where their GPUs are, and said in one line where there are none."""

import json
import subprocess
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Timer

import pytest
import ray

from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.engines.registry import EMBEDDED, EngineSettings, load_engine
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution import engine_pool as module
from pipelines.execution.engine_pool import PooledEngine, engine_pool
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import TaskSource
from stable_data.errors import ConfigError
from stable_data.scene import Tabletop
from stable_data.storage.run_folder import RunFolder

DESK = Tabletop("office_table", (1.2, 0.6))
ONE = TaskSource("tasks", [LayoutTask("task_0", "Lift it.", DESK)])


@pytest.fixture
def settings(tmp_path: Path) -> EngineSettings:
    script = tmp_path / "script.json"
    script.write_text(json.dumps({"Lift it": "lifted"}))
    return EngineSettings(f"scripted:{script}")


def request(seed: int) -> Request:
    return Request(({"role": "user", "content": "Lift it."},), ReplyGrammar.of_table(DESK, at_least=4), seed)


def free_gpus(expected: float) -> float:
    """GPUs that nobody has, once they are as many as expected or a while has gone by: Ray tells of them a little later."""
    until = time.monotonic() + 30
    while (found := float(ray.available_resources().get("GPU", 0))) != expected and time.monotonic() < until:
        time.sleep(0.1)
    return found


@pytest.mark.ray
def test_engines_take_their_parts_of_a_gpu_and_answer(settings: EngineSettings, local_ray: None) -> None:
    assert free_gpus(1) == 1
    with engine_pool(settings, 2, 0.5, may_grow=False) as pool:
        assert len(pool.actors) == 2
        assert free_gpus(0) == 0
        assert [found.text for found in pool.complete([request(0), request(1)])] == ["lifted"] * 2
        assert [counts.answered for counts in pool.counts()] == [1, 1]
    assert free_gpus(1) == 1


@pytest.mark.ray
def test_more_engines_than_the_gpus_have_room_for_are_refused(settings: EngineSettings, local_ray: None) -> None:
    for count, gpus, places in ((3, 0.5, 2), (2, 0.6, 1), (11, 0.1, 10), (1, 2.0, 0)):
        pool = engine_pool(settings, count, gpus, may_grow=False)
        with pytest.raises(ConfigError, match=rf"engines={count} .* has 1, enough for {places} engines; ") as caught, pool:
            pass
        assert caught.value.code == "engine_pool"
        assert "\n" not in str(caught.value)


@pytest.mark.ray
def test_engines_and_correctors_must_have_room_together(local_ray: None) -> None:
    module.check_gpus({"engines": (1, 0.5), "correctors": (2, 0.25)})
    with pytest.raises(ConfigError, match=r"engines and correctors need 1.25 GPUs together, but this machine has 1; "):
        module.check_gpus({"engines": (1, 1.0), "correctors": (1, 0.25)})


@pytest.mark.slow
@pytest.mark.ray
def test_a_cluster_is_waited_for_and_a_line_says_so(
    settings: EngineSettings, local_ray: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "_QUIET_SECONDS", 0.5)
    holder = ray.remote(num_gpus=1, num_cpus=0)(module._EngineActor).remote(settings)
    ray.get(holder.name.remote())
    frees = Timer(3.0, ray.kill, [holder])  # as where a node comes
    frees.start()
    with engine_pool(settings, 1, 1.0, may_grow=True) as pool:
        frees.join()
        assert pool.name == "scripted"
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("1 of 1 engines have not started; each needs 1 GPUs and the cluster has 1 in all; waiting for")


def requests_of(seeds: Iterable[int]) -> list[Request]:
    return [request(seed) for seed in seeds]


ask = ray.remote(num_cpus=0)(lambda pool, requests: pool.complete(requests))  # by value: the worker imports no test


@pytest.mark.slow  # the engine's process imports torch
@pytest.mark.ray
def test_workers_that_ask_at_the_same_time_share_one_batch(tmp_path: Path, local_ray: None) -> None:
    if not (EMBEDDED / "model.safetensors").is_file():
        pytest.skip("the weights of the embedded reasoner are not in this checkout")
    settings = EngineSettings(num_slots=8)
    alone = load_engine(settings).complete(requests_of(range(6)))

    def ask_together(pool: PooledEngine, requests: list[Request]) -> list[Completion]:
        """Waits for the other worker."""
        (tmp_path / str(requests[0].seed)).touch()
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        return pool.complete(requests)

    together = ray.remote(num_cpus=0)(ask_together)
    with engine_pool(settings, 1, 0.0, may_grow=False) as pool:
        found = ray.get([together.remote(pool, requests_of(seeds)) for seeds in ([0, 1, 2], [3, 4, 5])])
        (counts,) = pool.counts()
    assert [*found[0], *found[1]] == alone
    assert counts.answered == 6
    assert counts.num_tokens > 3 * counts.num_steps  # more sequences a step than one worker has asked for


@pytest.mark.slow
def test_shared_engines_give_the_same_rows_as_an_engine_of_each_worker(dataset: Path, tmp_path: Path) -> None:
    said = ("Put the mug on the book.", "Place a pen beside the notebook.", "Move the bottle left of the mug.")
    source = TaskSource("tasks", [LayoutTask(f"task_{k}", said[k % 3], DESK) for k in range(6)])
    settings = GenerateSettings(weights="none", num_pictures=0, scenes_per_shard=3, settle=False, accept="")
    for engines in (0, 2):
        generate(source, str(tmp_path / str(engines)), replace(settings, engines=engines), WorkerPool(2), [str(dataset)])
    runs = [RunFolder(str(tmp_path / str(engines))) for engines in (0, 2)]
    for table in ("scenes", "failures", "turns"):  # in other shards, as other settings
        apart, shared = (sorted(map(str, run.table(table).to_pylist())) for run in runs)
        assert apart == shared
    assert runs[1].num_rows("turns") > 6


@pytest.fixture
def slow_engines(settings: EngineSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> EngineSettings:
    """Engines that take a while for a reply, have a process of their own, and leave a file when they are closed."""

    class SlowEngine:
        """Answers with the seed; from seed 100 on once there is a file."""

        name, repeats = "slow", False

        def __init__(self) -> None:
            self.child = subprocess.Popen(["sleep", "600"])
            (tmp_path / f"started_{self.child.pid}").touch()

        def complete(self, requests: Sequence[Request]) -> list[Completion]:
            time.sleep(0.1)
            while requests[0].seed >= 100 and not (tmp_path / "go").exists():
                time.sleep(0.01)
            return [Completion(str(r.seed)) for r in requests]

        def close(self) -> None:
            self.child.kill()
            self.child.wait()
            (tmp_path / f"closed_{self.child.pid}").touch()

    class SlowActor(module._EngineActor):
        """Defined here, so that it is sent by value."""

        def __init__(self, settings: EngineSettings) -> None:
            super().__init__(settings)
            self._engine = SlowEngine()

    monkeypatch.setattr(module, "_EngineActor", SlowActor)
    return replace(settings, num_slots=2)


@pytest.mark.ray
def test_an_actor_holds_no_more_requests_than_it_may(slow_engines: EngineSettings, local_ray: None) -> None:
    with engine_pool(slow_engines, 1, 0.0, may_grow=False) as pool:
        found = ray.get([ask.remote(pool, requests_of(range(6 * k, 6 * k + 6))) for k in range(3)])
        (counts,) = pool.counts()
    assert [int(c.text) for some in found for c in some] == list(range(18))
    assert counts.answered == 18
    assert counts.most_held == 4  # two in the batch, and two that wait for it


@pytest.mark.ray
def test_a_request_goes_to_the_actor_that_holds_the_fewest(
    slow_engines: EngineSettings, tmp_path: Path, local_ray: None
) -> None:
    with engine_pool(slow_engines, 2, 0.0, may_grow=False) as pool:
        busy = [pool.actors[0].complete.remote(request(seed)) for seed in range(100, 103)]
        while ray.get(pool.actors[0].num_free.remote()) > 1:
            time.sleep(0.01)
        pool.complete(requests_of(range(3)))
        assert [counts.answered for counts in pool.counts()] == [0, 3]
        (tmp_path / "go").touch()
        assert [c.text for c in ray.get(busy)] == ["100", "101", "102"]


@pytest.mark.ray
def test_a_killed_actor_is_restarted_and_every_request_is_answered_once(slow_engines: EngineSettings, local_ray: None) -> None:
    with engine_pool(slow_engines, 1, 0.0, may_grow=False) as pool:
        asked = ask.remote(pool, requests_of(range(12)))
        while pool.counts()[0].answered < 4:
            time.sleep(0.02)
        ray.kill(pool.actors[0], no_restart=False)
        assert [c.text for c in ray.get(asked)] == [str(seed) for seed in range(12)]
        assert pool.counts()[0].answered <= 8  # the first four were not asked again


@pytest.mark.ray
@pytest.mark.parametrize("error", [pytest.param(RuntimeError, marks=pytest.mark.slow), KeyboardInterrupt])
def test_engines_end_with_the_job_however_it_ends(
    slow_engines: EngineSettings, tmp_path: Path, local_ray: None, error: type[BaseException]
) -> None:
    with suppress(RuntimeError, KeyboardInterrupt), engine_pool(slow_engines, 2, 0.5, may_grow=False) as pool:
        ask.remote(pool, requests_of(range(6)))
        raise error
    children = [int(file.name.partition("_")[2]) for file in tmp_path.glob("closed_*")]
    assert len(children) == len(list(tmp_path.glob("started_*"))) == 2
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)
    assert free_gpus(1) == 1
    with pytest.raises(ray.exceptions.RayError):
        pool.counts()


@pytest.mark.ray
def test_a_run_that_wants_gpus_that_no_machine_has_ends_with_one_line(
    settings: EngineSettings, dataset: Path, tmp_path: Path
) -> None:
    asked = GenerateSettings(settings, weights="none", num_pictures=0, engines=1, engine_gpus=1000.0)
    with pytest.raises(
        ConfigError, match=r"^engines=1 with engine_gpus=1000 need 1000 GPUs, but this machine has \d+, "
    ) as caught:
        generate(ONE, str(tmp_path / "out"), asked, WorkerPool(1), [str(dataset)])
    assert caught.value.code == "engine_pool"
    assert not ray.is_initialized()


def test_engines_without_workers_are_refused_before_anything_is_written(settings: EngineSettings, tmp_path: Path) -> None:
    asked = GenerateSettings(settings, weights="none", num_pictures=0, engines=2)
    with pytest.raises(ConfigError, match=r"engines is 2, .* use more workers, or leave engines at 0") as caught:
        generate(ONE, str(tmp_path / "out"), asked, WorkerPool())
    assert caught.value.code == "config_invalid"
    assert not (tmp_path / "out").exists()
