"""What the generate job is asked for: files, scenes that are there, drawn ones."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from models.point_encoder.checkpoint import DEFAULT_WEIGHTS as ENCODER
from models.semantic_reasoner.staged_layout import LayoutTask, task_of_scene
from pipelines.__main__ import app
from pipelines.generate.settings import GenerateSettings
from pipelines.sources import generation_tasks
from pipelines.sources.generation_tasks import (
    SampledTask,
    sample_tasks,
    served_tasks,
    task_of_instruction,
    tasks_of_file,
    tasks_of_scenes,
)
from stable_data.embedded_world.plans import TABLES, UNSEEN_TABLES
from stable_data.embedded_world.sampling import sample_task
from stable_data.errors import ConfigError, SceneError
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import RelationKind, Tabletop
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.table_rows import scene_from_row

ONE = ["--instruction", "Lift it.", "--table", "office_table", "--size", "120", "60"]


def test_drawn_tasks_depend_on_seed_and_number_alone() -> None:
    found = sample_tasks(30, 5)
    assert [task.sample(lambda _: True) for task in sample_tasks(4, 5).tasks if isinstance(task, SampledTask)] == [
        task.sample(lambda _: True) for task in found.tasks[:4] if isinstance(task, SampledTask)
    ]
    assert sample_task(3, 5) != sample_task(3, 6)
    names = [task.scene_id for task in found.tasks]
    assert len(set(names)) == 30
    assert not set(names) & {task.scene_id for seed in (0, 6) for task in sample_tasks(30, seed).tasks}  # runs can be joined
    kinds = {re.sub(r"_\d{5}_seed5", "", name) for name in names}
    assert kinds >= set(TABLES)
    assert kinds & set(UNSEEN_TABLES)


def test_drawn_tasks_say_something_different_each() -> None:
    found = [sample_task(number, 2).task for number in range(20)]
    said = {task.task for task in found if task is not None}
    assert len(said) > 18
    assert all(text[-1] in ".?!" for text in said)


def test_a_kind_of_table_may_be_asked_for() -> None:
    tasks = sample_tasks(3, 0, ["nightstand"]).tasks
    assert {task.sample(lambda _: True).table.table_type for task in tasks if isinstance(task, SampledTask)} == {"nightstand"}
    with pytest.raises(ConfigError, match="expected one of"):
        sample_tasks(3, 0, ["moon"])
    with pytest.raises(ConfigError, match="count is 0"):
        sample_tasks(0)


SERVED = frozenset({"plate", "fork", "table_knife", "mug", "bowl", "spoon", "drinking_glass", "wine_glass"})


def test_drawn_tasks_ask_only_for_what_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    source = served_tasks(sample_tasks(2, 5, ["dressing_table", "dining_table"]), SERVED.__contains__, "")
    assert [notice.code for notice in source.odd] == ["table_not_served"]
    assert [notice.item_id for notice in source.odd] == ["dressing_table"]
    tasks = [SampledTask(k, 5, ("dining_table",), is_served=True) for k in range(2)]  # whatever else is drawn
    assert source.tasks == tasks
    assert [task.scene_id for task in tasks] == [f"dining_table_{k:05d}_seed5" for k in range(2)]
    for task in (task.sample(SERVED.__contains__) for task in tasks):
        assert task.reference is not None
        assert all(SERVED & set(r.categories) for r in task.reference.required if r.categories)
    monkeypatch.setattr(generation_tasks, "_REDRAWS", 4)
    with pytest.raises(SceneError, match="the libraries lack an object of each of 5 drawn tasks, such as"):
        replace(tasks[0], tables=("dressing_table",)).sample(SERVED.__contains__)


def test_libraries_that_serve_no_task_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"hardly any task of nightstand, expected .* serve; name more libraries"):
        served_tasks(sample_tasks(3, 0, ["nightstand"]), lambda _: False, "name more libraries")
    one = task_of_instruction("Lift it.", "office_table", (120, 60))
    assert served_tasks(one, lambda _: False, "") is one  # a task of the user's own is not drawn


@pytest.mark.parametrize(
    ("only_served", "places", "advice"),
    [
        ("auto", ("/lib",), "name more libraries, add --assets embedded, or set only_served=never"),
        ("always", ("/lib",), "name more libraries, or set only_served=never"),
        ("always", ("/lib", "embedded"), "name more libraries, or set only_served=auto"),
        ("always", ("embedded",), "name a library other than embedded, or set only_served=auto"),
        ("always", (), "name a library other than embedded, or set only_served=auto"),
    ],
)
def test_advice_where_no_task_is_served_helps(
    only_served: Literal["auto", "always", "never"], places: tuple[str, ...], advice: str
) -> None:
    settings = GenerateSettings(only_served=only_served)
    assert settings.serving_advice(places) == advice
    if "only_served=auto" in advice:  # what it advises ends the search that fails
        assert not GenerateSettings(only_served="auto").draws_served(places)
    if "--assets embedded" in advice:
        assert not settings.draws_served((*places, "embedded"))


@pytest.mark.parametrize(
    ("only_served", "places", "draws"),
    [
        ("auto", (), False),
        ("auto", ("mine",), True),
        ("auto", ("mine", "embedded"), False),
        ("always", ("mine", "embedded"), True),
        ("never", ("mine",), False),
    ],
)
def test_tasks_are_limited_by_default_where_no_library_has_everything(
    only_served: Literal["auto", "always", "never"], places: tuple[str, ...], draws: bool
) -> None:
    assert GenerateSettings(only_served=only_served).draws_served(places) is draws


def test_tasks_of_scenes_are_their_instructions_and_tables(dataset: Path, clean_run: Path) -> None:
    of_folder, of_run = tasks_of_scenes(str(dataset)), tasks_of_scenes(str(clean_run))
    scene_id = of_folder.tasks[0].scene_id
    assert of_folder.tasks[0] == task_of_scene(MesaTaskDataset(dataset).read(scene_id)[0])
    rows = RunFolder(str(clean_run)).table("scenes").to_pylist()
    assert list(of_run.tasks) == [task_of_scene(scene_from_row(row)) for row in rows]
    few = tasks_of_scenes(str(clean_run), f"scene_id == '{rows[0]['scene_id']}'")
    assert [task.scene_id for task in few.tasks] == [rows[0]["scene_id"]]


def test_a_row_that_is_no_scene_costs_no_other_task(clean_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(clean_run, run)
    file = next((run / "scenes").glob("part-*.parquet"))
    table = pq.read_table(file)
    rows = table.to_pylist()
    rows[0]["table_size"] = None
    pq.write_table(pa.Table.from_pylist(rows, table.schema), file)
    source = tasks_of_scenes(str(run))
    assert len(source.tasks) == len(tasks_of_scenes(str(clean_run)).tasks) - 1
    (notice,) = (odd for odd in source.lost if odd.code == "row_invalid")
    assert notice.item_id == rows[0]["scene_id"]


def test_one_instruction_is_one_task() -> None:
    (task,) = task_of_instruction(" Lift it. ", "Office Table", (120.0, 60.0), (0.0, 40.0, 40.0, 60.0)).tasks
    assert task == LayoutTask("task", "Lift it.", Tabletop("office_table", (1.2, 0.6), (0.0, 0.4, 0.4, 0.6)))


def test_scenes_that_are_no_run_take_no_condition(dataset: Path) -> None:
    with pytest.raises(ConfigError, match="has no table scenes"):
        tasks_of_scenes(str(dataset), "clean")


def test_scenes_without_a_task_are_named(clean_run: Path, dataset: Path) -> None:
    with pytest.raises(ConfigError, match="contains no usable task"):
        tasks_of_scenes(str(clean_run), "num_objects >= 1000")


def test_broken_rows_of_a_file_are_named_and_the_rest_is_used(tmp_path: Path) -> None:
    path = tmp_path / "tasks.jsonl"
    good = {"instruction": "Lift it.", "table_type": "office_table", "table_size_cm": [120, 60]}
    path.write_text("\n".join(["{", json.dumps(good), json.dumps(good | {"table_size_cm": [0, 1]})]))
    found = tasks_of_file(path)
    assert [type(task) for task in found.tasks] == [LayoutTask]
    assert [notice.code for notice in found.lost] == ["task_invalid", "table_invalid"]


def test_a_file_without_a_usable_row_says_why(tmp_path: Path) -> None:
    path = tmp_path / "tasks.csv"
    path.write_text("instruction,table_type,table_size_cm\nLift it.,office_table,120,60\n")
    with pytest.raises(
        ConfigError, match=r"expected at least one; 1 are invalid, such as tasks\.csv, row 1: has .fields beyond"
    ):
        tasks_of_file(path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "expected one of --tasks"),
        (["--count", "3", "--tasks", "x.jsonl"], "expected one of --tasks"),
        (["--count", "3", "--where", "clean"], "--where belongs to --scenes"),
        (["--scenes", "x", "--table", "desk"], "--table belongs to --count or --instruction"),
        (["--count", "2", "--size", "120", "60"], "--size and --restricted belong to --instruction"),
        (["--count", "3", *ONE], "expected one of --tasks"),
        (["--instruction", "Lift it."], "expected one --table TYPE and --size W D"),
        ([*ONE, "--table", "desk"], "expected one --table TYPE and --size W D"),
        ([*ONE, "--engine", "gpt"], "engine is 'gpt', expected embedded"),
        ([*ONE[:-1], "0"], "the task's table_size_cm is (120.0, 0.0), expected width and depth"),
        ([*ONE, "--restricted", "0", "40", "40", "61"], "the task's restricted_zone_cm is"),
        (["--instruction", " ", *ONE[2:]], "the task's instruction is ' '"),
        (["--count", "0"], "count is 0"),
        (["--tasks", "no.jsonl"], "no.jsonl: cannot be read"),
        (["--count", "2", "--set", "accept=nice"], "names nice"),
        (["--count", "2", "--set", "weights=no.safetensors"], "no.safetensors"),
        (["--count", "2", "--set", f"weights={ENCODER}"], "has no settings in its header, expected weights of a corrector"),
        (["--count", "2", "--assets", "nowhere"], "nowhere"),
    ],
)
def test_what_cannot_start_says_so_in_one_line(words: list[str], message: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["generate", "--out", str(tmp_path / "out"), "--workers", "0", *words])
    assert result.exit_code == 2
    (line,) = result.output.strip().splitlines()
    assert message in line
    assert not (tmp_path / "out").exists()


def test_the_labels_of_a_drawn_task_have_its_scene_graph() -> None:
    for number in range(8):
        task = SampledTask(number, 3).sample(lambda _: True)
        assert task.reference is not None
        graph = set(task.reference.graph or ())
        assert task.reference.graph is not None
        assert {relation for relation in task.reference.entailed if relation.kind == RelationKind.ON} <= graph
