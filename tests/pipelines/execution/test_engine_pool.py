"""Engines that workers share: placed where their GPUs are, and said in one line where there are none."""

import json
import time
from pathlib import Path
from threading import Timer

import pytest
import ray

from models.semantic_reasoner.engines.protocol import Request
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.replies.grammar import ReplyGrammar
from models.semantic_reasoner.staged_layout import LayoutTask
from pipelines.execution import engine_pool as module
from pipelines.execution.engine_pool import engine_pool
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.generation_tasks import TaskSource
from stable_data.errors import ConfigError
from stable_data.scene import Tabletop

DESK = Tabletop("office_table", (1.2, 0.6))
ONE = TaskSource("tasks", [LayoutTask("task_0", "Lift it.", DESK)])


@pytest.fixture
def settings(tmp_path: Path) -> EngineSettings:
    script = tmp_path / "script.json"
    script.write_text(json.dumps({"Lift it": "lifted"}))
    return EngineSettings(f"scripted:{script}")


def free_gpus(expected: float) -> float:
    """GPUs that nobody has, once they are as many as expected or a while has gone by: Ray tells of them a little later."""
    until = time.monotonic() + 30
    while (found := float(ray.available_resources().get("GPU", 0))) != expected and time.monotonic() < until:
        time.sleep(0.1)
    return found


@pytest.mark.ray
def test_engines_take_their_parts_of_a_gpu_and_answer(settings: EngineSettings, local_ray: None) -> None:
    assert free_gpus(1) == 1
    pool = engine_pool(settings, 2, 0.5, may_grow=False)
    assert len(pool.actors) == 2
    assert free_gpus(0) == 0
    for seed in (0, 1):  # one for each engine
        request = Request(({"role": "user", "content": "Lift it."},), ReplyGrammar.of_table(DESK), seed)
        assert [found.text for found in pool.complete([request])] == ["lifted"]


@pytest.mark.ray
def test_more_engines_than_the_gpus_have_room_for_are_refused(settings: EngineSettings, local_ray: None) -> None:
    for count, gpus, places in ((3, 0.5, 2), (2, 0.6, 1), (11, 0.1, 10), (1, 2.0, 0)):
        with pytest.raises(ConfigError, match=rf"engines={count} .* has 1, enough for {places} engines; ") as caught:
            engine_pool(settings, count, gpus, may_grow=False)
        assert caught.value.code == "engine_pool"
        assert "\n" not in str(caught.value)


@pytest.mark.ray
def test_a_cluster_is_waited_for_and_a_line_says_so(
    settings: EngineSettings, local_ray: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "_QUIET_SECONDS", 0.5)
    holder = ray.remote(num_gpus=1, num_cpus=0)(module._EngineActor).remote(settings)
    ray.get(holder.name.remote())
    frees = Timer(3.0, ray.kill, [holder])  # as where a node comes
    frees.start()
    pool = engine_pool(settings, 1, 1.0, may_grow=True)
    frees.join()
    assert pool.name == "scripted"
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("1 of 1 engines have not started; each needs 1 GPUs and the cluster has 1 in all; waiting for")


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
