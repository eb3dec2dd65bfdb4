"""A run of the generate job may grow: more tasks later, with the rows of a run that had all of them at once."""

import json
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.resume import OF_DATASET, REPLACED
from pipelines.generate.job import GenerateJob, generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from stable_data.errors import ConfigError, Notice
from stable_data.scene import Stage, Tabletop
from stable_data.storage.run_changes import prune
from stable_data.storage.run_folder import RunFolder
from tests.pipelines.runs import content
from tests.pipelines.scripts import entry
from tests.whole import check_whole

ALONE = WorkerPool()
TABLES = ("scenes", "rejected", "turns", "assets", "meshes", "warnings", "failures")
DESK = Tabletop("office_table", (1.2, 0.6))


@pytest.fixture(scope="module")
def settings(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> GenerateSettings:
    """An engine whose task object depends on the instruction, so that later tasks use other assets."""
    first, second, third = AssetLibraries([str(dataset)]).libraries[0].assets[1:4]
    script = {
        "Lift": {"objects": [entry(third, 20.0)]},
        WANTED[Stage.TASK]: {"objects": [entry(first, 20.0)]},
        WANTED[Stage.IMPORTANT]: {"objects": [entry(second, 21.0)]},
        WANTED[Stage.SECONDARY]: {"objects": []},
    }
    path = tmp_path_factory.mktemp("script") / "script.json"
    path.write_text(json.dumps(script))
    return GenerateSettings(EngineSettings(f"scripted:{path}"), weights="none", num_pictures=0, accept="")


def tasks(*words: str) -> TaskSource:
    found = [LayoutTask(f"task_{n}", said, DESK) for n, said in enumerate(words)]
    return TaskSource(f"{len(words)} tasks", found, [Notice("row 9", "tasks", "task_invalid", "no JSON")])


WORDS = ("Take it.", "Turn it.", "Take it now.", "Lift it.", "Turn it back.", "Lift it again.")


@pytest.fixture(scope="module")
def whole(dataset: Path, settings: GenerateSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    generate(tasks(*WORDS), str(out), settings, ALONE, [str(dataset)], report=False)
    return out


def rows(run: Path, table: str) -> pl.DataFrame:
    found = pl.from_arrow(RunFolder(str(run)).table(table))
    assert isinstance(found, pl.DataFrame)
    names = [name for name in ("scene_id", "asset_id", "id", "turn", "code") if name in found.columns]
    return found.sort(names)


def test_a_run_that_grew_twice_has_the_rows_of_one_that_did_not(
    dataset: Path, settings: GenerateSettings, whole: Path, tmp_path: Path
) -> None:
    for count in (2, 3, 6):
        manifest = generate(tasks(*WORDS[:count]), str(tmp_path), settings, ALONE, [str(dataset)], report=False)
        assert manifest["counts"]["scenes"] == count
    assert manifest["growth"] == [2, 1, 3]
    assert (manifest["num_tasks"], manifest["dataset"], REPLACED in manifest) == (7, "6 tasks", False)
    for table in TABLES:
        assert rows(tmp_path, table).equals(rows(whole, table)), table
    assert len(manifest["work"]) == 3
    assert check_whole(tmp_path).num_simulated == 6
    before = content(tmp_path)
    generate(tasks(*WORDS), str(tmp_path), settings, ALONE, [str(dataset)], report=False)
    assert content(tmp_path) == before


def test_finished_scenes_are_not_made_again(dataset: Path, settings: GenerateSettings, tmp_path: Path) -> None:
    run = RunFolder(str(tmp_path))
    generate(tasks(*WORDS[:3]), str(tmp_path), settings, ALONE, [str(dataset)], report=False)
    before = run.file_stamps("scenes")
    generate(tasks(*WORDS), str(tmp_path), settings, ALONE, [str(dataset)], report=False)
    assert set(before) <= set(run.file_stamps("scenes"))


@pytest.mark.slow
def test_a_growth_that_was_stopped_goes_on(
    dataset: Path, settings: GenerateSettings, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate(tasks(*WORDS[:3]), str(tmp_path), settings, ALONE, [str(dataset)], report=False)

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "remove_shards", stopped)
        with pytest.raises(KeyboardInterrupt):
            generate(tasks(*WORDS[:4]), str(tmp_path), settings, ALONE, [str(dataset)], report=False)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["status"] == "running"
    assert manifest[REPLACED]["assets"]
    generate(tasks(*WORDS), str(tmp_path), settings, ALONE, [str(dataset)], report=False)
    for table in TABLES:
        assert rows(tmp_path, table).equals(rows(whole, table)), table


def test_a_run_does_not_shrink_and_takes_no_other_tasks(dataset: Path, settings: GenerateSettings, whole: Path) -> None:
    before = content(whole)
    for others in (WORDS[:4], (*WORDS[:5], "Turn it over.", "Lift it."), ("Lift it.", *WORDS)):
        with pytest.raises(ConfigError, match=r"inputs\.tasks"):
            generate(tasks(*others), str(whole), settings, ALONE, [str(dataset)], report=False)
    with pytest.raises(ConfigError, match="seed: 0 -> 1"):
        generate(tasks(*WORDS, "Lift it."), str(whole), replace(settings, seed=1), ALONE, [str(dataset)], report=False)
    assert content(whole) == before


def test_the_default_size_of_shards_is_that_of_the_first_tasks(
    dataset: Path, settings: GenerateSettings, tmp_path: Path
) -> None:
    few, many = (tasks(*(f"Take {n}." for n in range(count))) for count in (3, 2000))
    generate(few, str(tmp_path), settings, ALONE, [str(dataset)], report=False)
    was = json.loads((tmp_path / "manifest.json").read_text())
    job = GenerateJob(many, settings, [str(dataset)])
    assert job.settings.scenes_per_shard > was["settings"]["scenes_per_shard"]
    grown = job.continuing(was)
    assert grown.settings.scenes_per_shard == was["settings"]["scenes_per_shard"]
    assert grown.growth == [3, 1997]
    first = {shard.shard_id for shard in grown.plan()[0].shards}
    assert RunFolder(str(tmp_path)).shard_ids("scenes") <= first
    assert OF_DATASET not in first


def test_a_run_without_its_rejected_scenes_can_grow(
    dataset: Path, settings: GenerateSettings, whole: Path, tmp_path: Path
) -> None:
    picky = replace(settings, accept="scene_id != 'task_3'")
    generate(tasks(*WORDS[:4]), str(tmp_path), picky, ALONE, [str(dataset)], report=False)
    assert prune(RunFolder(str(tmp_path)))["rejected"] == 1
    for _ in range(2):
        manifest = generate(tasks(*WORDS), str(tmp_path), picky, ALONE, [str(dataset)], report=False)
        assert manifest["counts"]["scenes"] == 5
    assert rows(tmp_path, "scenes").equals(rows(whole, "scenes").filter(pl.col("scene_id") != "task_3"))
    assert rows(tmp_path, "meshes").equals(rows(whole, "meshes"))  # task_5 uses what task_3 used
