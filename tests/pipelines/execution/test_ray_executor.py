"""Shards on Ray and in this process: all done, and one that kills its worker is run item by item."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import ray
from tqdm import tqdm

from pipelines.execution import ray_executor
from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure, WorkerPool, item_limited, run_isolated
from stable_data.commands.command_line import NOT_STARTED
from stable_data.errors import ConfigError
from stable_data.limits import worker_environment
from tests.pipelines.runs import ROOT


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


class Unlucky:
    """Loses its worker once."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __call__(self, shard: int, *, isolated: bool = False) -> str:
        if not self.mark.exists():
            self.mark.touch()
            os.abort()
        return "alone" if isolated else "together"


class Sinking:
    """Takes its node with it the first time."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __call__(self, shard: int, *, isolated: bool = False) -> str:
        if not self.mark.exists():
            self.mark.touch()
            os.kill(os.getppid(), signal.SIGKILL)  # the raylet
            os.abort()
        return f"{shard} {'alone' if isolated else 'together'}"


class Doomed:
    """Dies over one shard however it is run."""

    def __call__(self, shard: int, *, isolated: bool = False) -> int:
        if shard == 7:
            os.abort()
        return shard


class Slow:
    """Hangs over one shard unless its items are run alone, and is busy for longer than the limit after an item of another one."""

    def __call__(self, shard: int, *, isolated: bool = False) -> str:
        with item_limited(5.0):  # an item that does nothing may take a second on a busy machine
            if shard == 2 and not isolated:
                time.sleep(600)
        time.sleep(6.0 if shard == 0 else 0.0)
        return f"{shard} {'alone' if isolated else 'together'}"


class Odd:
    def __call__(self, shard: int, *, isolated: bool = False) -> int:
        raise KeyError(shard)


class _Remote:
    """A task that is never run."""

    def remote(self, *_: object) -> object:
        return object()


def test_this_process_gives_results_in_order() -> None:
    assert list(WorkerPool().run(Double(), [1, 2, 3])) == [2, 4, 6]


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_does_every_shard_once() -> None:
    assert sorted(WorkerPool(2).run(Double(), list(range(12)))) == list(range(0, 24, 2))


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_an_error_of_the_run_itself_comes_back_as_it_is() -> None:
    with pytest.raises(ConfigError, match="the disk is full") as caught:
        list(WorkerPool(1).run(Double(), [1, 13]))
    assert caught.value.code == "output_unwritable"


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_a_shard_that_kills_its_worker_is_run_again_alone() -> None:
    assert sorted(WorkerPool(2).run(Hostile(), [0, 1, 2])) == ["0 together", "1 alone", "2 together"]


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_a_first_death_may_have_come_from_outside(tmp_path: Path) -> None:
    assert list(WorkerPool(1).run(Unlucky(tmp_path / "mark"), [0])) == ["together"]


def test_nodes_that_are_lost_again_and_again_are_borne_for_longer_but_not_for_ever() -> None:
    lost, attempt = ray.exceptions.NodeDiedError("taken"), ray_executor._Attempt(7)
    assert [attempt.is_given_up(lost) for _ in range(ray_executor._MAX_NODES)] == [False] * (ray_executor._MAX_NODES - 1) + [
        True
    ]
    assert attempt.deaths == 0
    assert ray_executor._MAX_NODES > ray_executor._MAX_DEATHS


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_a_shard_that_loses_every_worker_is_named_once_the_rest_is_done() -> None:
    results = WorkerPool(1).run(Doomed(), [7, 8, 9])
    assert sorted(islice(results, 2)) == [8, 9]
    with pytest.raises(
        ConfigError, match=r"1 of 3 shards were lost, each with 4 workers .*: 7 \(WorkerCrashedError\)"
    ) as caught:
        next(results)
    assert caught.value.code == "worker_lost"


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_an_item_that_takes_too_long_ends_its_worker_alone() -> None:
    began = time.monotonic()
    assert sorted(WorkerPool(2).run(Slow(), [0, 1, 2, 3])) == ["0 together", "1 together", "2 alone", "3 together"]
    assert time.monotonic() - began < 60


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_what_nobody_foresaw_in_a_task_is_one_line() -> None:
    with pytest.raises(ConfigError, match="5: KeyError: 5; please report this") as caught:
        list(WorkerPool(1).run(Odd(), [5]))
    assert "\n" not in str(caught.value)


def test_ray_that_stops_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: Any, **__: Any) -> Any:
        raise ray.exceptions.RaySystemError("the object store is gone\nat some place")

    run = object.__new__(ray_executor._RayRun)
    run.__dict__ |= {
        "_workers": WorkerPool(1),
        "_shards": [1],
        "_connected": False,
        "_empty_since": None,
        "_work": None,
        "_task": _Remote(),
    }
    monkeypatch.setattr(ray, "wait", stopped)
    with pytest.raises(ConfigError, match=r"Ray stopped \(RaySystemError: .*run again") as caught:
        list(run.results())
    assert "\n" not in str(caught.value)


HEADLESS = """
import time
import ray
from pipelines.execution import ray_executor

class Long:
    def __call__(self, shard, *, isolated=False):
        time.sleep(600 * shard)

ray_executor._HEAD_SECONDS = 3.0
results = ray_executor.WorkerPool(1).run(Long(), [0, 1])
next(results)
ray._private.worker._global_node.kill_gcs_server()
next(results)
"""


@pytest.mark.ray
@pytest.mark.slow
def test_a_head_that_is_lost_is_one_line_and_the_status_of_a_job_that_stopped() -> None:
    done = subprocess.run([sys.executable, "-c", HEADLESS], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == NOT_STARTED, done.stderr  # Ray itself ends a process with status 1
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert re.fullmatch(r"error: Ray's head at \S+ is lost .*; start the cluster again and run again: .*", lines[0])


@pytest.mark.ray
def test_ray_that_does_not_start_in_time_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def late(**_: Any) -> Any:
        raise Exception("The current node timed out during startup.")

    monkeypatch.setattr(ray, "init", late)
    with pytest.raises(ConfigError, match=r"Ray at this machine cannot be reached \(The current node timed out"):
        ray_executor.connect(WorkerPool(1))


def test_a_cluster_gets_as_many_shards_as_it_has_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 64.0})
    run = object.__new__(ray_executor._RayRun)
    for workers, width in ((WorkerPool(0, "auto"), 128), (WorkerPool(5, "auto"), 5), (WorkerPool(2), 4)):
        run.__dict__ |= {"_workers": workers}
        assert run._width() == width
    monkeypatch.setattr(ray, "cluster_resources", dict)  # nodes are still to come
    run.__dict__ |= {"_workers": WorkerPool(0, "auto")}
    assert run._width() == 1


def test_a_cluster_gets_the_checkout_and_the_limits_unless_a_job_brought_it(monkeypatch: pytest.MonkeyPatch) -> None:
    shipped = ray_executor._runtime()
    assert shipped is not None
    assert shipped["env_vars"] == worker_environment()
    assert (Path(shipped["working_dir"]) / "pipelines" / "execution" / "ray_executor.py").is_file()
    monkeypatch.setenv("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")
    assert ray_executor._runtime() is None


@pytest.mark.ray
@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "nowhere"])
def test_a_cluster_that_is_not_there_is_an_error_of_one_line(address: str) -> None:
    with pytest.raises(ConfigError, match="cannot be reached"):
        list(WorkerPool(1, address=address).run(Double(), [1]))


@pytest.mark.ray
def test_a_cluster_that_wants_a_token_says_how_to_show_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(**_: Any) -> Any:
        raise ConnectionError("Failed to connect") from RuntimeError("RPC error: InvalidAuthToken: missing or incorrect")

    monkeypatch.setattr(ray, "init", refused)
    with pytest.raises(
        ConfigError, match=r"cannot be reached \(Failed to connect\); it requires a token: set RAY_AUTH_MODE=token"
    ):
        ray_executor.connect(WorkerPool(1, address="auto"))


def test_an_item_alone_gives_its_result() -> None:
    assert run_isolated(abs, -3, seconds=60) == 3


def test_an_item_alone_that_dies_says_so() -> None:
    assert run_isolated(os.abort, seconds=60) is ProcessFailure.CRASHED


def test_an_item_alone_that_hangs_is_stopped_and_says_so() -> None:
    began = time.monotonic()
    assert run_isolated(time.sleep, 300, seconds=1) is ProcessFailure.TIMED_OUT
    assert time.monotonic() - began < 60


def test_the_clock_of_an_item_alone_starts_once_it_is_prepared() -> None:
    assert run_isolated(abs, -3, seconds=1, prepare=partial(time.sleep, 2)) == 3


def test_an_error_of_an_item_alone_comes_back() -> None:
    with pytest.raises(ValueError, match="invalid literal"):
        run_isolated(int, "x", seconds=60)


def test_one_process_serves_until_a_call_ends_it() -> None:
    with IsolatedProcess() as apart:
        first, second = (apart.call(os.getpid, seconds=60) for _ in range(2))
        assert first == second != os.getpid()
        assert apart.call(os.abort, seconds=60) is ProcessFailure.CRASHED
        assert apart.call(os.getpid, seconds=60) not in (first, os.getpid())
        assert apart.call(time.sleep, 300, seconds=1) is ProcessFailure.TIMED_OUT
        assert apart.call(abs, -3, seconds=60) == 3


def test_time_is_limited_in_workers_alone() -> None:
    with item_limited(0.01):
        time.sleep(0.05)


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A cluster whose head runs no shard; a node that is lost is known to be so within two seconds."""
    from ray.cluster_utils import Cluster

    quick = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 300, "health_check_failure_threshold": 4}
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "_system_config": quick})
    yield nodes
    ray.shutdown()
    nodes.shutdown()


@pytest.mark.slow
@pytest.mark.ray
def test_a_local_run_leaves_a_cluster_of_the_same_machine_alone(cluster: Any) -> None:
    assert list(WorkerPool(1).run(Double(), [1])) == [2]  # the head there has no core


@pytest.mark.ray
@pytest.mark.slow
def test_a_node_that_is_lost_does_not_count_against_its_shard(cluster: Any, tmp_path: Path) -> None:
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    found = WorkerPool(2, cluster.address).run(Sinking(tmp_path / "mark"), [0, 1, 2])
    assert sorted(found) == ["0 together", "1 together", "2 together"]


@pytest.mark.slow
@pytest.mark.ray
def test_a_cluster_without_any_node_is_waited_for_and_given_up_in_the_end(
    cluster: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def write(message: str, **_: Any) -> None:
        said.append(message)
        if len(said) == 2:
            cluster.add_node()

    monkeypatch.setattr(tqdm, "write", write)
    monkeypatch.setattr(ray_executor, "_LOOK_SECONDS", 0.2)
    monkeypatch.setattr(ray_executor, "_PATIENCE_SECONDS", 1.2)
    with pytest.raises(ConfigError, match=r"had no core for 0\.02 min, expected at least one; .*run again") as caught:
        list(WorkerPool(1, cluster.address).run(Double(), [1]))
    assert caught.value.code == "cluster_empty"
    monkeypatch.setattr(ray_executor, "_PATIENCE_SECONDS", 120.0)
    assert sorted(WorkerPool(0, cluster.address).run(Double(), [1, 2, 3])) == [2, 4, 6]
    assert said[1] == "the cluster has no core at the moment; waiting for a node, up to 2 min"


@pytest.mark.slow
@pytest.mark.ray
def test_a_lost_node_that_ray_does_not_notice_ends_the_run_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a jump of the head's clock, by which Ray times its health checks."""
    from ray.cluster_utils import Cluster

    never = {"health_check_initial_delay_ms": 10**8}
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "_system_config": never})
    try:
        nodes.add_node(num_cpus=1)
        monkeypatch.setattr(ray_executor, "_LOOK_SECONDS", 0.5)
        monkeypatch.setattr(ray_executor, "_SILENT_SECONDS", 3.0)
        with pytest.raises(ConfigError, match=r"which has not answered for 0\.05 min; .*Start the cluster again") as caught:
            list(WorkerPool(1, nodes.address).run(Sinking(tmp_path / "mark"), [0]))
        assert caught.value.code == "node_silent"
    finally:
        ray.shutdown()
        nodes.shutdown()
