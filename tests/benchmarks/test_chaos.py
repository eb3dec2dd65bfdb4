"""A run of the generate job on a cluster of several nodes whose driver, workers and nodes are killed: the rows are the same."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.chaos import DisturbedCommand, Nodes, Victim, below, compared, planned
from pipelines.generate.shard import GenerateWork
from pipelines.sources.assets import AssetLibraries
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.scripts import one_thing_a_stage

NUM_SCENES, PER_SHARD, KILLS = 96, 2, 6
DELAY_SECONDS = 0.5  # of a kill: shards are made in a second


def test_kills_are_of_all_kinds_and_spread_over_the_run() -> None:
    kills = planned(20, np.random.default_rng(0))
    assert kills == planned(20, np.random.default_rng(0)) != planned(20, np.random.default_rng(1))
    assert [kill.at for kill in kills] == sorted(kill.at for kill in kills)
    assert 0 <= kills[0].at < kills[-1].at < 1
    counts = [sum(kill.victim is victim for kill in kills) for victim in Victim]
    assert sorted(counts) == [6, 7, 7]


def test_what_is_lost_added_or_twice_is_counted(tmp_path: Path) -> None:
    rows = [{"id": f"scene_{n}", "step": "s", "code": "c", "message": f"m {n}"} for n in range(4)]
    for name, shards in {"clean": (rows[:2], rows[2:]), "same": (rows[:2], rows[2:]), "other": (rows[:2], rows[1:3])}.items():
        folder = RunFolder(str(tmp_path / name))
        folder.write_shard("scenes", "00", [])
        for number, part in enumerate(shards):
            folder.write_shard("failures", f"0{number}", part)
    clean, same, other = (RunFolder(str(tmp_path / name)) for name in ("clean", "same", "other"))
    assert compared(clean, same) == {"rows": 4, "lost": 0, "added": 0, "duplicates": 0, "columns_that_differ": []}
    found = {"rows": 4, "lost": 1, "added": 1, "duplicates": 1, "columns_that_differ": ["failures.id", "failures.message"]}
    assert compared(clean, other) == found


def test_processes_below_one_are_found() -> None:
    assert set(below([1])) >= {1}
    assert below([0x7FFFFFF]) == {}


@pytest.mark.ray
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_killed_drivers_workers_and_nodes_lose_no_row_and_make_none_twice(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    script, tasks = tmp_path / "script.json", tmp_path / "tasks.jsonl"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(dataset)]).libraries[0].assets[1:4])))
    rows = [{"scene_id": f"scene_{n}", "instruction": "Lift it.", "table_type": "office_table"} for n in range(NUM_SCENES)]
    tasks.write_text("".join(json.dumps(row | {"table_size_cm": [120, 60]}) + "\n" for row in rows))
    command = [sys.executable, "-m", "pipelines", "generate", "--tasks", str(tasks), "--assets", str(dataset)]
    command += ["--engine", f"scripted:{script}", "--set", "weights=none", "--set", f"scenes_per_shard={PER_SHARD}"]
    nodes, rng = Nodes(), np.random.default_rng(0)
    try:
        for name, kills in (("clean", 0), ("disturbed", KILLS)):
            out = str(tmp_path / name)
            here = [*command, "--out", out, "--address", nodes.address]
            run = DisturbedCommand(here, out, GenerateWork.TABLES[-1], NUM_SCENES // PER_SHARD, nodes, rng, DELAY_SECONDS)
            course = run.run(planned(kills, rng))
    finally:
        nodes.close()
    assert course.kills == {Victim.DRIVER: 2, Victim.WORKER: 2, Victim.NODE: 2}
    assert course.stops == 0, course.last_words
    found = compared(RunFolder(str(tmp_path / "clean")), RunFolder(str(tmp_path / "disturbed")))
    assert found.pop("rows") >= NUM_SCENES
    assert not any(found.values()), found
    assert RunFolder(str(tmp_path / "disturbed")).num_rows("scenes") == NUM_SCENES
