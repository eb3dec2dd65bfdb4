"""What a task info must hold: the schema, the strict check and the lenient reader agree."""

from typing import Any

import jsonschema
import pytest

from stable_data.errors import SceneError
from stable_data.json_text import ReadLog
from stable_data.scene import Relation, RelationKind
from stable_data.task_info import TASK_INFO_SCHEMA, parse_task_info, task_info_of, validate_task_info

WHOLE: dict[str, Any] = {
    "Environment": "A kitchen.",
    "item_placement_zone": [0.0, 120.0, 0.0, 60.0],
    "Task": "Put the mug on the tray.",
    "Goal": ["The mug is on the tray."],
    "Action Sequence": ["Pick(Mug)", "PlaceOn(Tray)"],
    "Objects cluster": ["Mug", "Tray"],
}


def test_what_the_check_asks_for_is_what_the_schema_requires() -> None:
    validate_task_info(WHOLE)
    jsonschema.validate(WHOLE, TASK_INFO_SCHEMA)
    for key in TASK_INFO_SCHEMA["required"]:
        lacking = {k: v for k, v in WHOLE.items() if k != key}
        with pytest.raises(SceneError, match=key):
            validate_task_info(lacking)
        with pytest.raises(jsonschema.ValidationError, match=key):
            jsonschema.validate(lacking, TASK_INFO_SCHEMA)


def test_a_whole_task_info_reads_the_same_leniently_and_strictly() -> None:
    assert parse_task_info(WHOLE, ReadLog("scene")) == task_info_of(WHOLE)


def test_only_a_file_says_which_objects_and_relations_are_meant() -> None:
    named = {**WHOLE, "task_objects": ["1_mug_0"], "relations": [["1_mug_0", "on", "0_tray_0"]], "origin": "template"}
    task = parse_task_info(named, ReadLog("scene"))
    assert (task.task_objects, task.origin) == (("1_mug_0",), "template")
    assert task.relations == (Relation("1_mug_0", RelationKind.ON, "0_tray_0"),)
    answer = task_info_of(named, "model")
    assert (answer.task_objects, answer.relations, answer.origin) == ((), (), "model")
    assert answer.source == named


def test_the_instruction_alone_is_enough_for_a_file() -> None:
    task = parse_task_info({"Task": "Lift the mug.", "Goal": "It is up."}, ReadLog("scene"))
    assert (task.environment, task.task, task.goal) == ("", "Lift the mug.", ("It is up.",))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("Task", ""),
        ("Task", None),
        ("Task", "mug, " * 2000),
        ("Environment", 3),
        ("Goal", "Done."),
        ("Goal", [1]),
        ("Action Sequence", None),
        ("Objects cluster", {}),
        ("item_placement_zone", [0, 1, 2]),
        ("item_placement_zone", [0, float("nan"), 0, 1]),
        ("item_placement_zone", [0, True, 0, 1]),
        ("item_placement_zone", [0, 10**400, 0, 1]),
    ],
)
def test_a_task_info_of_the_wrong_form_is_refused_by_its_key(key: str, value: object) -> None:
    with pytest.raises(SceneError, match=key) as caught:
        validate_task_info({**WHOLE, key: value})
    assert caught.value.code == "task_info_invalid"
