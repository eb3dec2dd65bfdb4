"""Faults on this machine: a disk that is full, a clock that jumps, processes, and the plan of all of them."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults.plan import FaultKind, planned, spread
from benchmarks.faults.processes import below, usage_of
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


def test_a_clock_that_jumps_is_seen_by_new_processes_and_their_monotonic_clock_is_not(tmp_path: Path) -> None:
    clock = ShiftedClock(tmp_path / "clock")

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
