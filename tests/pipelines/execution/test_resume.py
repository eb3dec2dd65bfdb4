"""Resume: what is there is kept, what is missing is done, and what does not belong together is refused."""

import json
import os
import random
import shutil
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.faults.processes import busy_workers
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess import job
from pipelines.preprocess.job import preprocess
from pipelines.preprocess.shard import SceneStep
from stable_data.errors import ConfigError
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import TABLE_VERSION
from tests.pipelines.runs import ROOT, SMALL, command_of, content, run_cli


@pytest.fixture
def clean_run(clean_run: Path, tmp_path: Path) -> Path:
    """A copy: a job locks its folder and writes the manifest, while other processes read the shared run."""
    return Path(shutil.copytree(clean_run, tmp_path / "clean_run"))


def test_a_complete_run_is_left_alone(dataset: Path, clean_run: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in clean_run.glob("*/part-*.parquet")}
    preprocess(str(dataset), str(clean_run), SMALL, WorkerPool())
    assert {p: p.stat().st_mtime_ns for p in clean_run.glob("*/part-*.parquet")} == before


def test_what_is_missing_is_done_again(tiny: Path, tiny_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(tiny_run, out)
    for table in ("scenes", "assets"):  # the last tables of a shard
        next(iter(sorted((out / table).glob("part-*")))).unlink()
    preprocess(str(tiny), str(out), SMALL, WorkerPool())
    assert content(out) == content(tiny_run)


def test_a_changed_setting_stops_with_was_and_now(dataset: Path, clean_run: Path) -> None:
    changed = replace(SMALL, important_threshold=0.05)
    with pytest.raises(ConfigError, match=r"important_threshold: 0\.02 -> 0\.05"):
        preprocess(str(dataset), str(clean_run), changed, WorkerPool())


def test_a_changed_input_stops(tiny: Path, tiny_run: Path, tmp_path: Path) -> None:
    copied, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(tiny, copied)
    shutil.copytree(tiny_run, out)
    layout = next(copied.glob("Layout_info/*/*/layout.json"))
    layout.write_text(layout.read_text("utf-8") + "\n", "utf-8")
    with pytest.raises(ConfigError, match=r"\(inputs.layouts: \w+ -> \w+\)"):
        preprocess(str(copied), str(out), SMALL, WorkerPool())


def test_a_second_run_into_the_same_folder_is_refused(dataset: Path, clean_run: Path) -> None:
    with RunFolder(str(clean_run)).locked(), pytest.raises(ConfigError, match="another run is writing to this folder"):
        preprocess(str(dataset), str(clean_run), SMALL, WorkerPool())


def test_a_full_disk_ends_with_one_line_and_the_run_can_go_on(
    tiny: Path, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import stable_data.storage.run_folder as shards

    write, written = shards._write_local, 0

    def fills_up(path: Path, data: bytes) -> None:
        nonlocal written
        written += 1
        if written > 4:
            raise OSError(28, "No space left on device")
        write(path, data)

    out = tmp_path / "out"
    monkeypatch.setattr(shards, "_write_local", fills_up)
    with pytest.raises(ConfigError, match="No space left on device"):
        preprocess(str(tiny), str(out), SMALL, WorkerPool())
    monkeypatch.undo()
    preprocess(str(tiny), str(out), SMALL, WorkerPool())
    assert content(out) == content(tiny_run)


def test_a_manifest_that_is_no_object_is_refused(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("[1]", "utf-8")
    with pytest.raises(ConfigError, match="not a JSON object"):
        preprocess(str(tiny), str(tmp_path), SMALL, WorkerPool())


def test_an_older_table_is_refused(dataset: Path, clean_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(clean_run, out)
    manifest = json.loads((out / "manifest.json").read_text("utf-8"))
    (out / "manifest.json").write_text(json.dumps(manifest | {"table_version": 0}), "utf-8")
    with pytest.raises(ConfigError, match=f"table_version: 0 -> {TABLE_VERSION}"):
        preprocess(str(dataset), str(out), SMALL, WorkerPool())


def test_a_table_that_lost_a_shard_gets_it_again(bare: Path, bare_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for table in SceneStep.TABLES:
        shutil.copytree(bare_run, out)
        shard = next(iter(RunFolder(str(out)).shard_ids("scenes")))
        (out / table / f"part-{shard}.parquet").unlink()
        preprocess(str(bare), str(out), SMALL, WorkerPool())
        assert content(out) == content(bare_run)
        shutil.rmtree(out)


def test_a_changed_annotation_stops(tiny: Path, tiny_run: Path, tmp_path: Path) -> None:
    copied, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(tiny, copied)
    shutil.copytree(tiny_run, out)
    path = copied / "Asset_annotation.json"
    annotations = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({uid: entry | {"mass": 7.0} for uid, entry in annotations.items()}), "utf-8")
    with pytest.raises(ConfigError, match=r"\(inputs.annotations: \w+ -> \w+\)"):
        preprocess(str(copied), str(out), SMALL, WorkerPool())


def test_another_dataset_of_the_same_content_stops(bare: Path, bare_run: Path, tmp_path: Path) -> None:
    copied, out = tmp_path / "renamed", tmp_path / "out"
    shutil.copytree(bare, copied)
    shutil.copytree(bare_run, out)
    with pytest.raises(ConfigError, match="dataset: data -> renamed"):  # rows say which one they are from
        preprocess(str(copied), str(out), SMALL, WorkerPool())


def test_shards_without_a_manifest_are_refused(bare: Path, bare_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(bare_run, out)
    (out / "manifest.json").unlink()
    with pytest.raises(ConfigError, match=r"contains the tables .*scenes.* but no manifest.json"):
        preprocess(str(bare), str(out), SMALL, WorkerPool())


def test_shards_of_another_run_are_refused(bare: Path, bare_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(bare_run, out)
    shard = next(iter(RunFolder(str(out)).shard_ids("scenes")))
    shutil.copy(out / "scenes" / f"part-{shard}.parquet", out / "scenes" / "part-0123456789abcdef.parquet")
    with pytest.raises(ConfigError, match=r"scenes: 1 shards are not of this run \['0123456789abcdef'\] and 0 are missing"):
        preprocess(str(bare), str(out), SMALL, WorkerPool())
    assert json.loads((out / "manifest.json").read_text("utf-8"))["status"] == "running"


def test_a_scene_that_ends_nowhere_stops(bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SceneStep, "item", lambda *_: {})
    with pytest.raises(ConfigError, match=r"1 scenes such as \w+ are not in exactly one row of scenes or failures"):
        preprocess(str(bare), str(tmp_path / "out"), SMALL, WorkerPool())


def test_a_cut_shard_ends_with_one_line_and_once_deleted_is_done_again(bare: Path, bare_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(bare_run, out)
    cut = next(iter((out / "samples").glob("part-*")))
    cut.write_bytes(cut.read_bytes()[:100])
    with pytest.raises(ConfigError, match=rf"{cut} cannot be read .*delete it and run .* again"):
        preprocess(str(bare), str(out), SMALL, WorkerPool())
    cut.unlink()
    preprocess(str(bare), str(out), SMALL, WorkerPool())
    assert content(out) == content(bare_run)


def test_a_report_that_fails_leaves_a_complete_run(bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise ValueError("no page")

    monkeypatch.setattr(job, "write_report", fail)
    with pytest.raises(ValueError, match="no page"):
        preprocess(str(bare), str(tmp_path), SMALL, WorkerPool())
    assert json.loads((tmp_path / "manifest.json").read_text("utf-8"))["status"] == "complete"


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.parametrize("victim", ["driver", "worker"])
def test_ten_kills_at_random_moments_lose_nothing(dataset: Path, clean_run: Path, tmp_path: Path, victim: str) -> None:
    out, moments, killed = tmp_path / "out", random.Random(victim), 0  # noqa: S311 - moments, not secrets
    for number in range(10):
        process = subprocess.Popen(
            command_of(dataset, out, "--workers", "2"),
            cwd=ROOT,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(moments.uniform(2.0, 14.0))
        if victim == "driver":
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                killed += 1
                process.wait()
            else:  # it was faster than the kill: the next one begins anew
                assert content(out) == content(clean_run), number
                shutil.rmtree(out)
        else:
            busy: list[int] = []
            while process.poll() is None and not (busy := busy_workers([process.pid])):
                time.sleep(0.1)
            for worker in busy[:1]:
                os.kill(worker, signal.SIGKILL)
                killed += 1
            assert process.wait(timeout=300) == 0
            assert content(out) == content(clean_run), number
            shutil.rmtree(out)
    assert killed >= 3
    done = run_cli(dataset, out, "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert content(out) == content(clean_run)
