"""Goals and conditions as JSON, and in another scene."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.condition import ConditionKind, GoalCondition, condition_document, condition_of
from stable_data.errors import GoalError
from stable_data.tasks.goal import Goal, GoalKind, Step, StepAction, goal_document, goal_of, rename_conditions
from tests.stable_data.tasks.task_scenes import of

_name = st.text("abc_0", min_size=1, max_size=6)
_conditions = st.lists(
    st.builds(
        GoalCondition, _name, st.sampled_from(ConditionKind), _name | st.just(""), st.none() | st.floats(0.01, 1), st.booleans()
    ),
    max_size=3,
).map(tuple)
_steps = st.lists(st.builds(Step, st.sampled_from(StepAction), _name, _conditions), max_size=3).map(tuple)


@given(st.builds(Goal, st.sampled_from(GoalKind), _conditions, _steps))
def test_a_goal_goes_through_json_unchanged(goal: Goal) -> None:
    assert goal_of(json.loads(json.dumps(goal_document(goal)))) == goal


@pytest.mark.parametrize(
    "document",
    [
        None,
        {},
        {"subject": "a", "kind": "under", "target": "b"},
        {"subject": "", "kind": "on", "target": "b"},
        {"subject": "a", "kind": "moved", "target": "left", "distance": -1},
        {"subject": "a", "kind": "moved", "target": "left", "distance": float("inf")},
        {"subject": "a", "kind": "on", "target": "b", "is_negated": "no"},
    ],
)
def test_a_condition_of_another_form_is_refused(document: object) -> None:
    with pytest.raises(GoalError) as refused:
        condition_of(document)
    assert refused.value.code == "goal_invalid"


def test_a_goal_of_another_form_is_refused() -> None:
    for document in ({}, {"kind": "fly", "conditions": [], "steps": []}, {"kind": "pick", "conditions": [{}], "steps": []}):
        with pytest.raises(GoalError) as refused:
            goal_of(document)
        assert refused.value.code == "goal_invalid"


def test_a_condition_reads_as_words() -> None:
    assert str(of("a", "in", "b", negated=True)) == "a not in b"
    assert str(of("a", "moved", "left", 0.05)) == "a moved left 5 cm"
    assert condition_of(
        {k: v for k, v in condition_document(of("a", "held")).items() if k in ("subject", "kind", "target")}
    ) == of("a", "held")


def test_conditions_are_renamed_between_scenes() -> None:
    names = {"1_mug_0": "mug_4", "2_tray_0": "tray_0"}
    sizes = {"mug_4": (0.1, 0.1, 0.2), "tray_0": (0.4, 0.3, 0.1)}
    known = {"1_mug_0", "2_tray_0", "3_pen_0"}
    assert rename_conditions((of("1_mug_0", "on", "2_tray_0"),), names, known, sizes) == (of("mug_4", "on", "tray_0"),)
    assert rename_conditions((of("1_mug_0", "at", "left"), of("1_mug_0", "on", "table")), names, known, sizes) == (
        of("mug_4", "at", "left"),
        of("mug_4", "on", "table"),
    )
    assert rename_conditions((of("1_mug_0, 2_tray_0", "in a row"),), names, known, sizes) == (of("mug_4, tray_0", "in a row"),)
    assert rename_conditions((of("1_mug_0", "on", "2_tray_0"), of("3_pen_0", "held")), names, known, sizes) == ()
    assert rename_conditions((of("1_mug_0", "held", "front_edge"),), names, known, sizes) == (
        of("mug_4", "held", "front_edge"),
    )
    emptied = (of("3_pen_0", "on", "table"), of("2_tray_0", "empty", "on"))
    assert rename_conditions(emptied, names, known, sizes) == (of("tray_0", "empty", "on"),)


def test_what_is_ordered_is_ordered_anew_by_the_sizes_of_the_other_scene() -> None:
    names, known = {"1_mug_0": "mug_4", "2_tray_0": "tray_0"}, {"1_mug_0", "2_tray_0"}
    sizes = {"mug_4": (0.1, 0.1, 0.2), "tray_0": (0.4, 0.3, 0.1)}

    def ordered(measure: str, **other: tuple[float, float, float]) -> tuple[GoalCondition, ...]:
        return rename_conditions((of("1_mug_0, 2_tray_0", "ordered", measure),), names, known, sizes | other)

    assert ordered("by_height") == (of("tray_0, mug_4", "ordered", "by_height"),)
    assert ordered("by_size") == (of("mug_4, tray_0", "ordered", "by_size"),)
    assert ordered("by_height", tray_0=(0.4, 0.3, 0.19)) == ()  # nearly as high
    assert ordered("") == ()  # by what is not known
