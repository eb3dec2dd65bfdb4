"""The systems of the paper's comparison in the job: the same tasks, judge and rows for each, and a reason where there is no scene."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from models.baselines.layout.prompts import OBJECTS_WANTED, RELATIONS_WANTED
from models.baselines.systems import system_named
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.__main__ import app
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.job import GenerateJob, generate
from pipelines.generate.report import TimeSpent
from pipelines.generate.settings import GenerateSettings
from pipelines.generate.shard import KEPT
from pipelines.settings import resolve_settings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource, sample_tasks
from pipelines.sources.tasks import read_tasks
from stable_data.errors import ConfigError
from stable_data.limits import MIB
from stable_data.metrics.alignment import AlignmentReference
from stable_data.metrics.matching import RequiredObject
from stable_data.scene import Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from tests.models.semantic_reasoner.engines.endpoint import Act, endpoint
from tests.models.semantic_reasoner.engines.endpoint import said as completion
from tests.pipelines.runs import content
from tests.pipelines.scripts import entry

pytestmark = pytest.mark.sim

ALONE = WorkerPool()
DESK = Tabletop("office_table", (1.2, 0.6))


@pytest.fixture(scope="module")
def shelf(dataset: Path) -> AssetLibraries:
    return AssetLibraries([str(dataset)])


@pytest.fixture(scope="module")
def tasks(shelf: AssetLibraries) -> TaskSource:
    """Three tasks with labels: each requires the first asset of the library."""
    category = shelf.libraries[0].assets[1].category
    required = AlignmentReference("task", (RequiredObject("it", (category,)),))
    said = ("Lift it.", "Turn it.", "Say nonsense")
    return TaskSource("tasks", [LayoutTask(f"task_{n}", s, DESK, reference=required) for n, s in enumerate(said)])


def rows_of(out: Path, table: str) -> list[Row]:
    found: list[Row] = RunFolder(str(out)).table(table).to_pylist()
    return found


def settings_of(name: str, engine: str, *more: str) -> GenerateSettings:
    overrides = [*system_named(name).overrides, f"engine.engine={json.dumps(engine)}", "num_pictures=0", *more]
    return resolve_settings(GenerateSettings, "generate", None, overrides)


@pytest.fixture(scope="module")
def listed(shelf: AssetLibraries) -> list[dict[str, Any]]:
    """Three assets as a list of objects names them."""
    return [
        {"category": a.category, "description": a.words, "size": entry(a, 0.0)["size"], "number": 1}
        for a in shelf.libraries[0].assets[1:4]
    ]


@pytest.fixture(scope="module")
def chatty(listed: list[dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> str:
    """An engine that answers the prompts of Holodeck and I-Design."""
    first, second, third = (f"{o['category']}_0" for o in listed)
    relations = [
        {"subject": first, "relation": "is at", "target": "middle_middle"},
        {"subject": second, "relation": "left of", "target": first},
        {"subject": third, "relation": "near", "target": first},
    ]
    script = {
        "Say nonsense": "what?",
        "That answer cannot be used": "what?",
        OBJECTS_WANTED: {"objects": listed},
        RELATIONS_WANTED: {"relations": relations},
    }
    path = tmp_path_factory.mktemp("chatty") / "script.json"
    path.write_text(json.dumps(script))
    return f"scripted:{path}"


@pytest.fixture(scope="module")
def placed(dataset: Path, tasks: TaskSource, chatty: str, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Runs of the two systems, made once each."""
    made: dict[str, Path] = {}

    def run(name: str) -> Path:
        if name not in made:
            made[name] = tmp_path_factory.mktemp(name) / "out"
            generate(tasks, str(made[name]), settings_of(name, chatty), ALONE, [str(dataset)])
        return made[name]

    return run


@pytest.mark.parametrize("name", ["holodeck", "idesign"])
def test_placed_layouts_are_judged_like_all_others(placed: Callable[[str], Path], name: str) -> None:
    out = placed(name)
    rows = rows_of(out, "scenes")
    assert [row["scene_id"] for row in rows] == ["task_0", "task_1"]
    for row in rows:
        assert (row["num_objects"], row["awt"]) == (3, 1.0)
        assert row["distractor_rate"] == pytest.approx(2 / 3)  # by labels: "Lift it." makes all three O^t
        assert [o["stage"] for o in row["objects"]] == ["task"] * 3
        assert row["move_mean_mm"] == 0.0  # nothing corrected them
        assert None not in (row["oc"], row["float_rate"], row["out_of_bounds_rate"], row["stable"])
    (failure,) = rows_of(out, "failures")
    assert (failure["id"], failure["code"]) == ("task_2", "reply_unusable")
    turns = {row["scene_id"]: row for row in rows_of(out, "turns") if not row["code"]}
    assert {row["stage"] for row in turns.values()} == {"whole"}
    assert all(row["tries"] == 2 and json.loads(row["reply"])["objects"] for row in turns.values())
    assert "own_prompts_only" not in {row["code"] for row in rows_of(out, "warnings")}
    (timing,) = (out / "timing").glob("*.json")
    spent = json.loads(timing.read_text())
    assert spent["place"] > 0
    assert spent.pop(KEPT) > 100 * MIB
    told = TimeSpent.of_run(RunFolder(str(out)))
    assert {**told.steps, "processor": told.processor, "scenes": told.num_scenes} == spent
    page = (out / "report" / "index.html").read_text()
    assert f"Layout: {name}. Corrector: none" in page


def test_boxes_of_holodeck_do_not_collide(placed: Callable[[str], Path]) -> None:
    assert all(row["oc"] == 0.0 for row in rows_of(placed("holodeck"), "scenes"))


def test_the_same_run_gives_the_same_bytes(
    placed: Callable[[str], Path], dataset: Path, tasks: TaskSource, chatty: str, tmp_path: Path
) -> None:
    generate(tasks, str(tmp_path), settings_of("holodeck", chatty), ALONE, [str(dataset)])
    assert content(tmp_path) == content(placed("holodeck"))


@pytest.fixture(scope="module")
def overlapping(shelf: AssetLibraries, tmp_path_factory: pytest.TempPathFactory) -> str:
    """An engine of this project's prompts that puts two things in one place."""
    first, second = shelf.libraries[0].assets[1:3]
    whole = {"objects": [entry(first, 50.0), entry(second, 60.0)]}
    empty: dict[str, Any] = {"objects": []}
    script = {"Say nonsense": "what?", "That answer cannot": "what?"} | {
        text: empty if "background" in text else whole for text in WANTED.values()
    }
    path = tmp_path_factory.mktemp("overlapping") / "script.json"
    path.write_text(json.dumps(script))
    return f"scripted:{path}"


@pytest.mark.parametrize("corrector", ["steerable", "mesatask"])
def test_post_processing_takes_the_place_of_the_corrector(
    dataset: Path, tasks: TaskSource, overlapping: str, tmp_path: Path, corrector: str
) -> None:
    settings = settings_of("steerable", overlapping, f"corrector={corrector}", "weights=none")
    generate(tasks, str(tmp_path / "out"), settings, ALONE, [str(dataset)])
    rows = rows_of(tmp_path / "out", "scenes")
    assert [row["scene_id"] for row in rows] == ["task_0", "task_1"]
    for row in rows:
        assert row["oc"] == 0.0
        assert row["move_max_mm"] > 1
        assert row["awt"] == 1.0
    page = (tmp_path / "out" / "report" / "index.html").read_text()
    assert f"Corrector: {corrector}, end" in page


def test_an_optimiser_that_does_not_reach_its_goal_is_named(
    dataset: Path, tasks: TaskSource, overlapping: str, tmp_path: Path
) -> None:
    """The released optimiser has no window for two objects; the scene is kept and judged as it is."""
    settings = settings_of("steerable", overlapping, "corrector=mesatask_released", "weights=none")
    generate(replace(tasks, tasks=tasks.tasks[:1]), str(tmp_path), settings, ALONE, [str(dataset)])
    (row,) = rows_of(tmp_path, "scenes")
    assert row["oc"] == 1.0
    codes = {w["code"]: w["message"] for w in rows_of(tmp_path, "warnings")}
    assert "no window can be solved" in codes["not_converged"]
    assert "unclean" in codes


def test_a_zero_shot_model_behind_an_endpoint_lays_out_whole_scenes(
    dataset: Path, shelf: AssetLibraries, tasks: TaskSource, tmp_path: Path
) -> None:
    first, second = shelf.libraries[0].assets[1:3]
    good = json.dumps({"objects": [entry(first, 20.0), entry(second, 90.0)]})

    def plan(words: str, _: int, body: dict[str, Any]) -> Act:
        is_whole = WANTED["whole"].strip() in words
        assert "You lay out tabletop scenes for robot simulation" in body["messages"][0]["content"]
        return Act(
            body=completion(f"Here is the scene:\n```json\n{good}\n```" if is_whole and "nonsense" not in words else "No.")
        )

    with endpoint(plan) as server:
        more = [f'engine.http.base_url="{server.settings().base_url}"', f"engine.cache={json.dumps(str(tmp_path / 'cache'))}"]
        settings = settings_of("zero_shot", "openai:gpt-4o", *more, "engine.http.prompt_price=2.5")
        generate(tasks, str(tmp_path / "out"), settings, ALONE, [str(dataset)])
    rows = rows_of(tmp_path / "out", "scenes")
    assert [(row["scene_id"], row["num_objects"], row["awt"]) for row in rows] == [("task_0", 2, 1.0), ("task_1", 2, 1.0)]
    assert {row["stage"] for row in rows_of(tmp_path / "out", "turns")} == {"whole"}
    assert sum(row["cost"] for row in rows_of(tmp_path / "out", "turns")) > 0
    assert [row["code"] for row in rows_of(tmp_path / "out", "failures")] == ["reply_unusable"]


def mesatask_answer(objects: list[dict[str, Any]]) -> str:
    layout = {"item_placement_zone": [0, 120, 0, 60], "objects": objects}
    return (
        "The task needs one object in the middle of the table; the other stands to its right.\n"
        "(thing_0, is at, middle center)\n(other_0, right of, thing_0)\n"
        f"Therefore, the scene layout is:\n**Final Answer**\n{json.dumps(layout)}<|im_end|>"
    )


@pytest.mark.parametrize("name", ["mesatask", pytest.param("mesatask_refined", marks=pytest.mark.slow)])
def test_the_dialect_of_mesatask_lays_out_whole_scenes(
    dataset: Path, shelf: AssetLibraries, tasks: TaskSource, tmp_path: Path, name: str
) -> None:
    first, second = shelf.libraries[0].assets[1:3]
    script = {
        "nonsense": "I reason and never come to an end.",
        "That answer cannot": "I reason.",
        "Task information:": mesatask_answer([entry(first, 50.0), entry(second, 60.0)]),
    }
    path = tmp_path / "script.json"
    path.write_text(json.dumps(script))
    generate(tasks, str(tmp_path / "out"), settings_of(name, f"scripted:{path}"), ALONE, [str(dataset)])
    rows = rows_of(tmp_path / "out", "scenes")
    assert [(row["scene_id"], row["awt"]) for row in rows] == [("task_0", 1.0), ("task_1", 1.0)]
    assert {row["oc"] for row in rows} == ({1.0} if name == "mesatask" else {0.0})
    assert {row["move_max_mm"] > 0 for row in rows} == {name == "mesatask_refined"}
    (failure,) = rows_of(tmp_path / "out", "failures")
    assert failure["code"] == "reply_unusable"
    assert "Final Answer" in failure["message"]


# --- scenes that another system has made ---------------------------------------------------------------------------------------


def test_scenes_of_a_run_are_judged_against_the_tasks(
    placed: Callable[[str], Path], dataset: Path, tasks: TaskSource, chatty: str, tmp_path: Path
) -> None:
    theirs = placed("idesign")
    settings = settings_of("files", chatty, f"layout_files={json.dumps(str(theirs))}")
    generate(tasks, str(tmp_path / "out"), settings, ALONE, [str(dataset)])
    known = {row["scene_id"]: row for row in rows_of(theirs, "scenes")}
    rows = rows_of(tmp_path / "out", "scenes")
    assert [row["scene_id"] for row in rows] == ["task_0", "task_1"]
    for row in rows:
        for column in ("objects", "oc", "float_rate", "awt", "num_objects", "settle_move_max_mm"):
            assert row[column] == known[row["scene_id"]][column], column
    (failure,) = rows_of(tmp_path / "out", "failures")
    assert (failure["id"], failure["code"]) == ("task_2", "layout_missing")
    assert str(theirs) in failure["message"]
    assert rows_of(tmp_path / "out", "turns") == []
    assert len(rows_of(tmp_path / "out", "assets")) == len(rows_of(theirs, "assets"))


def test_a_run_is_not_continued_with_other_layouts(
    placed: Callable[[str], Path], dataset: Path, tasks: TaskSource, chatty: str, tmp_path: Path
) -> None:
    theirs = tmp_path / "theirs"
    shutil.copytree(placed("idesign"), theirs)
    settings = settings_of("files", chatty, f"layout_files={json.dumps(str(theirs))}")
    generate(tasks, str(tmp_path / "out"), settings, ALONE, [str(dataset)])
    shutil.rmtree(theirs)
    shutil.copytree(placed("holodeck"), theirs)
    with pytest.raises(ConfigError, match=r"inputs\.layouts"):
        generate(tasks, str(tmp_path / "out"), settings, ALONE, [str(dataset)])


def test_scenes_of_a_folder_are_judged_against_the_tasks(real_data: Path, dataset: Path, chatty: str, tmp_path: Path) -> None:
    """A folder in the MesaTask format with real meshes, of which one layout is broken and one task has none."""
    theirs = tmp_path / "theirs"
    shutil.copytree(real_data, theirs)
    layouts = sorted(theirs.glob("Layout_info/*/*/layout.json"), key=lambda p: len(json.loads(p.read_text())["objects"]))
    for other in layouts[2:]:
        shutil.rmtree(other.parent)
    layouts[1].write_text("{")
    whole, broken = (path.parent.name for path in layouts[:2])
    asked = TaskSource("tasks", [LayoutTask(name, "Lift it.", DESK) for name in (whole, broken, "nobody")])
    settings = settings_of("files", chatty, f"layout_files={json.dumps(str(theirs))}")
    generate(asked, str(tmp_path / "out"), settings, ALONE, [str(dataset)])
    (row,) = rows_of(tmp_path / "out", "scenes")
    assert (row["scene_id"], row["task"]["task"]) == (whole, "Lift it.")
    assert row["num_objects"] == len(json.loads(layouts[0].read_text())["objects"])
    assert row["oc"] is not None
    failures = {row["id"]: row["code"] for row in rows_of(tmp_path / "out", "failures")}
    assert failures["nobody"] == "layout_missing"
    assert failures[broken] not in ("layout_missing", "unexpected")
    assert {row["code"] for row in rows_of(tmp_path / "out", "warnings")} >= {"table_differs"}


def test_all_systems_get_the_same_tasks_whatever_libraries_their_layouts_have(
    dataset: Path, shelf: AssetLibraries, chatty: str, tmp_path: Path
) -> None:
    theirs = tmp_path / "theirs"
    shutil.copytree(dataset, theirs)  # has all assets of the library that is named
    settings = settings_of("files", chatty, f"layout_files={json.dumps(str(theirs))}")
    hidden = AssetLibraries([str(dataset)], scenes=str(theirs), offers_scenes=False).serves(settings.retrieval)
    categories = {asset.category for library in shelf.libraries for asset in library.assets}
    assert {c: hidden(c) for c in categories} == {c: shelf.serves(settings.retrieval)(c) for c in categories}
    assert any(map(hidden, categories))
    asked = sample_tasks(2, 3)
    assert GenerateJob(asked, settings).tasks.tasks == asked.tasks  # without --assets, tasks are drawn for the embedded library


@pytest.mark.parametrize("place", ["nowhere", "empty"])
def test_a_place_without_scenes_is_refused(tasks: TaskSource, dataset: Path, chatty: str, tmp_path: Path, place: str) -> None:
    (tmp_path / "empty").mkdir()
    settings = settings_of("files", chatty, f"layout_files={json.dumps(str(tmp_path / place))}")
    with pytest.raises(ConfigError):
        generate(tasks, str(tmp_path / "out"), settings, ALONE, [str(dataset)])
    assert not (tmp_path / "out").exists()


# --- the command ---------------------------------------------------------------------------------------------------------------


def told(dataset: Path, *words: str) -> str:
    """What the command says of one instruction."""
    task = ["--instruction", "Lift it.", "--table", "office_table", "--size", "120", "60", "--assets", str(dataset)]
    result = CliRunner().invoke(app, ["generate", *task, "--out", "nowhere", *words])
    assert result.exit_code == 0, result.output
    assert not Path("nowhere").exists()
    return result.stdout


def test_a_name_stands_for_its_settings_and_explicit_ones_win(dataset: Path) -> None:
    plan = ("--system", "steerable", "--dry-run")
    assert json.loads(told(dataset, *plan))["settings"]["corrector"] == "steerable"
    found = json.loads(told(dataset, *plan, "--set", "corrects=each"))["settings"]
    assert (found["corrector"], found["corrects"], found["accept"]) == ("steerable", "each", "")


def test_tasks_are_written_for_another_system(dataset: Path, tmp_path: Path) -> None:
    assert "1 tasks" in told(dataset, "--write-tasks", str(tmp_path / "tasks.jsonl"))
    (task,) = read_tasks(tmp_path / "tasks.jsonl")
    assert isinstance(task, LayoutTask)
    assert (task.scene_id, task.instruction, task.table) == ("task", "Lift it.", DESK)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--system", "gpt"], "expected one of stable, one_shot"),
        (["--system", "files"], "layout_files is empty"),
    ],
)
def test_a_name_that_cannot_run_is_refused_with_what_it_lacks(words: list[str], says: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["generate", "--count", "2", "--out", str(tmp_path / "out"), *words])
    assert result.exit_code == 2
    assert says in result.output
    assert not (tmp_path / "out").exists()


def test_variants_are_not_laid_out_by_another_system(placed: Callable[[str], Path], tmp_path: Path) -> None:
    words = [
        "generate",
        "--scenes",
        str(placed("holodeck")),
        "--vary",
        "layout",
        "--out",
        str(tmp_path / "out"),
        "--system",
        "holodeck",
    ]
    result = CliRunner().invoke(app, [*words, "--workers", "0"])
    assert result.exit_code == 2
    assert "leave out --vary" in result.output


@pytest.mark.parametrize("name", ["zero_shot", "mesatask_refined", "holodeck", "idesign"])
def test_a_run_says_that_the_embedded_model_stands_in_for_another(name: str, tasks: TaskSource, dataset: Path) -> None:
    settings = settings_of(name, "embedded")
    odd = GenerateJob(tasks, replace(settings, engine=EngineSettings()), [str(dataset)]).odd()
    (notice,) = [notice for notice in odd if notice.code == "own_prompts_only"]
    assert notice.item_id == (settings.reasoner.dialect if settings.layout == "stages" else name)
    assert "name another model with --engine" in notice.message


@pytest.mark.slow
@pytest.mark.parametrize("name", ["zero_shot", "mesatask_refined"])
def test_the_embedded_model_stands_in_for_other_models(name: str, tmp_path: Path) -> None:
    generate(sample_tasks(1), str(tmp_path), replace(settings_of(name, "embedded"), engine=EngineSettings()), ALONE)
    (row,) = rows_of(tmp_path, "scenes")
    assert row["num_objects"] >= 3
    assert "own_prompts_only" in {row["code"] for row in rows_of(tmp_path, "warnings")}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["holodeck", "idesign"])
def test_the_embedded_model_exercises_the_searches_with_layouts_of_its_own(name: str, tmp_path: Path) -> None:
    generate(sample_tasks(2), str(tmp_path), replace(settings_of(name, "embedded"), engine=EngineSettings()), ALONE)
    rows = rows_of(tmp_path, "scenes")
    assert len(rows) == 2
    assert all(row["num_objects"] >= 3 and row["awt"] > 0 and row["out_of_bounds_rate"] == 0 for row in rows)
    assert [row["id"] for row in rows_of(tmp_path, "warnings") if row["code"] == "own_prompts_only"] == [name]
