"""What the experiment on policies and the test of the verdicts make of their results."""

from argparse import Namespace
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from benchmarks.policy import LAYOUTS, MESHES, Cell, Experiment, Result, effects, show
from benchmarks.replay import area_under_curve, figures, outcomes
from pipelines.demonstrate.job import demonstrate
from pipelines.demonstrate.settings import DemonstrateSettings
from pipelines.execution.ray_executor import WorkerPool
from stable_data.mesatask.library import ANNOTATION_FILE
from tests.stable_data.export.runs import write_run
from tests.stable_data.robot.tables import laid_table


def results(seeds: int) -> dict[Cell, Result]:
    """Corrected scenes give 10 points more, real meshes 20, ten times as many scenes 5; a seed adds as many points as its number."""
    found = {}
    for seed in range(seeds):
        for a, layouts in enumerate(LAYOUTS):
            for b, meshes in enumerate(MESHES):
                for c, scenes in enumerate((10, 100)):
                    successes = 20 + seed + 10 * a + 20 * b + 5 * c
                    found[Cell(seed, layouts, meshes, scenes)] = Result(100, 10, 120, 0.9, successes, 100)
    return found


def test_effects_are_differences_of_cells_that_differ_in_one_respect() -> None:
    found = effects(results(3))
    assert {name: [round(v, 6) for v in values] for name, values in found.items()} == {
        "corrected - uncorrected": [0.1] * 3,
        "real - parametric": [0.2] * 3,
        "100 - 10 scenes": [0.05] * 3,
    }


def test_the_tables_have_a_line_for_each_cell_and_each_effect() -> None:
    lines = "\n".join(show(results(2))).splitlines()
    assert len(lines) == 1 + 8 + 1 + 1 + 3
    assert "55.5" in lines[8]  # the best cell: the mean of 55 and 56
    assert "unknown" in "\n".join(show(results(1)))  # one repetition has no interval


def experiment(work: Path, **changes: object) -> Experiment:
    (work / "data").mkdir(exist_ok=True)
    (work / "data" / ANNOTATION_FILE).write_text("{}")
    options = {"scenes": [2, 1], "demonstrations": 4, "tests": 5, "robot": "simple"} | changes
    return Experiment(work / "data", work / "out", Namespace(**options))


def test_results_of_other_options_are_not_mixed(tmp_path: Path) -> None:
    experiment(tmp_path)
    experiment(tmp_path, scenes=[1, 2], seeds=9)  # more seeds may be added
    with pytest.raises(SystemExit, match="is of other options"):
        experiment(tmp_path, tests=6)


def test_all_pools_have_the_same_scenes_and_fewer_are_part_of_more(tmp_path: Path) -> None:
    found, scene = experiment(tmp_path), laid_table()
    for number, (layouts, meshes) in enumerate(product(LAYOUTS, MESHES)):
        ids = ["one", "two", "three", "four", f"only_{number}"]
        scenes = tuple(replace(scene, scene_id=name) for name in (ids if number else ids[1:]))
        write_run(found.pool(0, layouts, meshes) / "scenes", scenes)
    assert sorted(found.common_scenes(0)) == ["four", "three", "two"]
    assert found.common_scenes(0) == found.common_scenes(0)


def test_the_area_under_the_curve() -> None:
    assert area_under_curve([0.0, 1.0, 2.0, 3.0], [True, True, False, False]) == 1.0
    assert area_under_curve([1.0, 1.0], [True, False]) == 0.5
    assert area_under_curve([1.0, 2.0], [True, True]) is None


def test_episodes_are_carried_out_again_and_grouped_by_the_verdicts_of_their_scenes(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", (laid_table(),)).root
    settings = DemonstrateSettings(robot="simple", task="pick", episodes=2)
    demonstrate(str(run), str(tmp_path / "out"), settings, WorkerPool(), report=False)
    found = list(outcomes(str(run), str(tmp_path / "out"), vary=0.0, limit=1))
    assert len(found) == 2
    assert [o.replayed for o in found if o.replayed is not None] == [True]  # nothing was changed
    everything = figures(found)
    assert everything["groups"]["all"] == {"expert": [sum(o.expert for o in found), 2], "replayed": [1, 1]}
    unknown = sum(everything["groups"][name]["expert"][1] for name in ("clean", "not clean"))
    assert unknown == (0 if found[0].verdicts["clean"] is None else 2)


def test_a_path_that_is_no_dataset_leaves_nothing_behind(tmp_path: Path) -> None:
    options = Namespace(scenes=[1], demonstrations=4, tests=5, robot="simple")
    with pytest.raises(SystemExit, match=ANNOTATION_FILE):
        Experiment(tmp_path / "nowhere", tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_a_run_of_another_job_is_no_run_of_demonstrate(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"job": "generate", "settings": {}}')
    with pytest.raises(SystemExit, match="a run of generate, expected one of demonstrate"):
        next(outcomes(str(tmp_path), str(tmp_path), 0.0, 1))
