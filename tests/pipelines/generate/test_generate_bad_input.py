"""The generate job over what is broken: every task is accounted for, and the run goes on or stops with one line."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from types import ModuleType
from typing import Any

import pytest
from shapely.errors import GEOSException

from models.physics_corrector import corrector
from models.physics_corrector.flow.checkpoint import save_corrector
from models.point_encoder import save as save_encoder
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_step import Shard, ShardTask, ShardWriter
from pipelines.generate import answers, shard
from pipelines.generate.job import generate
from pipelines.generate.settings import GenerateSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from stable_data.errors import ConfigError
from stable_data.scene import Stage, Tabletop
from stable_data.storage.run_folder import RunFolder
from tests.models.physics_corrector.flow.conditions import awake_network, small_settings
from tests.models.point_encoder.clouds import tiny_encoder
from tests.models.semantic_reasoner.engines.endpoint import Act, endpoint, said
from tests.pipelines.preprocess.hostile_asset import HOSTILE, HostileWork
from tests.pipelines.runs import content
from tests.pipelines.scripts import one_thing_a_stage

ALONE = WorkerPool()
DESK = Tabletop("office_table", (1.2, 0.6))
PLAIN = GenerateSettings(weights="none", scenes_per_shard=1, num_pictures=0)
FOUR = TaskSource("tasks", [LayoutTask(f"task_{n}", f"Lift it {n} times.", DESK) for n in range(4)])


def ids(run: Path, table: str) -> set[str]:
    return set(RunFolder(str(run)).table(table)["scene_id" if table == "scenes" else "id"].to_pylist())


def test_a_library_with_holes_costs_no_task_and_gives_nothing_that_is_broken(dataset: Path, tmp_path: Path) -> None:
    whole = AssetLibraries([str(dataset)]).libraries[0].assets[1:4]
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(whole)))
    holes = tmp_path / "holes"
    shutil.copytree(dataset, holes)
    missing, torn = (holes / "Assets_library" / f"{asset.asset_id}.glb" for asset in whole[1:])
    missing.unlink()
    torn.write_bytes(torn.read_bytes()[:100])
    settings = replace(PLAIN, engine=EngineSettings(f"scripted:{script}"), accept="clean")
    out = tmp_path / "out"
    made = generate(FOUR, str(out), settings, ALONE, [str(holes)], report=False)
    assert made["counts"]["scenes"] == len(FOUR.tasks)
    objects = [o for row in RunFolder(str(out)).table("scenes").to_pylist() for o in row["objects"]]
    like = [whole[0].category, whole[1].category]  # none is like the third
    assert [o["category"] for o in objects] == like * len(FOUR.tasks)
    assert not {o["asset_id"] for o in objects} & {missing.stem, torn.stem}
    told = [(row["code"], row["message"]) for row in RunFolder(str(out)).table("warnings").to_pylist()]
    assert (
        sum(code == "asset_unusable" and "gets another asset" in words and "no GLB file" in words for code, words in told) == 4
    )
    assert sum(code == "asset_unmatched" and "a chunk ends" in words for code, words in told) == 4


def test_a_task_object_whose_asset_is_broken_and_has_no_like_is_a_failure_that_says_so(dataset: Path, tmp_path: Path) -> None:
    whole = AssetLibraries([str(dataset)]).libraries[0].assets[1:4]
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(whole[::-1])))
    holes = tmp_path / "holes"
    shutil.copytree(dataset, holes)
    (holes / "Assets_library" / f"{whole[-1].asset_id}.glb").unlink()
    settings = replace(PLAIN, engine=EngineSettings(f"scripted:{script}"))
    out = tmp_path / "out"
    generate(replace(FOUR, tasks=FOUR.tasks[:1]), str(out), settings, ALONE, [str(holes)], report=False)
    (row,) = RunFolder(str(out)).table("failures").to_pylist()
    assert row["id"] == "task_0"
    assert "no GLB file" in row["message"]


@pytest.mark.slow
def test_an_asset_that_ends_whoever_reads_it_is_passed_over_where_workers_died(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Were it read in this process, the tests would end here."""
    chosen = AssetLibraries([str(dataset)]).libraries[0].assets[1:4]
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(chosen)))
    monkeypatch.setenv(HOSTILE, chosen[0].asset_id)
    settings = replace(PLAIN, engine=EngineSettings(f"scripted:{script}"))
    write = ShardWriter(str(tmp_path / "out"), (HostileWork((str(dataset),), settings),))
    assert write(ShardTask(0, Shard("0" * 16, tuple(FOUR.tasks[:2]))), isolated=True).num_items == 2
    run = RunFolder(str(tmp_path / "out"))
    told = [row["message"] for table in ("warnings", "failures") for row in run.table(table).to_pylist()]
    assert sum(f"asset {chosen[0].asset_id}: reading it ended the process" in message for message in told) == 2
    assert run.num_rows("scenes") + run.num_rows("failures") == 2


@pytest.mark.parametrize(
    "death",
    [
        Act(drops=True),
        pytest.param(Act(503, {"error": {"message": "no healthy upstream"}}), marks=pytest.mark.slow),
        Act(429, {"error": {"code": "insufficient_quota", "message": "You exceeded your current quota"}}),
        pytest.param(Act(after_s=2.0), marks=pytest.mark.slow),
    ],
    ids=["drops", "gateway", "quota", "silence"],
)
def test_an_endpoint_that_dies_halfway_stops_the_run_with_one_line_and_costs_no_task(
    death: Act, dataset: Path, tmp_path: Path
) -> None:
    script = one_thing_a_stage(AssetLibraries([str(dataset)]).libraries[0].assets[1:4])
    answers = {words: json.dumps(reply) for words, reply in script.items()}
    left, lock = [0], Lock()

    def plan(words: str, _: int, __: dict[str, Any]) -> Act:
        with lock:
            left[0] -= 1
        if left[0] < 0:
            return death
        return Act(body=said(next(reply for wanted, reply in answers.items() if wanted in words)))

    with endpoint(plan) as server:
        http = server.settings(rest_s=0.0, tries=2, read_s=1.0)
        settings = replace(PLAIN, engine=EngineSettings("openai:large", http=http, cache=str(tmp_path / "kept")))
        out, undisturbed = tmp_path / "out", tmp_path / "undisturbed"
        left[0] = 2 * len(Stage) + 1  # two scenes, and a stage of the third
        with pytest.raises(ConfigError, match=r"^task_\d: .*; finished shards are kept, run again to continue$") as caught:
            generate(FOUR, str(out), settings, ALONE, [str(dataset)], report=False)
        assert caught.value.code == "engine_off"
        assert len(ids(out, "scenes")) == 2
        left[0] = 1000
        assert generate(FOUR, str(out), settings, ALONE, [str(dataset)], report=False)["status"] == "complete"
        generate(FOUR, str(undisturbed), settings, ALONE, [str(dataset)], report=False)
    assert content(out) == content(undisturbed)
    assert ids(out, "scenes") == {t.scene_id for t in FOUR.tasks}


def test_an_endpoint_that_is_down_for_one_stage_leaves_no_hole(dataset: Path, tmp_path: Path) -> None:
    """It answers again before the scene is finished; the scene is made anew when the run goes on, with all its stages."""
    script = one_thing_a_stage(AssetLibraries([str(dataset)]).libraries[0].assets[1:4])
    answers = {words: json.dumps(reply) for words, reply in script.items()}
    is_down = [True]

    def plan(words: str, _: int, __: dict[str, Any]) -> Act:
        if is_down[0] and (WANTED[Stage.IMPORTANT] in words or "Leave the table empty" in words):
            return Act(drops=True)
        return Act(body=said(next(reply for wanted, reply in answers.items() if wanted in words)))

    with endpoint(plan) as server:
        settings = replace(PLAIN, engine=EngineSettings("openai:large", http=server.settings(rest_s=0.0)))
        with pytest.raises(ConfigError, match="run again to continue"):
            generate(FOUR, str(tmp_path), settings, ALONE, [str(dataset)], report=False)
        is_down[0] = False
        generate(FOUR, str(tmp_path), settings, ALONE, [str(dataset)], report=False)
    assert ids(tmp_path, "scenes") == {t.scene_id for t in FOUR.tasks}
    assert {len(row["objects"]) for row in RunFolder(str(tmp_path)).table("scenes").to_pylist()} == {len(Stage)}


@pytest.mark.parametrize(("module", "step"), [(corrector, "certify_moved"), (answers, "assign_assets")], ids=["one", "many"])
def test_what_nobody_foresaw_costs_one_scene(
    module: ModuleType, step: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a correction, which is of one scene, and in what is done for many scenes at once."""
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(dataset)]).libraries[0].assets[1:4])))
    settings = replace(PLAIN, engine=EngineSettings(f"scripted:{script}"), scenes_per_shard=4, accept="clean", settle=False)
    real = getattr(module, step)

    def fails(first: Any, *more: Any, **named: Any) -> Any:
        if "task_2" in {scene.scene_id for scene in (first if isinstance(first, list) else [first])}:
            raise GEOSException("TopologyException:\nside location conflict")
        return real(first, *more, **named)

    monkeypatch.setattr(module, step, fails)
    generate(FOUR, str(tmp_path / "out"), settings, ALONE, [str(dataset)], report=False)
    assert ids(tmp_path / "out", "scenes") == {"task_0", "task_1", "task_3"}
    (row,) = RunFolder(str(tmp_path / "out")).table("failures").to_pylist()
    assert (row["id"], row["code"]) == ("task_2", "unknown" if step == "certify_moved" else "unexpected")
    assert "GEOSException: TopologyException: side location conflict; please report" in row["message"]
    told = [
        row["message"]
        for row in RunFolder(str(tmp_path / "out")).table("warnings").to_pylist()
        if row["code"] == "batch_failed"
    ]
    assert len(told) == (step == "assign_assets")


@pytest.mark.parametrize("step", ["move", "prepare"])
def test_a_batch_that_fails_although_none_of_its_scenes_does_is_told(
    step: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(dataset)]).libraries[0].assets[1:4])))
    settings = replace(PLAIN, engine=EngineSettings(f"scripted:{script}"), scenes_per_shard=4, accept="clean", settle=False)
    real = getattr(corrector.PhysicsCorrector, step)

    def fails(self: corrector.PhysicsCorrector, scenes: Sequence[Any], *more: Any) -> Any:
        if len(scenes) > 1:
            raise ValueError("too many at once")
        return real(self, scenes, *more)

    monkeypatch.setattr(corrector.PhysicsCorrector, step, fails)
    generate(FOUR, str(tmp_path / "out"), settings, ALONE, [str(dataset)], report=False)
    assert len(ids(tmp_path / "out", "scenes")) == 4
    told = [row for row in RunFolder(str(tmp_path / "out")).table("warnings").to_pylist() if row["code"] == "batch_failed"]
    (row,) = told
    assert row["id"] == "task_0"
    assert row["message"].startswith("task_0 and 3 others: the batch failed, and each was computed alone: ValueError: too many")


@pytest.mark.parametrize(("module", "step"), [(answers, "assign_assets"), (shard, "relate_scene")], ids=["made", "judged"])
def test_a_full_disk_is_nobodys_scene(
    module: ModuleType, step: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "script.json"
    script.write_text(json.dumps(one_thing_a_stage(AssetLibraries([str(dataset)]).libraries[0].assets[1:4])))
    settings = replace(PLAIN, engine=EngineSettings(f"scripted:{script}"))

    def fails(*_: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, step, fails)
    with pytest.raises(OSError, match="No space left"):
        generate(FOUR, str(tmp_path / "out"), settings, ALONE, [str(dataset)], report=False)
    assert not ids(tmp_path / "out", "failures")


def test_weights_that_do_not_fit_the_features_are_refused_before_anything_is_written(dataset: Path, tmp_path: Path) -> None:
    settings = small_settings("set_transformer")
    settings = replace(settings, network=replace(settings.network, num_features=64))
    path = tmp_path / "physics_corrector.safetensors"
    save_corrector(path, settings, awake_network(settings).state_dict(), {"encoder_fingerprint": "another"})
    save_encoder(tiny_encoder(), path.with_name("point_encoder.safetensors"))
    job = replace(PLAIN, weights=str(path), engine=EngineSettings("embedded"))
    with pytest.raises(ConfigError, match=r"trained on the features of encoder another, found \w+; use the encoder") as caught:
        generate(FOUR, str(tmp_path / "out"), job, ALONE, [str(dataset)])
    assert caught.value.code == "encoder_mismatch"
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_the_folder_of_another_job_is_refused_and_stays_as_it_is(bare_run: Path, dataset: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(bare_run, tmp_path / "out"))
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(ConfigError, match="is a run of preprocess, expected a new folder or a run of generate") as caught:
        generate(FOUR, str(out), replace(PLAIN, engine=EngineSettings("embedded")), ALONE, [str(dataset)])
    assert caught.value.code == "config_changed"
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
