import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from models.semantic_reasoner.text.prompt import ANY_TABLE, ReasonerQuestion
from models.semantic_reasoner.text.reply_json import parse_reply
from models.semantic_reasoner.training.examples import TrainingExample, add_whole_layouts, example_of
from pipelines.execution.ray_executor import WorkerPool
from pipelines.preprocess.job import preprocess
from pipelines.preprocess.settings import PreprocessSettings
from stable_data.errors import SceneError
from stable_data.scene import Stage
from stable_data.storage.row_groups import rows_from_table
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import Row
from tests.models.semantic_reasoner.training.reasoner_examples import TABLE, thing


@pytest.fixture(scope="module")
def rows(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Row]:
    """The samples of real scenes, staged without their meshes."""
    root, out = (tmp_path_factory.mktemp("real") / name for name in ("data", "run"))
    shutil.copytree(real_data, root, ignore=shutil.ignore_patterns("Assets_library"))
    settings = PreprocessSettings(num_points=64, num_pictures=0, all_assets=False, features="none")
    preprocess(str(root), str(out), settings, WorkerPool())
    return rows_from_table(RunFolder(str(out)).table("samples"))


@pytest.fixture(scope="module")
def real(rows: list[Row]) -> list[TrainingExample]:
    return [example_of(row) for row in rows]


def test_what_is_rendered_of_real_scenes_parses_to_the_same(real: list[TrainingExample]) -> None:
    assert len(real) >= 3
    for example in real:
        assert parse_reply(example.answer).objects == example.objects
    assert any(example.objects for example in real)


def test_names_are_unique_over_a_scene_and_the_same_in_question_and_answer(real: list[TrainingExample]) -> None:
    scenes: dict[str, list[TrainingExample]] = {}
    for example in real:
        scenes.setdefault(example.scene_id, []).append(example)
    for of_scene in scenes.values():
        last = next(e for e in of_scene if e.question.wanted is Stage.SECONDARY)
        names = [o.instance for o in (*last.question.layout, *last.objects)]
        assert len(set(names)) == len(names)
        earlier = [o for e in of_scene if e.question.wanted is not Stage.SECONDARY for o in e.objects]
        assert {o.description for o in earlier} == {o.description for o in last.question.layout}


def test_the_one_shot_answer_is_the_last_stage_with_all_before_it(real: list[TrainingExample]) -> None:
    both = list(add_whole_layouts(real))
    whole = [e for e in both if e.question.wanted == "whole"]
    assert [e for e in both if e.question.wanted != "whole"] == real
    lasts = [e for e in real if e.question.wanted is Stage.SECONDARY]
    assert len(whole) == len(lasts) > 0
    for one, last in zip(whole, lasts, strict=True):
        assert one.question.wanted == "whole"
        assert one.question.layout == ()
        assert one.objects == last.question.layout + last.objects
        assert "Layout so far" not in one.prompt[-1]["content"]


def test_details_are_said_where_they_are_wanted(rows: list[Row]) -> None:
    row = next(row for row in rows if row["task"] and row["task"]["environment"])
    assert "Details" not in example_of(row).prompt[-1]["content"]
    assert (
        row["task"]["environment"].split()[0]
        in example_of(row, with_details=True).prompt[-1]["content"].partition("Details")[2]
    )


def test_a_row_without_a_task_cannot_be_asked(rows: list[Row]) -> None:
    example = example_of(rows[0] | {"task": None}, with_details=True)
    with pytest.raises(SceneError, match="instruction is empty"):
        _ = example.prompt


def test_the_kind_of_table_may_be_left_out(real: list[TrainingExample]) -> None:
    known, unknown = real[0], real[0].on_any_table()
    assert known.question.table.table_type in known.prompt[-1]["content"]
    assert f"Table: {ANY_TABLE}, " in unknown.prompt[-1]["content"]
    assert unknown.answer == known.answer
    assert unknown.question.table.size_xy == known.question.table.size_xy


def test_an_edit_says_what_goes_first() -> None:
    edit = TrainingExample(
        "scene", ReasonerQuestion("Take the mug away", TABLE, "edit", (thing(0),)), (thing(1),), (thing(0).instance,)
    )
    assert list(json.loads(edit.answer)) == ["remove", "objects"]
    reply = parse_reply(edit.answer)
    assert (reply.removed, reply.objects) == ((thing(0).instance,), (thing(1),))


def test_what_is_required_is_said_in_the_names_of_the_answer(rows: list[Row]) -> None:
    row = next(row for row in rows if row["stage"] == "task" and len(row["task"]["task_objects"]) > 1)
    assert "Details" not in example_of(row).prompt[-1]["content"]
    said = set()
    for seed in range(20):
        example = example_of(row, rng=np.random.default_rng(seed))
        required = example.question.required
        names = [phrase for phrase in required if " " not in phrase]
        assert set(names) <= {o.instance for o in example.objects}
        assert len(names) == len(row["task"]["task_objects"])
        assert "Details: " + "; ".join(required) in example.prompt[-1]["content"]
        for phrase in required[len(names) :]:
            assert phrase.split(" ")[0] in names
        said.add(required)
    assert len(said) > 3  # other orders, other relations
    last = replace(example, question=replace(example.question, wanted=Stage.SECONDARY, required=()))
    (whole,) = (e for e in add_whole_layouts([last]) if e.question.wanted == "whole")
    assert whole.question.required == example.required
