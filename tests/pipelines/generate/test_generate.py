"""The generate job: each task is one accepted scene or one failure, the same wherever it is made."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from typer.testing import CliRunner

from models.semantic_reasoner.engines.registry import EMBEDDED, EngineSettings
from models.semantic_reasoner.factory import ReasonerSettings
from models.semantic_reasoner.language.category_statistics import CategoryStatistics
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import describe
from pipelines.execution.shard_step import Shard, ShardTask, ShardWriter
from pipelines.generate.job import GenerateJob, generate
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import GenerateWork
from pipelines.settings import resolve_settings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource, sample_tasks
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.run_assets import run_store
from stable_data.assets.store import AssetStore
from stable_data.cli import app as stable_data
from stable_data.embedded_world.sampling import sample_task
from stable_data.errors import ConfigError, Notice
from stable_data.mesatask import MesaTaskDataset
from stable_data.metrics.audit import audit_scene
from stable_data.scene import Scene, Stage, Tabletop
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import settle
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from stable_data.storage.table_rows import scene_from_row
from stable_data.storage.torch_dataset import TableStream
from tests.models.semantic_reasoner.engines.endpoint import Act, endpoint
from tests.models.semantic_reasoner.engines.endpoint import said as completion
from tests.pipelines.runs import content
from tests.pipelines.scripts import entry, one_thing_a_stage

ALONE = WorkerPool()
DESK = Tabletop("office_table", (1.2, 0.6))


@pytest.fixture(scope="module")
def shelf(dataset: Path) -> AssetLibraries:
    return AssetLibraries([str(dataset)])


@pytest.fixture(scope="module")
def settings(shelf: AssetLibraries, tmp_path_factory: pytest.TempPathFactory) -> GenerateSettings:
    """An engine that puts each stage's thing into that of the stage before, but for some words."""
    first, second, third = shelf.libraries[0].assets[1:4]
    odd = entry(first, 60.0, "elephant_0", "an elephant with a trunk as long as a river")
    script = {
        "Say nonsense": "what?",
        "That answer cannot be used": "what?",
        "Lift the elephant": {"objects": [odd]},
        WANTED[Stage.TASK]: {"objects": [entry(first, 20.0)]},
        WANTED[Stage.IMPORTANT]: {"objects": [entry(second, 21.0)]},
        WANTED[Stage.SECONDARY]: {"objects": [entry(third, 22.0)]},
    }
    path = tmp_path_factory.mktemp("script") / "script.json"
    path.write_text(json.dumps(script))
    return GenerateSettings(
        EngineSettings(f"scripted:{path}"), weights="none", scenes_per_shard=2, keep_settled=True, num_pictures=0
    )


def tasks(*words: str) -> TaskSource:
    return TaskSource("tasks", [LayoutTask(f"task_{n}", said, DESK) for n, said in enumerate(words)])


MIXED = replace(
    tasks("Lift it.", "Say nonsense", "Turn it.", "Lift the elephant", "Take it."),
    lost=[Notice("row 000006", "tasks", "task_invalid", "tasks.jsonl, row 6: no JSON")],
)


@pytest.fixture(scope="module")
def made(dataset: Path, settings: GenerateSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "out"
    manifest = generate(MIXED, str(out), settings, ALONE, [str(dataset)])
    assert manifest["status"] == "complete"
    return out


def rows_of(out: Path, table: str) -> list[Row]:
    found: list[Row] = RunFolder(str(out)).table(table).to_pylist()
    return found


def test_each_task_is_a_scene_or_a_failure(made: Path) -> None:
    assert {row["scene_id"] for row in rows_of(made, "scenes")} == {"task_0", "task_2", "task_4"}
    failures = {row["id"]: row["code"] for row in rows_of(made, "failures")}
    assert failures == {"task_1": "reply_unusable", "task_3": "asset_unmatched", "row 000006": "task_invalid"}
    counts = json.loads((made / "manifest.json").read_text())["counts"]
    assert (counts["scenes"], counts["failed_scenes"], counts["failures"]) == (3, 3, 3)


def test_what_is_accepted_is_clean_by_an_audit_of_its_own_and_at_rest(made: Path, shelf: AssetLibraries) -> None:
    store = AssetStore(shelf)
    for row in rows_of(made, "scenes"):
        scene = scene_from_row(row)
        resolved, shapes, _ = store.resolved(scene)
        assert resolved.poses().tolist() == scene.poses().tolist()
        assert audit_scene(resolved, shapes).card().clean
        rest = settle(bodies_of(resolved, shapes, store), resolved.table)
        assert row["stable"] is rest.stable is True
        assert row["settle_move_max_mm"] == rest.settle_move_max_mm
        assert row["settle_move_max_mm"] <= 10
        assert row["engine_penetration_mm"] is not None
        assert [o.stage for o in scene.objects] == list(Stage)
        assert row["distractor_rate"] is None  # its task has no labels
        assert row["move_max_mm"] > 10  # all three were proposed in one place
        assert row["source"] == "generated"


def test_every_turn_is_told(made: Path) -> None:
    turns = rows_of(made, "turns")
    assert [(t["stage"], t["turn"], t["code"]) for t in turns if t["scene_id"] == "task_0"] == [
        (str(stage), number, "") for number, stage in enumerate(Stage)
    ]
    for turn in (t for t in turns if t["scene_id"] == "task_2"):
        assert turn["card_after"]["clean"] is True
        assert turn["card_before"]["clean"] is (turn["turn"] == 0)
        assert len(turn["coarse"]) == len(turn["corrected"]) == turn["turn"] + 1
        assert json.loads(turn["reply"])["objects"]
    refused = [t for t in turns if t["scene_id"] == "task_1"]
    assert len(refused) == 3  # asked for as often as the settings say
    assert {t["code"] for t in refused} == {"reply_unusable"}
    assert all(t["refused"] == [["reply_not_json"]] * t["tries"] for t in refused)
    assert {t["code"] for t in turns if t["scene_id"] == "task_3"} == {"asset_unmatched"}


def test_a_run_in_which_nothing_could_be_made_ends_well(dataset: Path, settings: GenerateSettings, tmp_path: Path) -> None:
    manifest = generate(tasks("Say nonsense"), str(tmp_path / "out"), settings, ALONE, [str(dataset)])
    assert manifest["status"] == "complete"
    assert (manifest["counts"]["scenes"], manifest["counts"]["assets"]) == (0, 0)
    assert [row["code"] for row in rows_of(tmp_path / "out", "failures")] == ["reply_unusable"]
    assert (tmp_path / "out" / "report" / "index.html").is_file()


def two_side_by_side(shelf: AssetLibraries, script: Path) -> tuple[str, str]:
    """Writes a script that puts two things on every table, the first to the left; gives what they are called."""
    first, second = shelf.libraries[0].assets[1:3]
    assert first.category != second.category
    replies: dict[str, dict[str, Any]] = {
        wanted: {"objects": []} for wanted in (WANTED[Stage.IMPORTANT], WANTED[Stage.SECONDARY])
    }
    replies[WANTED[Stage.TASK]] = {"objects": [entry(first, 30.0), entry(second, 80.0)]}
    script.write_text(json.dumps(replies))
    return first.category.replace("_", " "), second.category.replace("_", " ")


def contradiction_of(one: str, other: str) -> str:
    """An instruction that is read as two claims of which one excludes the other."""
    interpret = InstructionInterpreter(CategoryStatistics.load(EMBEDDED))
    for a, b in ((one, other), (other, one)):
        for text in (
            f"The {a}, which is on the {b}, is under the {b}. Clear up.",
            f"The {a} that is on the {b} is also under the {b}. Clear up.",
            f"The {a} is on top of the {b}. The {b} rests on that {a}. Clear up.",
            f"The {a} is on the {b} and the {b} is on the {a}. Clear up.",
            f"The {a} is left of the {b}, and the {b} is left of the {a}. Clear up.",
        ):
            found = interpret(text)
            if found.stated is not None and (len(found.stated.required), len(found.stated.entailed)) == (2, 2):
                return text
    raise AssertionError("none is read as a contradiction")


def test_what_an_instruction_says_of_the_start_and_does_not_hold_is_named(
    dataset: Path, settings: GenerateSettings, shelf: AssetLibraries, tmp_path: Path
) -> None:
    """Of two claims that exclude each other one is broken, whatever is made of them; nothing is said where all is as it is said."""
    one, other = two_side_by_side(shelf, tmp_path / "script.json")
    asked = tasks(
        f"The {one} is to the left of the {other}. Move it behind.",
        contradiction_of(one, other),
        f"Lift the {one} that is in the back right corner.",
    )
    reads = ReasonerSettings(statistics=str(EMBEDDED), tries=1)
    own = replace(settings, engine=EngineSettings(f"scripted:{tmp_path / 'script.json'}"), reasoner=reads)
    generate(asked, str(tmp_path / "out"), own, ALONE, [str(dataset)])
    assert len(rows_of(tmp_path / "out", "scenes")) == 3
    named = [row["id"] for row in rows_of(tmp_path / "out", "warnings") if row["code"] == "not_as_said"]
    assert set(named) == {"task_1"}
    moved = {row["id"] for row in rows_of(tmp_path / "out", "warnings") if row["code"] == "moved_to_hold"}
    assert moved == {"task_1", "task_2"}
    assert [row["id"] for row in rows_of(tmp_path / "out", "warnings") if row["code"] == "contradiction"] == []
    held = {row["scene_id"]: row["aws_understood"] for row in rows_of(tmp_path / "out", "scenes")}
    assert {row["aws"] for row in rows_of(tmp_path / "out", "scenes")} == {None}  # tasks of a user have no labels
    # Nothing is in the corner in the reply to the last, so what it asks for is moved there.
    assert [held[f"task_{k}"] for k in range(3)] == [1.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("accept", "accepted"),
    [
        ("clean and aws_understood >= 1", {"task_1"}),
        ("clean and (aws_understood is None or aws_understood >= 1)", {"task_0", "task_1"}),
    ],
)
def test_an_instruction_that_says_nothing_of_the_start_is_accepted_where_the_rule_takes_what_is_unknown(
    dataset: Path, settings: GenerateSettings, shelf: AssetLibraries, tmp_path: Path, accept: str, accepted: set[str]
) -> None:
    one, other = two_side_by_side(shelf, tmp_path / "script.json")
    asked = tasks(
        f"Lift the {one}.",
        f"The {one} is to the left of the {other}. Move it behind.",
        contradiction_of(one, other),
    )
    own = replace(
        settings,
        engine=EngineSettings(f"scripted:{tmp_path / 'script.json'}"),
        reasoner=ReasonerSettings(statistics=str(EMBEDDED), tries=1),
        accept=accept,
    )
    generate(asked, str(tmp_path / "out"), own, ALONE, [str(dataset)])
    assert {row["scene_id"] for row in rows_of(tmp_path / "out", "scenes")} == accepted
    known = {
        row["scene_id"]: row["aws_understood"] for table in ("scenes", "rejected") for row in rows_of(tmp_path / "out", table)
    }
    assert known == {"task_0": None, "task_1": 1.0, "task_2": 0.5}
    reasons = {row["scene_id"]: row["reason"] for row in rows_of(tmp_path / "out", "rejected")}
    assert "aws_understood is 0.5" in reasons["task_2"]
    assert "aws_understood is unknown" in reasons.get("task_0", "aws_understood is unknown")


def test_settled_poses_are_kept_beside(made: Path) -> None:
    scenes = {row["scene_id"]: row for row in rows_of(made, "scenes")}
    settled = rows_of(made, "settled")
    assert {row["scene_id"] for row in settled} == set(scenes)
    for row in settled:
        corrected = {o["instance"]: o["position"] for o in scenes[row["scene_id"]]["objects"]}
        for pose in row["poses"]:
            assert pose["position"] == pytest.approx(corrected[pose["instance"]], abs=0.01)


def test_what_breaks_the_rule_is_rejected_said_why_and_kept(dataset: Path, settings: GenerateSettings, tmp_path: Path) -> None:
    strict = replace(settings, accept="clean and stable and num_objects >= 4", keep_settled=False)
    manifest = generate(tasks("Lift it."), str(tmp_path), strict, ALONE, [str(dataset)])
    assert (manifest["counts"]["scenes"], manifest["counts"]["rejected"]) == (0, 1)
    (row,) = rows_of(tmp_path, "rejected")
    assert row["code"] == "rejected"
    assert "num_objects is 3" in row["reason"]
    assert row["clean"] is True
    (failure,) = rows_of(tmp_path, "failures")
    assert failure["message"] == f"task_0: {row['reason']}"
    assert not rows_of(tmp_path, "settled")


def test_a_scene_whose_rest_is_unknown_is_not_accepted(
    dataset: Path, settings: GenerateSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stable_data.errors import MeshError

    def refuse(*_: Any) -> Any:
        raise MeshError("nothing solid", "no_collider")

    for module in ("pipelines.correct.judging", "models.physics_corrector.stabilization.stabilize"):
        monkeypatch.setattr(f"{module}.bodies_of", refuse)
    generate(tasks("Lift it."), str(tmp_path), settings, ALONE, [str(dataset)])
    (row,) = rows_of(tmp_path, "rejected")
    assert "stable is unknown" in row["reason"]
    assert row["stable"] is None
    assert "not_settled" in {w["code"] for w in rows_of(tmp_path, "warnings")}


@pytest.mark.parametrize("corrects", ["never", "end"])
def test_the_ablations_correct_never_or_once(dataset: Path, settings: GenerateSettings, tmp_path: Path, corrects: Any) -> None:
    bare = replace(settings, corrects=corrects, accept="")
    generate(tasks("Lift it."), str(tmp_path), bare, ALONE, [str(dataset)])
    (row,) = rows_of(tmp_path, "scenes")
    assert row["clean"] is (corrects == "end")
    assert [t["card_after"] for t in rows_of(tmp_path, "turns")] == [None] * 3
    assert (row["move_max_mm"] > 10) is (corrects == "end")


def test_layouts_that_are_not_corrected_become_a_folder_of_the_format(
    dataset: Path, shelf: AssetLibraries, tmp_path: Path
) -> None:
    """By the command lines that docs/generate.md has."""
    chosen = shelf.libraries[0].assets[1:4]
    script, run, out = tmp_path / "script.json", tmp_path / "run", tmp_path / "out"
    odd = {"Say nonsense": "what?", "That answer cannot be used": "what?", "Say nothing": {"objects": []}}
    script.write_text(json.dumps(odd | one_thing_a_stage(chosen)))
    row = {"instruction": "Lift it.", "table_type": "Office Table", "table_size_cm": [120, 60]}
    asked = [
        row | {"scene_id": "mine", "restricted_zone_cm": [60, 120, 0, 60]},
        row,
        *(row | {"instruction": said} for said in ("Say nonsense", "Say nothing", "word " * 500)),
    ]
    (tmp_path / "tasks.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in [*asked, row | {"colour": "red"}]))
    raw = ["--set", "corrects=never", "--set", "accept=", "--set", "num_pictures=0"]
    where = ["--workers", "0", "--assets", str(dataset), "--engine", f"scripted:{script}", "--out", str(run)]
    done = CliRunner().invoke(app, ["generate", "--tasks", str(tmp_path / "tasks.jsonl"), *raw, *where])
    assert done.exit_code == 1, done.output
    assert "2 of 6 scenes accepted" in done.output
    assert {row["id"]: row["code"] for row in rows_of(run, "failures")} == {
        "task_000003": "reply_unusable",
        "task_000004": "layout_empty",
        "row 000005": "instruction_invalid",
        "row 000006": "task_invalid",
    }
    assert [row["clean"] for row in rows_of(run, "scenes")] == [False, False]  # all three things are in one place
    done = CliRunner().invoke(stable_data, ["export", str(run), str(out), "--format", "mesatask"])
    assert done.exit_code == 0, done.output
    made = MesaTaskDataset(out)
    assert made.scene_ids == ("mine", "task_000002")
    for scene_id in made.scene_ids:
        scene, notices = made.read(scene_id)
        assert not notices
        assert [o.asset_id for o in scene.objects] == [asset.asset_id for asset in chosen]
        assert [o.position[:2] for o in scene.objects] == [pytest.approx((0.2, 0.3))] * 3
        assert scene.task is not None
        assert (scene.task.task, scene.task.task_objects) == ("Lift it.", (f"{chosen[0].category}_0",))
    assert made.read("mine")[0].table == Tabletop("office_table", (1.2, 0.6), (0.6, 1.2, 0.0, 0.6))
    assert set(made.annotations) == {asset.asset_id for asset in chosen}
    assert all(made.asset_path(asset.asset_id) for asset in chosen)


def test_the_command_makes_a_scene_of_one_instruction(dataset: Path, settings: GenerateSettings, tmp_path: Path) -> None:
    words = [
        "--instruction",
        "Lift it.",
        "--table",
        "Office Table",
        "--size",
        "120",
        "60",
        "--restricted",
        "60",
        "120",
        "0",
        "60",
    ]
    where = ["--workers", "0", "--assets", str(dataset), "--engine", settings.engine.engine, "--out", str(tmp_path)]
    done = CliRunner().invoke(app, ["generate", *words, *where, "--set", "weights=none", "--set", "num_pictures=0"])
    assert done.exit_code == 0, done.output
    (row,) = rows_of(tmp_path, "scenes")
    assert (row["scene_id"], row["clean"], row["stable"]) == ("task", True, True)
    assert scene_from_row(row).table == Tabletop("office_table", (1.2, 0.6), (0.6, 1.2, 0.0, 0.6))


def test_a_task_has_the_same_seeds_wherever_it_stands(shelf: AssetLibraries, dataset: Path, tmp_path: Path) -> None:
    answers = {words: json.dumps(reply) for words, reply in one_thing_a_stage(shelf.libraries[0].assets[1:4]).items()}
    many = tasks("Lift it.", "Turn it.", "Take it.")
    heard: list[set[tuple[str, int]]] = []
    for number, asked in enumerate((many, replace(many, tasks=many.tasks[1:2]))):

        def plan(words: str, _: int, body: dict[str, Any]) -> Act:
            heard[-1].add((words, body["seed"]))
            return Act(body=completion(next(reply for wanted, reply in answers.items() if wanted in words)))

        heard.append(set())
        with endpoint(plan) as server:
            engine = EngineSettings("openai:large", http=server.settings())
            own = GenerateSettings(engine, weights="none", corrects="never", accept="", num_pictures=0)
            generate(asked, str(tmp_path / str(number)), own, ALONE, [str(dataset)], report=False)
    assert heard[1] < heard[0]
    assert len({seed for _, seed in heard[0]}) == 3 * len(Stage)


@pytest.mark.parametrize("table", GenerateWork.TABLES)
def test_a_shard_that_is_missing_is_made_again(
    dataset: Path, settings: GenerateSettings, made: Path, tmp_path: Path, table: str
) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    max((out / table).glob("part-*.parquet")).unlink()
    generate(MIXED, str(out), settings, ALONE, [str(dataset)])
    assert content(out) == content(made)


@pytest.mark.ray
@pytest.mark.usefixtures("local_ray")
def test_ray_gives_the_same_bytes_as_this_process(
    dataset: Path, settings: GenerateSettings, made: Path, tmp_path: Path
) -> None:
    generate(MIXED, str(tmp_path), settings, WorkerPool(2), [str(dataset)])
    assert content(tmp_path) == content(made)


@pytest.mark.slow
def test_engines_that_workers_share_give_the_same_scenes(
    dataset: Path, settings: GenerateSettings, made: Path, tmp_path: Path
) -> None:
    generate(MIXED, str(tmp_path), replace(settings, engines=1), WorkerPool(2), [str(dataset)])
    for table in ("scenes", "failures", "turns"):  # in other shards, as other settings
        assert sorted(map(str, rows_of(tmp_path, table))) == sorted(map(str, rows_of(made, table)))


@pytest.mark.slow
def test_shared_engines_that_cannot_be_loaded_are_said_in_one_line(dataset: Path, tmp_path: Path) -> None:
    broken = GenerateSettings(EngineSettings("openai:gpt"), weights="none", engines=1)
    with pytest.raises(ConfigError, match="base_url"):
        generate(tasks("Lift it."), str(tmp_path), broken, WorkerPool(1), [str(dataset)])


@pytest.mark.slow
@pytest.mark.parametrize("weights", ["none", "auto"])
def test_a_shard_over_which_workers_died_gives_the_same_rows(
    weights: str, dataset: Path, settings: GenerateSettings, tmp_path: Path
) -> None:
    own = replace(settings, weights=weights)
    for isolated in (False, True):
        write = ShardWriter(str(tmp_path / str(isolated)), (GenerateWork((str(dataset),), own),))
        done = write(ShardTask(0, Shard("0" * 16, tuple(MIXED.tasks[:2]))), isolated=isolated)
        assert (done.num_items, done.num_failures, len(done.checksums)) == (2, 1, len(GenerateWork.TABLES))
    assert content(tmp_path / "True") == content(tmp_path / "False")


def test_another_configuration_is_refused(dataset: Path, settings: GenerateSettings, made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    for other, message in (
        (replace(settings, seed=1), "seed: 0 -> 1"),
        (replace(settings, accept=""), "accept: clean and stable -> "),
        (replace(settings, corrects="end"), "corrects: each -> end"),
    ):
        with pytest.raises(ConfigError, match=message) as caught:
            generate(MIXED, str(out), other, ALONE, [str(dataset)])
        assert caught.value.code == "config_changed"
    with pytest.raises(ConfigError, match=r"inputs.tasks: \w+ -> \w+"):
        generate(replace(MIXED, tasks=MIXED.tasks[1:]), str(out), settings, ALONE, [str(dataset)])
    assert content(out) == content(made)


def test_a_training_job_reads_the_run(made: Path) -> None:
    scenes = list(TableStream(str(made), where="stable and num_objects >= 3"))
    assert [type(s) for s in scenes] == [Scene] * 3
    assert all(s.task is not None and s.task.task_objects for s in scenes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schedule": "task,edit"}, "schedule has 'edit'"),
        ({"schedule": "secondary"}, "expected task or whole first"),
        ({"accept": "steady"}, "names steady"),
        ({"scenes_per_shard": -1}, "scenes_per_shard is -1"),
        ({"seconds_per_item": float("nan")}, "seconds_per_item is nan"),
        ({"earlier_move": -1.0}, "earlier_move is -1.0, expected at least 0"),
        ({"engines": 1, "engine_gpus": 1.5}, "engine_gpus is 1.5, expected a fraction of a GPU or a whole number"),
        ({"engines": 1, "engine_gpus": float("nan")}, "engine_gpus is nan"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GenerateSettings(**change)


@pytest.mark.parametrize(
    ("count", "size"), [(0, 16), (10, 16), (200, 25), (768, 96), (769, 97), (1_024, 128), (1_000_000, 128)]
)
def test_a_small_job_has_eight_shards_and_a_large_one_shards_that_fill_batches(count: int, size: int) -> None:
    assert GenerateSettings().of_tasks(count).scenes_per_shard == size
    assert GenerateSettings(scenes_per_shard=64).of_tasks(count).scenes_per_shard == 64


def test_what_a_run_chose_by_itself_can_be_named_when_it_goes_on(
    dataset: Path, settings: GenerateSettings, tmp_path: Path
) -> None:
    by_itself, of_sixteen, out = replace(settings, scenes_per_shard=0), replace(settings, scenes_per_shard=16), tmp_path / "out"
    generate(MIXED, str(out), by_itself, ALONE, [str(dataset)], report=False)
    was = content(out)
    generate(MIXED, str(out), of_sixteen, ALONE, [str(dataset)], report=False)
    assert content(out) == was
    plans = [describe(GenerateJob(MIXED, each, [str(dataset)])) for each in (by_itself, of_sixteen)]
    assert plans[0] == plans[1]
    assert plans[0]["num_shards"] == 1


def test_settings_of_all_parts_are_settings_of_the_job(dataset: Path, tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text(
        '[generate]\nschedule = "whole"\n[generate.retrieval]\nlicences = ["CC0"]\n[generate.engine.sampling]\ntop_k = 7\n'
    )
    found = resolve_settings(
        GenerateSettings, "generate", file, ["retrieval.top_k_text=20", "engine.http.tries=3", "reasoner.tries=2"]
    )
    assert found.retrieval == RetrievalSettings(licences=frozenset({"CC0"}), top_k_text=20)
    assert (found.schedule, found.engine.sampling.top_k, found.engine.http.tries, found.reasoner.tries) == ("whole", 7, 3, 2)
    plan = json.loads(json.dumps(describe(GenerateJob(tasks("Lift it."), found, [str(dataset)]))))
    assert plan["settings"]["retrieval"]["licences"] == ["CC0"]
    for wrong in ("retrieval.licences=CC0", "retrieval.top_k_text=many", "engine.engine=gpt", "scenes_per_shard=-1"):
        with pytest.raises(ConfigError):
            resolve_settings(GenerateSettings, "generate", None, [wrong])


def test_no_task_at_all_is_refused_before_anything_is_written(settings: GenerateSettings, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="contains no usable task"):
        generate(TaskSource.of("tasks", MIXED.lost), str(tmp_path / "out"), settings, ALONE)
    assert not (tmp_path / "out").exists()


def test_the_run_holds_the_assets_that_it_uses(made: Path, shelf: AssetLibraries) -> None:
    """It is looked at and exported without the libraries."""
    used = {o["asset_id"] for table in ("scenes", "rejected") for row in rows_of(made, table) for o in row["objects"]}
    assert {row["asset_id"] for row in rows_of(made, "assets")} == {row["asset_id"] for row in rows_of(made, "meshes")} == used
    store = run_store(str(made))
    for row in rows_of(made, "scenes"):
        scene = scene_from_row(row)
        resolved, shapes, _ = store.resolved(scene)
        assert audit_scene(resolved, shapes).card().clean
        assert settle(bodies_of(resolved, shapes, store), resolved.table).stable


def test_the_report_tells_of_scenes_time_cost_and_coverage(
    dataset: Path, settings: GenerateSettings, made: Path, shelf: AssetLibraries, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    shown = replace(settings, num_pictures=3, core_hour_price=0.05)
    generate(MIXED, str(out), shown, ALONE, [str(dataset)])
    page = (out / "report" / "index.html").read_text("utf-8")
    for said in (
        "3 / 6",
        "scenes accepted",
        "core seconds per scene",
        "cost per 1,000 accepted scenes",
        "reply_unusable",
        "certify",
    ):
        assert said in page
    used = {o["asset_id"] for row in rows_of(made, "scenes") for o in row["objects"]}
    library = shelf.usable(settings.retrieval)
    assert used < library.keys()
    assert re.search(rf"assets of the library that are used +{len(used)} of {len(library)} \(", page)
    kinds = {library[name] for name in used}, set(library.values())
    assert re.search(rf"categories of the library that are used +{len(kinds[0])} of {len(kinds[1])} \(", page)
    assert page.count("<img") == 3
    with Image.open(out / "report" / "contact_sheet.png") as sheet:
        assert sheet.width > 3 * 384
    manifest = json.loads((out / "manifest.json").read_text())
    assert [work["scenes"] for work in manifest["work"]] == [5]  # what was there is not counted again


def test_drawn_tasks_are_drawn_where_they_are_needed(dataset: Path, settings: GenerateSettings, tmp_path: Path) -> None:
    settings = replace(settings, only_served="never")
    manifest = generate(sample_tasks(3, 1), str(tmp_path), settings, ALONE, [str(dataset)])
    rows = rows_of(tmp_path, "scenes")
    assert manifest["counts"]["failed_scenes"] == 3 - len(rows)
    assert rows
    for row in rows:
        number = int(row["scene_id"].removesuffix("_seed1").rpartition("_")[2])
        sampled = sample_task(number, 1).task
        assert sampled is not None
        assert row["task"]["task"] == sampled.task


def test_a_run_serves_as_a_library_and_its_convex_parts_are_kept(
    settings: GenerateSettings, made: Path, tmp_path: Path
) -> None:
    generate(tasks("Lift it."), str(tmp_path), settings, ALONE, [str(made)])
    assert [row["scene_id"] for row in rows_of(tmp_path, "scenes")] == ["task_0"]
    before, after = ({row["asset_id"]: row["parts"] for row in rows_of(run, "meshes")} for run in (made, tmp_path))
    assert after == {asset_id: before[asset_id] for asset_id in after}
