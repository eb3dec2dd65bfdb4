"""Faults on this machine: a disk that is full, a clock that jumps, processes, and the plan of all of them."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ray.cluster_utils import Cluster

from benchmarks.faults import nodes, shifted_clock
from benchmarks.faults.disturbed_job import _Driver
from benchmarks.faults.nodes import Nodes
from benchmarks.faults.plan import FaultKind, planned, spread
from benchmarks.faults.processes import below, children, end, kill, started, usage_of
from benchmarks.faults.shifted_clock import ShiftedClock
from benchmarks.faults.small_disk import SmallDisk
from stable_data.errors import ConfigError

CLOCKS = "import time; print(time.time(), time.time_ns() / 1e9, time.monotonic())"


def test_faults_are_of_all_kinds_and_spread_over_the_run() -> None:
    every = list(FaultKind)
    kinds = planned(every, 20, np.random.default_rng(0))
    assert kinds == planned(every, 20, np.random.default_rng(0)) != planned(every, 20, np.random.default_rng(1))
    assert {kind: kinds.count(kind) for kind in every} == {kind: 5 if kind.is_kill else 2 for kind in every}
    assert planned([FaultKind.CLOCK], 3, np.random.default_rng(0)) == [FaultKind.CLOCK]
    faults = spread(kinds, np.random.default_rng(0))
    assert [fault.kind for fault in faults] == kinds
    assert [fault.at for fault in faults] == sorted(fault.at for fault in faults)
    assert 0 <= faults[0].at < 0.2 < 0.7 < faults[-1].at < 1


def test_processes_below_one_are_found() -> None:
    assert set(below([1])) >= {1}
    assert below([0x7FFFFFF]) == {}


@pytest.mark.parametrize(
    ("code", "is_done", "words"),
    [
        ("print('3 scenes; report/index.html')", True, "no error line, but: 3 scenes; report/index.html"),
        ("raise SystemExit(1)", False, "no error line, but: "),  # as a crash, whose status is that of failed items
        ("import sys; print('error: full'); print('bye'); sys.exit(2)", False, "error: full"),
    ],
)
def test_a_driver_is_done_if_it_says_so(code: str, is_done: bool, words: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    with log.open("wb") as stream:
        driver = _Driver(started([sys.executable, "-c", code], stream), log)
    driver.process.wait()
    assert driver.is_done is is_done
    assert driver.last_words() == words
    assert not driver.kill()  # it had ended by itself: nothing was hit


def test_a_killed_driver_is_hit_and_a_started_command_ends_with_its_parent(tmp_path: Path) -> None:
    log, sleep = tmp_path / "log", "import time; time.sleep(60)"
    with log.open("wb") as stream:
        driver = _Driver(started([sys.executable, "-c", sleep], stream), log)
        assert driver.kill()
        child = f"started([sys.executable, '-c', {sleep!r}], sys.stdout.buffer)"
        code = (
            f"import sys, time; from benchmarks.faults.processes import started; print({child}.pid, flush=True); time.sleep(60)"
        )
        parent = started([sys.executable, "-c", code], stream)
    while not (words := log.read_text("utf-8").split()):
        time.sleep(0.05)
    assert kill([parent.pid]) == 1
    parent.wait()
    latest = time.monotonic() + 20
    while usage_of([int(words[0])]).processes and time.monotonic() < latest:
        time.sleep(0.05)
    assert usage_of([int(words[0])]).processes == 0


@pytest.mark.parametrize("is_blocked", [False, True])
def test_a_command_is_ended_as_ctrl_c_does_even_where_it_is_ignored(is_blocked: bool, tmp_path: Path) -> None:
    # Many short sleeps: a signal that comes just before a sleep does not end it.
    code = """if True:
        import time
        try:
            print("there", flush=True)
            for _ in range(6000):
                time.sleep(0.01)
        except KeyboardInterrupt:
            raise SystemExit(7)
    """
    log, before = tmp_path / "log", signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in the background of a shell
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT} if is_blocked else set())
    try:
        with log.open("wb") as stream:
            command = started([sys.executable, "-c", code], stream)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)
    assert children(os.getpid()) >= {command.pid}
    while "there" not in log.read_text("utf-8"):
        time.sleep(0.05)
    end(command)
    assert command.returncode == 7
    end(command)  # that has ended


@pytest.mark.ray
@pytest.mark.slow
def test_a_node_that_does_not_join_is_started_again_and_a_lost_one_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nodes, "_ABSENT_SECONDS", 0.0)
    join, failures = Cluster._wait_for_node, [2, 4]  # the first node, and another one later

    def late(self: Any, node: Any, timeout: float = 30) -> None:
        count[0] += 1
        if count[0] in failures:
            raise TimeoutError("The current node timed out during startup")
        join(self, node, timeout)

    count = [0]
    monkeypatch.setattr(Cluster, "_wait_for_node", late)
    cluster = Nodes(1)
    try:
        assert not cluster._cluster.worker_nodes
        cluster.restore()
        [node] = cluster._cluster.worker_nodes
        assert usage_of(below([nodes._raylet(node)])).processes
        folder = Path(node.get_runtime_env_dir_path())
        (folder / "unpacked").mkdir(parents=True)
        assert cluster.lose(list(below([nodes._raylet(node)])), np.random.default_rng(0))
        assert not folder.exists()
        cluster.restore()  # fails
        assert not cluster._cluster.worker_nodes
        cluster.restore()
        assert len(cluster._cluster.worker_nodes) == 1
        session = Path(node.get_session_dir_path())
        assert [path.name for path in session.glob("resources_of_node_*")] == ["resources_of_node_4"]
    finally:
        cluster.close()
    assert count == [5]
    assert not list(session.glob("resources_of_node_*"))


def test_what_processes_use_is_summed() -> None:
    mine, none = usage_of([os.getpid()]), usage_of([0x7FFFFFF])
    assert none.processes == none.handles == 0
    assert mine.processes == 1
    assert mine.threads >= 1
    assert mine.memory_mb > 10
    assert mine.handles >= 3
    both = usage_of([os.getpid(), os.getppid()])
    assert both.processes == 2
    assert both.memory_mb > mine.memory_mb


def test_a_full_disk_takes_nothing_until_it_is_freed_and_keeps_what_it_has(tmp_path: Path) -> None:
    try:
        disk = SmallDisk(tmp_path, 0.02)
    except ConfigError as error:
        pytest.skip(str(error))
    try:
        (disk.root / "there").write_bytes(bytes(5000))
        disk.fill()
        with pytest.raises(OSError, match="No space left") as caught:
            (disk.root / "more").write_bytes(bytes(50000))
        assert caught.value.errno == errno.ENOSPC
        disk.free()
        (disk.root / "more").write_bytes(bytes(50000))
    finally:
        disk.close()
    assert not (disk.root / "there").exists()
    disk = SmallDisk(tmp_path, 0.02)
    try:
        assert {path.name: path.stat().st_size for path in disk.root.glob("[mt]*")} == {"there": 5000, "more": 50000}
    finally:
        disk.close()


def test_a_clock_that_cannot_be_shifted_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for library in (tmp_path / "libfaketimeMT.so.1", ""):  # one that is not there, and none
        monkeypatch.setenv("FAKETIME_LIBRARY", str(library))
        monkeypatch.setattr(shifted_clock, "_LIBRARIES", ())
        with pytest.raises(ConfigError, match=r"the clock cannot be shifted with libfaketime \(.*\); install it"):
            ShiftedClock(tmp_path / "clock")


def test_a_clock_that_jumps_is_seen_by_new_processes_and_their_monotonic_clock_is_not(tmp_path: Path) -> None:
    try:
        clock = ShiftedClock(tmp_path / "clock")
    except ConfigError as error:
        pytest.skip(str(error))
    assert not clock.is_seen_by(os.getpid())

    def seen() -> list[float]:
        environment = os.environ | dict(clock.environment)
        done = subprocess.run([sys.executable, "-c", CLOCKS], capture_output=True, text=True, check=True, env=environment)
        return [float(word) for word in done.stdout.split()]

    before = seen()
    clock.set(-5 * 3600.0)
    after = seen()
    assert after[0] - before[0] == pytest.approx(-5 * 3600, abs=60)
    assert after[1] == pytest.approx(after[0], abs=10)
    assert 0 < after[2] - before[2] < 60
