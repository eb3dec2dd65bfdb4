"""The memory of an item is bounded in workers and in separate processes, and a run has one set of limits."""

import shutil
import sys
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from models.dual_system.variant_task import Axis
from models.physics_corrector.certify.correction import Correction, CorrectionOptions
from pipelines.correct.settings import CorrectSettings
from pipelines.correct.shard import CorrectWork
from pipelines.edit.settings import EditSettings
from pipelines.edit.shard import EditWork
from pipelines.execution.item_progress import ItemProgress
from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure, WorkerPool, _runtime
from pipelines.execution.resume import check_resume, new_manifest
from pipelines.execution.shard_step import Shard, failed_process, rows_or_failure
from pipelines.generate import shard as generation
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import GenerateWork
from pipelines.preprocess.asset import AssetUse
from pipelines.preprocess.settings import PreprocessSettings
from pipelines.preprocess.shard import AssetStep
from pipelines.sources.edits import EditRequest
from pipelines.sources.scene_variants import SceneVariant
from stable_data.errors import ConfigError, Notice
from stable_data.geometry.gltf_writer import write_glb
from stable_data.geometry.mesh import Mesh
from stable_data.limits import SETTING
from stable_data.scene import Scene, Tabletop
from stable_data.storage.manifest import write_manifest
from stable_data.storage.run_folder import RunFolder
from tests.bounds import limit
from tests.pipelines.execution.allocating import MIB, allocate, allocate_tensor
from tests.pipelines.execution.allocating_batch import Batch
from tests.pipelines.execution.allocating_step import AllocationStep

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is bounded on Linux")


def test_a_separate_process_has_the_memory_of_an_item(monkeypatch: pytest.MonkeyPatch) -> None:
    with IsolatedProcess() as apart:
        assert apart.call(allocate, 64 * MIB, seconds=60) == 64 * MIB
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={32 * MIB}")
    with IsolatedProcess() as apart:
        assert apart.call(allocate, 256 * MIB, seconds=60) is ProcessFailure.OUT_OF_MEMORY
        assert apart.call(allocate, MIB, seconds=60) == MIB


def test_a_separate_process_tells_that_torch_has_too_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={64 * MIB}")
    with IsolatedProcess(allocate_tensor) as apart:
        assert apart.call(allocate_tensor, 256 * MIB, seconds=60) is ProcessFailure.OUT_OF_MEMORY


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
    assert "item.max_memory_bytes" in failed_process(ProcessFailure.CRASHED, "mug", 60)["failures"][0]["message"]


@pytest.mark.ray
def test_what_needs_more_memory_in_a_worker_fails_alone() -> None:
    work, shard = AllocationStep(), Shard("0" * 16, (8, 257, 9, 256, 8))
    assert list(WorkerPool(1).run(work, [shard])) == [[("257", "out_of_memory"), ("256", "out_of_memory")]]


def test_a_reader_that_needs_more_memory_is_not_said_to_find_a_broken_file(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, asset_id = tmp_path / "data", min(path.stem for path in tiny.glob("Assets_library/*.glb"))
    shutil.copytree(tiny, root)
    corners = np.random.default_rng(0).normal(size=(900_000, 3))
    big = write_glb(Mesh(corners, np.arange(900_000).reshape(-1, 3)))
    (root / "Assets_library" / f"{asset_id}.glb").write_bytes(big)
    # On some processors OpenBLAS needs 32 MiB for itself, and ends the process without them.
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={80 * MIB}")
    step, use = AssetStep(str(root), PreprocessSettings()), AssetUse(asset_id, "", (1.0, 1.0, 1.0), (), ())
    (row,) = step.shard(Shard("0" * 16, (use,)), isolated=True).rows["failures"]
    assert (row["id"], row["code"]) == (asset_id, "out_of_memory")
    assert "item.max_memory_bytes" in row["message"]


@pytest.mark.slow
def test_a_batch_has_the_memory_of_its_items(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={32 * MIB}")
    work = Batch("", CorrectSettings())
    with IsolatedProcess() as apart:
        assert len(work._isolated_answers(["a"] * 2, defaultdict(list), apart)) == 2
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={8 * MIB}")
    told = r"for scenes such as a, needed more memory, expected at most .* for each of 2 items"
    with IsolatedProcess() as apart, pytest.raises(ConfigError, match=told) as caught:
        work._isolated_answers(["a"] * 2, defaultdict(list), apart)
    assert "item.max_memory_bytes" in str(caught.value)


def test_an_item_that_a_batch_is_lost_for_fails_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={32 * MIB}")
    rows: dict[str, list[Any]] = defaultdict(list)
    items = ["a", "big", "b", "odd"]
    with IsolatedProcess() as apart:
        assert [item for item, _ in Batch("", CorrectSettings())._isolated_answers(items, rows, apart)] == ["a", "b"]
    assert [(row["id"], row["step"], row["code"]) for row in rows["failures"]] == [
        ("big", "isolate", "out_of_memory"),
        ("odd", "answer", "unexpected"),
    ]
    (warning,) = rows["warnings"]
    assert (warning["id"], warning["code"]) == ("a", "batch_failed")
    assert warning["message"].startswith("a and 3 others: the batch failed, and each was computed alone: ")


@pytest.mark.slow
def test_the_job_ends_only_if_all_items_alone_lose_their_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={32 * MIB}")
    rows: dict[str, list[Any]] = defaultdict(list)
    with IsolatedProcess() as apart:
        assert not Batch("", CorrectSettings())._isolated_answers(["big", "odd"], rows, apart, "it broke")
    assert [row["message"].rpartition(": ")[2] for row in rows["warnings"]] == ["it broke"]
    assert [row["code"] for row in rows["failures"]] == ["out_of_memory", "unexpected"]


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.parametrize(
    ("items", "code"),
    [(("a", "big", "b"), "out_of_memory"), (("a", "odd"), "unexpected"), (("a", "slow"), "timed_out")],
)
def test_a_batch_in_a_worker_is_limited(items: tuple[str, ...], code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too much for the batch is found alone, in workers that were given no other reason to run items alone."""
    monkeypatch.setenv(SETTING, f"item.max_memory_bytes={32 * MIB}")
    work = Batch("", CorrectSettings(seconds_per_item=3.0))
    (made,) = WorkerPool(1).run(work.shard, [Shard("0" * 16, items)])
    assert [(row["id"], row["code"]) for row in made.rows["failures"]] == [(items[1], code)]
    told = [(row["id"], row["code"]) for row in made.rows["warnings"]]
    assert told[0] == ("a", "batch_failed")
    assert [item for item, code in told[1:]] == [item for item in items if item != items[1]]


@pytest.mark.parametrize("work", [CorrectWork("", CorrectSettings()), EditWork("", EditSettings())])
def test_a_lost_batch_names_the_setting(work: Any) -> None:
    items = ["a"] * 3 if isinstance(work, CorrectWork) else [EditRequest("a", "s", "move it")] * 3
    told = str(work.unanswered(ProcessFailure.TIMED_OUT, items))
    assert f"took over {work.settings.seconds_per_item:g} s for each of 3 items (seconds_per_item)" in told
    assert "item.max_memory_bytes" in str(work.unanswered(ProcessFailure.CRASHED, items))


def test_what_is_not_read_or_placed_for_want_of_memory_costs_no_shard_of_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The questions of the shard are not asked again."""

    def need_more(*_: object) -> Any:
        raise MemoryError

    store, work = SimpleNamespace(fault_of=need_more), GenerateWork((), GenerateSettings())
    monkeypatch.setattr(generation, "_open_certifier", lambda _: SimpleNamespace(store=store))
    assert "item.max_memory_bytes" in (work._fault_of("mug", process=None) or "")
    placed = work._searched(need_more, SimpleNamespace(objects=[SimpleNamespace(instance="mug")]), process=None)  # type: ignore[arg-type]
    assert "item.max_memory_bytes" in placed.dropped["mug"]
    assert not issubclass(MemoryError, generation._NOT_OF_AN_ITEM)  # so the judge of a scene makes it a row


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


class Lost:
    """A separate process that is lost in each call."""

    def call(self, *_: object, seconds: float, num_items: int) -> ProcessFailure:
        return ProcessFailure.TIMED_OUT


def test_what_a_task_is_read_from_is_read_within_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    def need_more(*_: object) -> Any:
        raise MemoryError

    work, lost = GenerateWork((), GenerateSettings(seconds_per_item=7.0)), Lost()
    monkeypatch.setattr(generation, "_open_layouts", lambda _: SimpleNamespace(of_task=need_more))
    variant = SceneVariant("mug", Axis.LAYOUT)
    monkeypatch.setattr(generation, "_open_varied", need_more)
    for process, code, told in ((None, "out_of_memory", "item.max_memory_bytes"), (lost, "timed_out", "took over 7 s")):
        notice, remarks = work._layout_of("mug", process)  # type: ignore[arg-type]
        assert isinstance(notice, Notice)
        assert (notice.code, remarks) == (code, ())
        rows: dict[str, list[Any]] = defaultdict(list)
        assert not list(work._tasks(Shard("0" * 16, (variant,)), rows, None, process))  # type: ignore[arg-type]
        assert [(row["id"], row["code"]) for row in rows["failures"]] == [(variant.scene_id, code)]
        assert all(told in message for message in (notice.message, rows["failures"][0]["message"]))
    warnings = list[Notice]()
    scenes, options = [Scene("mug", Tabletop("office_table", (1.2, 0.6)), ())], [CorrectionOptions()]
    (moved,) = work._moved(lost, warnings, scenes, options)  # type: ignore[arg-type]
    assert isinstance(moved, Correction)
    assert "the flow took over 7 s" in moved.reason
    assert not warnings  # one scene is no batch
    assert len(work._moved(lost, warnings, 2 * scenes, 2 * options)) == 2  # type: ignore[arg-type]
    assert [(notice.item_id, notice.code) for notice in warnings] == [("mug", "batch_failed")]
    assert (
        "mug and 1 other: the batch failed, and each was computed alone: it took over 7 s for each of 2 items"
        in warnings[0].message
    )
