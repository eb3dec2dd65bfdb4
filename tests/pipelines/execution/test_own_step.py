"""The example of a job of one's own: its rows, its failures, and that it resumes."""

from dataclasses import replace
from pathlib import Path

import pytest

from examples.own_step import DensityJob, DensityStep
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import describe, run_job
from stable_data.errors import ConfigError
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import REQUIRED, SCHEMAS
from stable_data.storage.table_rows import scene_row
from tests.pipelines.runs import content

CUBE = SceneObject("cube", "cube", (0.5, 0.5, 0.1), 0.0, (0.2, 0.2, 0.2), None)


@pytest.fixture(autouse=True)
def known_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tables that this process knows, without those of the example once its tests are done."""
    for table in DensityStep.SCHEMAS:
        for known in (SCHEMAS, REQUIRED):
            monkeypatch.setitem(known, table, known["scenes"])
            del known[table]


def run_of(out: Path, *counts: int) -> Path:
    """A run with scenes of so many objects on a table of half a square metre."""
    table, folder = Tabletop("office_table", (1.0, 0.5)), RunFolder(out)
    rows = []
    for number, count in enumerate(counts):
        cubes = tuple(replace(CUBE, instance=f"cube_{k}") for k in range(count))
        rows.append(dict.fromkeys(SCHEMAS["scenes"].names) | scene_row(Scene(f"scene_{number}", table, cubes)))
    folder.write_shard("scenes", "0" * 16, rows)
    for name in ("assets", "meshes"):
        folder.write_shard(name, "0" * 16, [])
    return out


def test_a_job_of_ones_own_writes_its_table_and_failures_and_resumes(tmp_path: Path) -> None:
    run, out = run_of(tmp_path / "run", 2, 0, 1), tmp_path / "out"
    assert describe(DensityJob(str(run)))["num_shards"] == 1
    manifest = run_job(DensityJob(str(run)), str(out), WorkerPool())
    assert RunFolder(out).table("density").to_pylist() == [
        {"scene_id": "scene_0", "objects_per_m2": 4.0},
        {"scene_id": "scene_2", "objects_per_m2": 2.0},
    ]
    (failure,) = RunFolder(out).table("failures").to_pylist()
    assert (failure["id"], failure["code"]) == ("scene_1", "empty")
    assert manifest["counts"]["failed_scenes"] == 1
    was = content(out)
    next(iter((out / "density").glob("part-*"))).unlink()
    assert run_job(DensityJob(str(run)), str(out), WorkerPool())["counts"] == manifest["counts"]
    assert content(out) == was


def test_another_input_is_refused(tmp_path: Path) -> None:
    run, out = run_of(tmp_path / "run", 1), tmp_path / "out"
    run_job(DensityJob(str(run)), str(out), WorkerPool())
    RunFolder(run).write_shard("scenes", "1" * 16, [])
    with pytest.raises(ConfigError, match=r"inputs\.scenes: \w+ -> \w+"):
        run_job(DensityJob(str(run)), str(out), WorkerPool())
