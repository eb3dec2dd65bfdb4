"""The memory of an item is bounded in workers and in separate processes, and a run has one set of limits."""

import os
import sys
from pathlib import Path

import pytest

from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure, WorkerPool, _runtime
from pipelines.execution.resume import check_resume, new_manifest
from pipelines.execution.shard_step import failed_process, rows_or_failure
from stable_data.errors import ConfigError
from stable_data.limits import LIMITS, SETTING
from stable_data.storage.manifest import write_manifest
from stable_data.storage.run_folder import RunFolder
from tests.bounds import limit

MIB = 2**20
pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is bounded on Linux")


def allocate(num_bytes: int) -> int:
    return len(bytes(bytearray(num_bytes)))


def test_a_separate_process_has_the_memory_of_an_item(monkeypatch: pytest.MonkeyPatch) -> None:
    with IsolatedProcess() as apart:
        assert apart.call(allocate, 64 * MIB, seconds=60) == 64 * MIB
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={32 * MIB}")
    with IsolatedProcess() as apart:
        assert apart.call(allocate, 256 * MIB, seconds=60) is ProcessFailure.OUT_OF_MEMORY
        assert apart.call(allocate, MIB, seconds=60) == MIB


def test_the_row_of_an_item_names_what_it_exceeded() -> None:
    def make() -> dict[str, list[dict[str, object]]]:
        raise MemoryError

    found = failed_process(ProcessFailure.OUT_OF_MEMORY, "mug", 60)["failures"][0]
    here = rows_or_failure("mug", ItemProgress("mesh"), make)["failures"][0]
    for row in (found, here):
        assert row["code"] == "out_of_memory"
        assert row["message"].startswith("mug: ")
        assert f"(item.max_memory_bytes in {SETTING})" in row["message"]
    assert "seconds_per_item" in failed_process(ProcessFailure.TIMED_OUT, "mug", 60)["failures"][0]["message"]


class Hungry:
    """Allocates 256 MiB for one shard, within the limits of an item."""

    def __call__(self, shard: int, *, isolated: bool = False) -> str:
        from pipelines.execution.ray_executor import item_limited, run_isolated

        size = 256 * MIB if shard == 1 else MIB
        if isolated:
            return f"{shard} {run_isolated(allocate, size, seconds=60)}"
        with item_limited(60):
            allocate(size)
        return f"{shard} together"


@pytest.mark.ray
def test_a_worker_that_needs_more_ends_and_its_item_alone_fails() -> None:
    work = HungryWithLimits()
    assert sorted(WorkerPool(1).run(work, [0, 1])) == ["0 together", "1 out_of_memory"]


class HungryWithLimits(Hungry):
    """The same where an item has 64 MiB; the fixture's workers have the limits of the session."""

    def __call__(self, shard: int, *, isolated: bool = False) -> str:
        from dataclasses import replace

        os.environ[SETTING] = f"item.max_memory_bytes={64 * MIB}"  # of the separate process
        was = LIMITS.item
        LIMITS.item = replace(was, max_memory_bytes=64 * MIB)
        try:
            return super().__call__(shard, isolated=isolated)
        finally:
            LIMITS.item = was
            del os.environ[SETTING]


def test_workers_on_a_cluster_get_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_JOB_CONFIG_JSON_ENV_VAR", raising=False)
    monkeypatch.delenv(SETTING, raising=False)
    runtime = _runtime()
    assert runtime is not None
    assert runtime["env_vars"] == {}
    monkeypatch.setenv(SETTING, "mesh.max_faces=7")
    runtime = _runtime()
    assert runtime is not None
    assert runtime["env_vars"] == {SETTING: "mesh.max_faces=7"}


def test_a_run_is_resumed_with_its_limits_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They decide which items fail."""
    folder = RunFolder(str(tmp_path))

    def manifest() -> dict[str, object]:
        return new_manifest("preprocess", "data", {"scenes": "a"}, settings={}, work=[])

    assert "limits" not in manifest()
    write_manifest(folder, manifest())
    check_resume(folder, manifest(), {})
    limit(monkeypatch, "mesh", max_faces=7)
    with pytest.raises(ConfigError, match=r"limits\.mesh\.max_faces: None -> 7") as caught:
        check_resume(folder, manifest(), {})
    assert caught.value.code == "config_changed"
    write_manifest(folder, manifest())
    check_resume(folder, manifest(), {})
