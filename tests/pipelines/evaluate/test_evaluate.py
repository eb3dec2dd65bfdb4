"""The evaluate job: systems on the same tasks, with figures, notes on what is missing, and a page."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from models.baselines.layout.prompts import OBJECTS_WANTED, RELATIONS_WANTED
from models.scene_rating.settings import RatingSettings
from models.semantic_reasoner.engines.registry import EngineSettings
from models.semantic_reasoner.staged_layout import LayoutTask
from models.semantic_reasoner.text.prompt import WANTED
from pipelines.__main__ import app
from pipelines.evaluate.collect import RunsOfSystem, of_similar_size, read_reference, read_repetition
from pipelines.evaluate.figures import FIGURES
from pipelines.evaluate.job import evaluate
from pipelines.evaluate.report import evaluation_text
from pipelines.evaluate.settings import EvaluateSettings
from pipelines.evaluate.systems import EvaluatedSystem, parse_systems
from pipelines.execution.ray_executor import WorkerPool
from pipelines.generate.settings import GenerateSettings
from pipelines.rate.settings import RateSettings
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.generation_tasks import TaskSource
from pipelines.views import shard
from pipelines.views.settings import ViewsSettings
from stable_data.cli import app as stable_data
from stable_data.commands.command_line import DONE, SOME_FAILED
from stable_data.errors import ConfigError, Notice, SceneError
from stable_data.metrics.alignment import AlignmentReference
from stable_data.metrics.matching import RequiredObject
from stable_data.rating.criteria import KEYS
from stable_data.scene import Stage, Tabletop
from stable_data.simulation.offscreen import can_render
from stable_data.simulation.views import draw_scored_views
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import notice_row
from tests.pipelines.runs import content
from tests.pipelines.scripts import entry

pytestmark = [pytest.mark.sim, pytest.mark.skipif(not can_render(), reason="this machine cannot render")]

ALONE = WorkerPool()
DESK = Tabletop("office_table", (1.2, 0.6))


@pytest.fixture(scope="module")
def engine(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """An engine that answers Holodeck's questions, those for a whole layout and those by stages, but for one task."""
    assets = AssetLibraries([str(dataset)]).libraries[0].assets[1:3]
    listed = [{"category": a.category, "description": a.words, "size": entry(a, 0.0)["size"], "number": 1} for a in assets]
    script: dict[str, Any] = {
        "Say nonsense": "what?",
        "That answer cannot be used": "what?",
        OBJECTS_WANTED: {"objects": listed},
        RELATIONS_WANTED: {"relations": []},
        WANTED["whole"]: {"objects": [entry(a, 30.0 + 40.0 * k) for k, a in enumerate(assets)]},
        WANTED[Stage.TASK]: {"objects": [entry(a, 30.0 + 40.0 * k) for k, a in enumerate(assets)]},
        WANTED[Stage.IMPORTANT]: {"objects": []},
        WANTED[Stage.SECONDARY]: {"objects": []},
    }
    path = tmp_path_factory.mktemp("engine") / "script.json"
    path.write_text(json.dumps(script))
    return f"scripted:{path}"


@pytest.fixture(scope="module")
def tasks(dataset: Path) -> TaskSource:
    """Three tasks with labels, of which the last one has no scene."""
    category = AssetLibraries([str(dataset)]).libraries[0].assets[1].category
    required = AlignmentReference("task", (RequiredObject("it", (category,)),))
    it = category.replace("_", " ")
    said = (f"Lift the {it}.", f"Turn the {it}.", "Say nonsense")
    return TaskSource("tasks", [LayoutTask(f"task_{n}", s, DESK, reference=required) for n, s in enumerate(said)])


@pytest.fixture(scope="module")
def settings(engine: str) -> EvaluateSettings:
    return EvaluateSettings(
        systems=("holodeck", "one_shot", "zero_shot=scripted:/nowhere.json", "files"),
        num_pictures=2,
        generate=GenerateSettings(engine=EngineSettings(engine), num_pictures=0, weights="none"),
        views=ViewsSettings(width=64, height=48, features="gradients"),
        rate=RateSettings(),
    )


@pytest.fixture(scope="module")
def evaluated(
    tasks: TaskSource, settings: EvaluateSettings, dataset: Path, tiny_run: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("evaluated") / "out"
    found = evaluate(lambda _: tasks, str(out), settings, ALONE, [str(dataset)])
    assert found.has_failed
    (out / "text.txt").write_text(evaluation_text(found))
    return out, json.loads((out / "evaluation.json").read_text())


def test_an_evaluation_is_whole_until_a_figure_is_edited(evaluated: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    done = CliRunner().invoke(stable_data, ["verify", str(evaluated[0]), "--verdicts", "audit"])
    assert done.exit_code == DONE, done.stdout
    assert done.stdout.splitlines()[-1].endswith("whole (evaluate; 6 of 6 runs are whole)")
    copy = Path(shutil.copytree(evaluated[0], tmp_path / "copy"))
    found = json.loads((copy / "evaluation.json").read_text())
    found["systems"]["one_shot"]["figures"]["made"]["value"] = 100.0
    (copy / "evaluation.json").write_text(json.dumps(found))
    next((copy / "seed_0" / "one_shot" / "ratings" / "ratings").iterdir()).unlink()
    done = CliRunner().invoke(stable_data, ["verify", str(copy), "--verdicts", "none"])
    assert done.exit_code == SOME_FAILED
    assert "evaluation.json: its digest is" in done.stdout
    assert "seed_0/one_shot/ratings/ratings/part-" in done.stdout
    assert "not whole (evaluate; 5 of 6 runs are whole)" in done.stdout


def test_all_systems_are_judged_on_all_tasks(evaluated: tuple[Path, dict[str, Any]]) -> None:
    _, found = evaluated
    assert (found["num_tasks"], list(found["systems"])) == (3, ["holodeck", "one_shot", "zero_shot", "files"])
    for label in ("holodeck", "one_shot"):
        figures = found["systems"][label]["figures"]
        assert figures["made"]["value"] == pytest.approx(200 / 3)
        assert figures["awt"]["value"] == pytest.approx(200 / 3)  # the task without a scene counts as 0
        assert (figures["num_objects"]["value"], figures["num_objects"]["known"]) == (2.0, 2)
        assert figures["average"]["value"] is not None
        assert figures["vendi_pictures"]["value"] >= 1.0
        assert figures["processor_seconds"]["value"] > 0
        assert figures["seconds"]["value"] > 0
        assert figures["cost"]["value"] == 0.0
    assert found["systems"]["one_shot"]["figures"]["ready"]["value"] == pytest.approx(200 / 3)


def test_a_named_system_that_cannot_be_run_is_a_failure(
    tasks: TaskSource, settings: EvaluateSettings, dataset: Path, tmp_path: Path
) -> None:
    found = evaluate(lambda _: tasks, str(tmp_path / "out"), replace(settings, systems=("files",)), ALONE, [str(dataset)])
    assert found.has_failed


def test_what_is_missing_is_unknown_with_what_to_do(evaluated: tuple[Path, dict[str, Any]]) -> None:
    out, found = evaluated
    systems = found["systems"]
    for label, says in (("zero_shot", "/nowhere.json"), ("files", "needs --system files=PLACE")):
        assert all(figure["value"] is None for figure in systems[label]["figures"].values())
        assert any(says in note for note in systems[label]["notes"]), systems[label]["notes"]
    assert systems["holodeck"]["figures"]["frechet"]["value"] is None
    for says in ("--reference RUN", "features --fetch inception", "--judge openai:MODEL"):
        assert any(says in note for note in found["notes"])
    text = (out / "text.txt").read_text()
    assert "zero_shot: seed 0 was not run" in text
    assert "tasks with a scene, %" in text


def test_the_page_has_measured_and_published_figures_apart(evaluated: tuple[Path, dict[str, Any]]) -> None:
    page = (evaluated[0] / "report" / "index.html").read_text()
    assert page.count("<img") == 4  # two tasks, two systems
    before, published = page.split("Published: STABLE")
    assert "Measured here" in before
    assert "99.4" not in before
    assert "99.4" in published
    assert "not run" in page


def test_the_same_again_changes_nothing_and_systems_can_be_added(
    evaluated: tuple[Path, dict[str, Any]], tasks: TaskSource, settings: EvaluateSettings, dataset: Path
) -> None:
    out, first = evaluated
    before = {name: content(out / "seed_0" / name / "scenes") for name in ("holodeck", "one_shot")}
    more = replace(settings, systems=(*settings.systems[:2], f"mine:files={out}/seed_0/holodeck/scenes"))
    evaluate(lambda _: tasks, str(out), more, ALONE, [str(dataset)])
    assert {name: content(out / "seed_0" / name / "scenes") for name in before} == before
    found = json.loads((out / "evaluation.json").read_text())["systems"]
    for label in ("holodeck", "one_shot"):
        same = {k: v for k, v in first["systems"][label]["figures"].items() if not k.startswith("vendi")}
        assert {k: v for k, v in found[label]["figures"].items() if k in same} == same
    _assert_same_figures(found["mine"], found["holodeck"])


def _assert_same_figures(one: dict[str, Any], other: dict[str, Any]) -> None:
    """The scenes of another system are judged as they were there; core seconds and such are of the system."""
    for figure in FIGURES:
        if figure.per != "set":
            assert one["figures"][figure.key] == other["figures"][figure.key], figure.key


@pytest.mark.slow
def test_what_a_reasoner_takes_for_task_objects_does_not_count(
    tasks: TaskSource, settings: EvaluateSettings, dataset: Path, tmp_path: Path
) -> None:
    """Its first stage has both objects, of which the task requires one; a reader of files knows nothing of stages."""
    for systems in (("stable",), ("stable", f"mine:files={tmp_path}/seed_0/stable/scenes")):
        evaluate(lambda _: tasks, str(tmp_path), replace(settings, systems=systems), ALONE, [str(dataset)], report=False)
    found = json.loads((tmp_path / "evaluation.json").read_text())["systems"]
    rows = RunFolder(f"{tmp_path}/seed_0/stable/scenes").table("scenes").to_pylist()
    assert [[o["stage"] for o in row["objects"]] for row in rows] == [[str(Stage.TASK)] * 2] * 2
    assert found["stable"]["figures"]["distractor_rate"]["value"] == pytest.approx(50.0)
    assert all(found["stable"]["figures"][key]["value"] is not None for key in ("oc", "awt", *KEYS))
    _assert_same_figures(found["mine"], found["stable"])


@pytest.mark.slow
def test_pictures_are_compared_with_those_of_a_reference(
    tasks: TaskSource, settings: EvaluateSettings, dataset: Path, evaluated: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    scenes = f"{evaluated[0]}/seed_0/holodeck/scenes"
    drawn = tmp_path / "drawn"
    alone = replace(settings, systems=(f"same:files={scenes}",), reference=scenes, reference_pictures=str(drawn))
    found = evaluate(lambda _: tasks, str(tmp_path), alone, ALONE, [str(dataset)], report=False)
    assert RunFolder(str(drawn)).num_rows("views") == 2
    assert not (tmp_path / "reference").exists()
    assert found.names["frechet"] == "Frechet distance (gradients)"
    assert found.estimates["same"]["frechet"].value == pytest.approx(0.0, abs=1e-6)
    spent = ("processor_seconds", "seconds", "tokens", "cost")
    assert all(found.estimates["same"][key].value is None for key in spent)  # another system made the scenes
    assert any("of the system that made its scenes" in note for note in found.results[0].notes)
    others = replace(alone, reference_pictures="", reference=_with_other_tables(scenes, tmp_path / "others"))
    found = evaluate(lambda _: tasks, str(tmp_path / "out"), others, ALONE, [str(dataset)], report=False)
    assert found.estimates["same"]["frechet"].value is None
    assert found.estimates["same"]["pairs_unseen"].value is None
    assert any("it has no office_table" in note for note in found.results[0].notes)


def test_what_one_system_lacks_is_unknown_and_the_page_is_written(
    tasks: TaskSource, settings: EvaluateSettings, dataset: Path, evaluated: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    scenes = f"{evaluated[0]}/seed_0/holodeck/scenes"
    strange = TaskSource(
        "tasks", [replace(t, scene_id=f"other_{t.scene_id}") for t in tasks.tasks if isinstance(t, LayoutTask)]
    )
    views = replace(settings.views, features="inception:/nowhere.pth")
    alone = replace(settings, systems=(f"mine:files={scenes}",), reference=scenes, views=views)
    found = evaluate(lambda _: strange, str(tmp_path), alone, ALONE, [str(dataset)])
    assert found.estimates["mine"]["made"].value == 0.0
    assert found.estimates["mine"]["frechet"].value is None
    assert any("the reference was not drawn" in note and "/nowhere.pth" in note for note in found.notes)
    assert "no scene, or no picture of it" in (tmp_path / "report" / "index.html").read_text()


def test_old_ratings_do_not_stand_for_those_of_another_judge(
    tasks: TaskSource, settings: EvaluateSettings, dataset: Path, evaluated: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    out = Path(shutil.copytree(evaluated[0], tmp_path / "copy"))
    (tmp_path / "silent.json").write_text("{}")
    rate = RateSettings(rating=RatingSettings(judge=f"scripted:{tmp_path / 'silent.json'}"))
    found = evaluate(lambda _: tasks, str(out), replace(settings, systems=("one_shot",), rate=rate), ALONE, [str(dataset)])
    assert found.estimates["one_shot"]["made"].value == pytest.approx(200 / 3)
    assert found.estimates["one_shot"]["average"].value is None
    assert found.estimates["one_shot"]["quality_pass"].value is None
    assert any("ratings" in note for note in found.results[0].notes)
    again = evaluate(lambda _: tasks, str(out), replace(settings, systems=("one_shot",)), ALONE, [str(dataset)])
    assert again.estimates["one_shot"]["average"].value == evaluated[1]["systems"]["one_shot"]["figures"]["average"]["value"]


def test_lost_pictures_are_unknown_and_a_failure(
    tasks: TaskSource,
    settings: EvaluateSettings,
    dataset: Path,
    evaluated: tuple[Path, dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = Path(shutil.copytree(evaluated[0], tmp_path / "copy"))
    shutil.rmtree(out / "seed_0" / "one_shot" / "views")
    draw, lost = draw_scored_views, iter([True])

    def fails_once(*args: Any, **more: Any) -> Any:
        if next(lost, False):
            raise SceneError("the driver draws nothing", "render_failed")
        return draw(*args, **more)

    monkeypatch.setattr(shard, "draw_scored_views", fails_once)
    found = evaluate(lambda _: tasks, str(out), replace(settings, systems=("one_shot",)), ALONE, [str(dataset)])
    assert found.has_failed
    assert "seed 0: pictures of 1 scenes are unknown, see the table failures" in found.results[0].notes


def test_a_set_without_some_of_its_pictures_has_no_distance(evaluated: tuple[Path, dict[str, Any]]) -> None:
    place = evaluated[0] / "seed_0" / "holodeck"
    whole = RunsOfSystem(f"{place}/scenes", f"{place}/views")
    reference = read_reference(whole.scenes, whole.views, "")
    names = [f"task_{n}" for n in range(3)]
    assert read_repetition(whole, names, reference)[0].values["frechet"] == pytest.approx(0.0, abs=1e-6)
    for key in ("frechet", "kernel"):
        assert read_repetition(replace(whole, lost_pictures=1), names, reference)[0].values.get(key) is None


def test_a_task_that_an_endpoint_did_not_answer_is_unknown(evaluated: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    scenes = shutil.copytree(evaluated[0] / "seed_0" / "holodeck" / "scenes", tmp_path / "scenes")
    names = [f"task_{n}" for n in range(3)]
    before, notes = read_repetition(RunsOfSystem(str(scenes)), names, None)
    assert not before.unanswered
    assert not any("did not answer" in note for note in notes)
    RunFolder(str(scenes)).write_shard(
        "failures", "more", [notice_row(Notice("task_2", "generate", "rate_limited", "task_2: 429"))]
    )
    after, notes = read_repetition(RunsOfSystem(str(scenes)), names, None)
    assert after.unanswered == {"task_2"}
    assert any("1 tasks are unknown: the endpoint did not answer" in note for note in notes)


def test_sets_that_are_much_smaller_do_not_make_the_number_of_scenes_small_for_all() -> None:
    assert of_similar_size({0: 200, 1: 100, 2: 99, 3: 0}) == [0, 1]
    assert of_similar_size({0: 1, 1: 0}) == of_similar_size({}) == []


def test_mesatask_needs_a_model_of_its_own() -> None:
    shared = GenerateSettings(engine=EngineSettings("openai:gpt-4o"))
    assert "MesaTask's model" in EvaluatedSystem.parse("mesatask").lacks(shared)
    assert not EvaluatedSystem.parse("mesatask=transformers:/model").lacks(shared)
    assert not EvaluatedSystem.parse("zero_shot").lacks(shared)
    assert EvaluatedSystem.parse("zero_shot").lacks(GenerateSettings())
    assert not EvaluatedSystem.parse("zero_shot=embedded").lacks(GenerateSettings())
    assert not shared.engine.is_priced
    assert replace(shared.engine, http=replace(shared.engine.http, prompt_price=2.5)).is_priced
    assert GenerateSettings().engine.is_priced


def _with_other_tables(run: str, to: Path) -> str:
    """A run with the same scenes on tables of another type."""
    source, target = RunFolder(run), RunFolder(str(to))
    for table in ("assets", "meshes", "scenes", "textures"):
        rows = source.table(table).to_pylist()
        target.write_shard(table, "all", [row | ({"table_type": "vanity"} if table == "scenes" else {}) for row in rows])
    return str(to)


@pytest.mark.parametrize(
    ("text", "row"),
    [
        ("stable", "Ours"),
        ("holodeck", "Holodeck-Table without its model"),
        ("holodeck=openai:gpt-4o", "Holodeck-Table"),
        ("mesatask_refined=embedded", "MesaTask+refine without its model"),
        ("zero_shot", "GPT-4o"),  # not run
        ("files", "TabletopGen"),  # likewise
        ("mine:files=place", "layouts of files"),
        ("tabletopgen:files=place", "TabletopGen"),
    ],
)
def test_a_row_of_the_paper_is_named_only_where_it_is_one(text: str, row: str) -> None:
    assert EvaluatedSystem.parse(text).row(GenerateSettings()) == row


@pytest.mark.parametrize(
    ("texts", "code"),
    [
        ((), "config_invalid"),
        (("gpt",), "system_unknown"),
        (("stable", "stable"), "config_invalid"),
        (("/:stable",), "config_invalid"),
    ],
)
def test_systems_that_cannot_be_told_apart_are_refused(texts: tuple[str, ...], code: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_systems(texts)
    assert caught.value.code == code


def test_the_settings_of_a_system_win_over_those_of_all() -> None:
    shared = GenerateSettings(corrects="end", accept="clean", schedule="whole", seed=5)
    ours = EvaluatedSystem.parse("stable").settings(shared, 7)
    assert (ours.corrects, ours.accept, ours.seed) == ("each", "", 7)
    assert EvaluatedSystem.parse("a:zero_shot=openai:gpt-4o").settings(shared, 0).engine.engine == "openai:gpt-4o"
    theirs = EvaluatedSystem.parse("b:files=place/{seed}")
    assert (theirs.label, theirs.is_repeated(), theirs.settings(shared, 3).layout_files) == ("b", True, "place/3")
    assert not EvaluatedSystem.parse("files=place").is_repeated()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "expected one of --count, --tasks and --scenes"),
        (["--count", "2", "--where", "clean"], "--where chooses scenes of --scenes"),
        (["--count", "2", "--system", "gpt"], "expected one of stable"),
        (["--count", "2", "--set", "views.colour=red"], "views.colour is not known"),
        (["--count", "2", "--set", "rating.judge=openai:m"], "evaluate.rating is not known; did you mean rate.rating?"),
        (["--count", "2", "--set", "engine.http.base_url=x"], "evaluate.engine is not known; did you mean generate.engine?"),
    ],
)
def test_what_cannot_start_is_refused(words: list[str], says: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["evaluate", "--out", str(tmp_path / "out"), "--workers", "0", *words])
    assert result.exit_code == 2
    assert says in result.output
    assert not (tmp_path / "out").exists()


def test_a_dry_run_refuses_a_reference_that_is_none(tiny_run: Path, tmp_path: Path) -> None:
    words = ["evaluate", "--count", "2", "--out", str(tmp_path / "out"), "--system", "stable", "--dry-run", "--reference"]
    for place, where, says in ((tmp_path, "", "no table scenes"), (tiny_run, "num_objects > 99", "no scene to compare with")):
        chosen = ["--set", f'reference_where="{where}"'] if where else []
        result = CliRunner().invoke(app, [*words, str(place), *chosen])
        assert (result.exit_code, says in result.output) == (2, True), result.output


def test_a_dry_run_says_what_would_be_done(dataset: Path, tmp_path: Path) -> None:
    words = [
        "evaluate",
        "--count",
        "2",
        "--out",
        str(tmp_path / "out"),
        "--assets",
        str(dataset),
        "--dry-run",
        "--repetitions",
        "3",
    ]
    result = CliRunner().invoke(
        app, [*words, "--system", "stable", "--system", "zero_shot", "--set", "generate.only_served=never"]
    )
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["seeds"] == [0, 1, 2]
    assert found["systems"]["zero_shot"].startswith("not run: needs --engine")
    assert not (tmp_path / "out").exists()
