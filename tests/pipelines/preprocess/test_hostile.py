"""Hostile items: whatever one of them does, it is that item's row of failures, and the rest of the run is there."""

import shutil
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

from pipelines.execution.ray_executor import IsolatedProcess, ProcessFailure, WorkerPool
from pipelines.execution.shard_step import Shard
from pipelines.preprocess import convention
from pipelines.preprocess.job import preprocess
from pipelines.preprocess.settings import PreprocessSettings
from pipelines.preprocess.shard import SceneStep
from stable_data.errors import ConfigError
from stable_data.geometry.gltf_reader import load_glb
from stable_data.mesatask import MesaTaskDataset
from stable_data.storage.run_folder import RunFolder
from tests.broken_inputs import BROKEN_INPUTS
from tests.pipelines.runs import SMALL, run_cli, used_assets

WRITER = """
import os, time
def write(scene, relations):
    if scene.scene_id.endswith("aborts"):
        os.abort()
    if scene.scene_id.endswith("hangs"):
        time.sleep(600)
    raise ValueError("no answer")  # a template's task is taken
"""


@pytest.mark.parametrize(("broken", "step"), [("read", "read"), ("audit_posed_scene", "audit"), ("derive_task", "task")])
def test_what_nobody_foresaw_is_a_failure_of_its_step(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str, step: str
) -> None:
    def fail(*_: Any) -> None:
        raise IndexError("list index out of range")

    root = tmp_path / "data"
    shutil.copytree(bare, root, ignore=shutil.ignore_patterns("task_info.json"))
    if broken == "read":
        monkeypatch.setattr(MesaTaskDataset, "read", fail)
    else:
        monkeypatch.setattr(f"pipelines.preprocess.scene.{broken}", fail)
    manifest = preprocess(
        str(root), str(tmp_path / "out"), SMALL, WorkerPool()
    )  # auto: its check of positions reads scenes, too
    assert manifest["counts"]["failures_by_step"] == {step: 1}
    row = RunFolder(str(tmp_path / "out")).table("failures").to_pylist()[0]
    assert row["code"] == "unexpected"
    assert "IndexError: list index out of range" in row["message"]


def test_a_mesh_that_nobody_foresaw_is_one_asset_lost(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hostile = min(used_assets(tiny))

    def loaded(path: Path, asset_id: str) -> Any:
        if asset_id == hostile:
            raise IndexError("list index out of range")
        return load_glb(path, asset_id)

    monkeypatch.setattr("stable_data.assets.store.load_glb", loaded)
    root = tmp_path / "data"
    shutil.copytree(tiny, root)  # a place that no process knows
    preprocess(str(root), str(tmp_path / "out"), SMALL, WorkerPool())
    run = RunFolder(str(tmp_path / "out"))
    assert [(r["id"], r["step"], r["code"]) for r in run.table("failures").to_pylist()] == [(hostile, "mesh", "unexpected")]
    assert run.table("scenes").to_pylist()[0]["num_without_mesh"] >= 1


@pytest.mark.slow
@pytest.mark.ray
def test_items_that_end_or_hold_their_process_are_failures(bare: Path, tmp_path: Path) -> None:
    (tmp_path / "my_writer.py").write_text(WRITER, "utf-8")
    root = tmp_path / "data"
    shutil.copytree(bare, root, ignore=shutil.ignore_patterns("task_info.json"))
    scene = next(root.glob("Layout_info/*/*"))
    for name in ("a_hangs", "b_aborts"):
        shutil.copytree(scene, scene.with_name(name))
    limits = [
        "--set=position_convention=box_centre",
        "--set=seconds_per_item=8",
        "--set=scenes_per_shard=3",
        "--set=task_writer=my_writer:write",
    ]
    done = run_cli(root, tmp_path / "out", *limits, "--workers=1", PYTHONPATH=str(tmp_path))
    assert done.returncode == 1, done.stderr
    assert "1 of 3 scenes" in done.stdout
    assert "crashed 1, timed_out 1" in done.stdout
    run = RunFolder(str(tmp_path / "out"))
    failures = {r["id"]: (r["step"], r["code"]) for r in run.table("failures").to_pylist()}
    assert failures == {"a_hangs": ("isolate", "timed_out"), "b_aborts": ("isolate", "crashed")}
    assert run.table("scenes", ["scene_id"])["scene_id"].to_pylist() == [scene.name]


@pytest.mark.parametrize(
    ("loss", "told"),
    [
        (ProcessFailure.CRASHED, "ended the process that did it, .*item.max_memory_bytes in STABLE_DATA_LIMITS"),
        (ProcessFailure.OUT_OF_MEMORY, "needed more memory, expected at most 8,589,934,592 bytes .item.max_memory_bytes in .*"),
        (ProcessFailure.TIMED_OUT, "took over 600 s for each of 64 items .seconds_per_item"),
    ],
)
def test_a_check_of_positions_that_dies_stops_with_what_to_set(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loss: ProcessFailure, told: str
) -> None:
    monkeypatch.setattr(convention, "run_isolated", lambda *_, seconds: loss)
    with pytest.raises(ConfigError, match=rf"{told}\), over a layout or mesh; set position_convention to box_centre"):
        preprocess(str(bare), str(tmp_path / "out"), SMALL, WorkerPool(1))


@pytest.mark.parametrize(
    ("loss", "message"), [(ProcessFailure.CRASHED, "is it hostile"), (ProcessFailure.TIMED_OUT, "took over 600 s")]
)
def test_how_a_process_ended_is_the_reason(monkeypatch: pytest.MonkeyPatch, loss: ProcessFailure, message: str) -> None:
    monkeypatch.setattr(IsolatedProcess, "call", lambda *_, seconds: loss)
    step = SceneStep("nowhere", PreprocessSettings())
    [row] = step.shard(Shard("0" * 16, ("office_table_0001",)), isolated=True).rows["failures"]
    assert (row["id"], row["code"]) == ("office_table_0001", str(loss))
    assert message in row["message"]


@pytest.fixture(scope="module")
def broken_run(broken_data: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp("broken") / "out"
    preprocess(str(broken_data), str(out), SMALL, WorkerPool())
    return RunFolder(str(out))


def test_broken_inputs_are_handled_case_by_case(broken_run: RunFolder) -> None:
    scenes = set(broken_run.table("scenes", ["scene_id"])["scene_id"].to_pylist())
    failures, warnings = (defaultdict[str, list[str]](list) for _ in range(2))
    for codes, table in ((failures, "failures"), (warnings, "warnings")):
        for row in broken_run.table(table).to_pylist():
            codes[row["id"]].append(row["code"])
    assert scenes == {case.name for case in BROKEN_INPUTS if case.action != "reject"}
    for case in BROKEN_INPUTS:
        if case.action == "reject":
            assert failures[case.name] == [case.layout_code]
        elif case.action == "keep":
            assert (failures[case.name], warnings[case.name]) == ([], [])
        else:
            assert failures[case.name] == []
            assert (case.layout_code or case.mesh_code) in warnings[case.name]


def test_objects_with_a_broken_mesh_are_kept_as_boxes_of_unknown_verdict(broken_run: RunFolder) -> None:
    rows = {r["scene_id"]: r for r in broken_run.table("scenes").to_pylist()}
    without_mesh = {case.name for case in BROKEN_INPUTS if not case.is_mesh_usable}
    assert {name for name, row in rows.items() if row["num_without_mesh"]} == without_mesh | {"unknown_uid"}
    assert {rows[name]["num_without_mesh"] for name in without_mesh} == {1}
    assert {rows[name]["clean"] for name in without_mesh} == {None}
