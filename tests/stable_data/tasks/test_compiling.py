"""Goals of task infos as MesaTask has them, the steps of goals, and what cannot be compiled."""

from dataclasses import replace

import pytest

from stable_data.condition import GoalCondition
from stable_data.errors import GoalError
from stable_data.scene import TaskInfo
from stable_data.tasks.checking import GoalChecker, start_state
from stable_data.tasks.compiling import compile_goal
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import Goal, GoalKind, StepAction
from tests.bounds import soon
from tests.stable_data.tasks.task_scenes import geometry, goal, of, states_of


def compiled(goals: tuple[str, ...] = (), actions: tuple[str, ...] = (), task_objects: tuple[str, ...] = ()) -> Goal:
    names = task_objects or tuple(o.instance for o in geometry().scene.objects)
    return compile_goal(geometry(TaskInfo("", "Do it.", goals, actions, task_objects=names)))


@pytest.mark.parametrize(
    ("sentence", "expected"),
    [
        ("The mug is held above the table.", (of("mug_0", "held"),)),
        ("The mug is held up in front of the camera.", (of("mug_0", "held"),)),
        ("The person in front of the table holds the mug.", (of("mug_0", "held", "front_edge"),)),
        ("The mug is inside the bin.", (of("mug_0", "in", "bin_0"),)),
        ("The mug is on top of the book.", (of("mug_0", "on", "book_0"),)),
        ("The pen is on the table.", (of("pen_0", "on", "table"),)),
        ("The pen is not in the bin.", (of("pen_0", "in", "bin_0", negated=True),)),
        ("Nothing of the pen rests in the bin.", (of("pen_0", "in", "bin_0", negated=True),)),
        ("Nothing is in the bin.", (of("bin_0", "empty", "in"),)),
        ("The mug is right of the book.", (of("mug_0", "right of", "book_0"),)),
        (
            "The mug is to the right of the book, close to it.",
            (of("mug_0", "right of", "book_0"), of("mug_0", "beside", "book_0")),
        ),
        ("The mug is behind the book.", (of("mug_0", "behind", "book_0"),)),
        ("The mug is next to the plate.", (of("mug_0", "beside", "plate_0"),)),
        ("The mug is between the plate and the book.", (of("mug_0", "between", "plate_0, book_0"),)),
        ("The mug is in the back right corner.", (of("mug_0", "at", "back_right"),)),
        ("The mug is in the middle of the table.", (of("mug_0", "at", "middle_middle"),)),
        ("The mug is at the right side of the table.", (of("mug_0", "at", "right"),)),
        (
            "The plate and the mug are on the right half of the table.",
            (of("plate_0", "at", "right_half"), of("mug_0", "at", "right_half")),
        ),
        ("The mug is within reach at the front edge.", (of("mug_0", "at", "front_edge"),)),
        ("The mug is where the plate was.", (of("mug_0", "at", "plate_0"),)),
        ("The mug is 5 cm farther to the left than before.", (of("mug_0", "moved", "left", 0.05),)),
        ("There is a clear gap between the plate and the book.", (of("plate_0", "apart", "book_0"),)),
        ("The mug faces the front edge.", None),
        ("The mug faces the book.", (of("mug_0", "facing", "book_0"),)),
        ("All three blocks are in the bin.", tuple(of(f"block_{k}", "in", "bin_0") for k in range(3))),
        ("All three blocks stand in one row.", (of("block_0, block_1, block_2", "in a row"),)),
        (
            "The plate, the mug and the pen stand in one row, the smallest on the left.",
            (of("plate_0, mug_0, pen_0", "in a row"), of("pen_0, plate_0, mug_0", "ordered", "by_size")),
        ),
        ("What was in the bin is now on the plate.", (of("pen_0", "on", "plate_0"),)),
        ("The plate and the mug are stacked on the book.", (of("plate_0", "on", "book_0"), of("mug_0", "on", "plate_0"))),
    ],
)
def test_a_sentence_says_its_conditions(sentence: str, expected: tuple[GoalCondition, ...] | None) -> None:
    if expected is None:
        with pytest.raises(GoalError) as refused:
            compiled((sentence,))
        assert refused.value.code == "goal_true_at_start"
        return
    assert compiled((sentence,)).conditions == expected


@pytest.mark.parametrize(
    ("actions", "expected"),
    [
        (("Pick(Mug)",), (of("mug_0", "held"),)),
        (("Pick(Mug)", "PlaceAt(in front of camera)"), (of("mug_0", "held"),)),
        (("Pick(Mug)", "PlaceAt(hand of the person)"), (of("mug_0", "held", "front_edge"),)),
        (("Pick(Mug)", "PlaceOn(Bin)"), (of("mug_0", "in", "bin_0"),)),
        (("Pick(Mug)", "PlaceOn(Book)"), (of("mug_0", "on", "book_0"),)),
        (("Pick(Mug)", "PlaceAt(in Bin)"), (of("mug_0", "in", "bin_0"),)),
        (("Pick(Pen)", "PlaceAt(Table)"), (of("pen_0", "on", "table"),)),
        (("Pick(Mug)", "PlaceAt(right of Book)"), (of("mug_0", "right of", "book_0"),)),
        (("Pick(Mug)", "PlaceAt(back left)"), (of("mug_0", "at", "back_left"),)),
        (("Push(Mug,left,8)",), (of("mug_0", "moved", "left", 0.08),)),
        (("Pick(Mug)", "PlaceAt(Table)", "Pick(Mug)", "PlaceOn(Bin)"), (of("mug_0", "in", "bin_0"),)),
    ],
)
def test_actions_say_the_conditions_of_their_end(actions: tuple[str, ...], expected: tuple[GoalCondition, ...]) -> None:
    assert compiled(actions=actions).conditions == expected


def test_a_push_takes_its_length_from_the_action() -> None:
    found = compiled(("The mug is further to the left than before.",), ("Push(Mug,left,8)",))
    assert found.conditions == (of("mug_0", "moved", "left", 0.08),)
    assert found.kind is GoalKind.PUSH


@pytest.mark.parametrize(
    ("goals", "actions", "code"),
    [
        (("The person in front of the table holds the mug and the pen.",), (), "goal_not_checkable"),
        (("The mug is held above the table.", "The mug is on the book."), (), "goal_not_checkable"),
        (("The mug is filled from the bin.",), (), "goal_not_checkable"),
        (("The switch has been pressed.",), ("Press(Mug)",), "goal_not_checkable"),
        (("The mug is in the book.",), (), "goal_not_checkable"),
        (("The mug is further to the left than before.",), ("Push(Mug,left,0)",), "goal_invalid"),
        (("The cat is in the bin.",), (), "goal_unresolved"),
        (("The block is in the bin.",), (), "goal_unresolved"),
        (("The pen is in the bin.",), (), "goal_true_at_start"),
        ((), (), "no_goal"),
    ],
)
def test_what_cannot_be_compiled_says_why(goals: tuple[str, ...], actions: tuple[str, ...], code: str) -> None:
    with pytest.raises(GoalError) as refused:
        compiled(goals, actions)
    assert refused.value.code == code
    assert str(refused.value).startswith("scene: ")
    assert "\n" not in str(refused.value)


def test_a_scene_without_a_task_has_no_goal() -> None:
    with pytest.raises(GoalError) as refused:
        compile_goal(geometry())
    assert refused.value.code == "no_task"


@pytest.mark.parametrize(
    ("instruction", "code", "words"),
    [
        ("Pour the water from the bottle into the cup.", "goal_not_checkable", "'pour' cannot be checked"),
        ("Put the mug in the bin, then switch off the lamp.", "goal_not_checkable", "'switch off'"),
        ("Please open the box.", "goal_not_checkable", "'open'"),
        ("Put the mug in the open box.", "no_goal", "the task info states no goal"),
        ("Do something nice.", "no_goal", "the task info states no goal"),
    ],
)
def test_an_instruction_without_a_stated_goal_says_why_it_has_none(instruction: str, code: str, words: str) -> None:
    with pytest.raises(GoalError) as refused:
        compile_goal(geometry(TaskInfo("", instruction)))
    assert (refused.value.code, words in str(refused.value)) == (code, True)


def test_task_objects_tell_which_of_several_is_meant() -> None:
    assert compiled(("The block is in the bin.",), task_objects=("block_2", "bin_0")).conditions == (
        of("block_2", "in", "bin_0"),
    )


def test_conditions_of_a_task_info_come_before_its_sentences() -> None:
    task = TaskInfo("", "Do it.", ("The mug is in the bin.",), conditions=(of("mug_0", "held"),))
    assert compile_goal(geometry(task)).conditions == (of("mug_0", "held"),)


def test_a_fixed_object_is_not_moved() -> None:
    space = geometry(TaskInfo("", "Do it.", conditions=(of("mug_0", "held"),)))
    fixed = TaskGeometry(replace(space.scene, fixed=frozenset({"mug_0"})), space.shapes, space.containers)
    with pytest.raises(GoalError) as refused:
        compile_goal(fixed)
    assert refused.value.code == "goal_not_checkable"


@pytest.mark.parametrize(
    ("conditions", "kind"),
    [
        ((of("mug_0", "held"),), GoalKind.PICK),
        ((of("mug_0", "held", "front_edge"),), GoalKind.HAND_OVER),
        ((of("block_0", "on", "table"), of("book_0", "held", "front_edge")), GoalKind.HAND_OVER),
        ((of("mug_0", "on", "book_0"),), GoalKind.PLACE_ON),
        ((of("block_1", "on", "block_2"),), GoalKind.STACK),
        ((of("mug_0", "in", "bin_0"),), GoalKind.PLACE_IN),
        ((of("block_1", "in", "bin_0"), of("block_2", "in", "mug_0")), GoalKind.SORT),
        ((of("pen_0", "on", "table"), of("pen_0", "in", "bin_0", negated=True)), GoalKind.CLEAR),
        ((of("bin_0", "empty", "in"), of("pen_0", "on", "plate_0")), GoalKind.CLEAR),
        ((of("mug_0", "left of", "book_0"), of("mug_0", "beside", "book_0")), GoalKind.PLACE_BESIDE),
        ((of("mug_0", "at", "back_left"),), GoalKind.MOVE),
        ((of("mug_0", "at", "plate_0"), of("plate_0", "at", "mug_0")), GoalKind.SWAP),
        ((of("mug_0", "moved", "left", 0.05),), GoalKind.PUSH),
        ((of("mug_0", "facing", "book_0"),), GoalKind.TURN),
        ((of("block_1, block_2, mug_0", "in a row"),), GoalKind.SORT),
        ((of("mug_0", "held"), of("block_1", "in", "bin_0")), GoalKind.SEVERAL),
    ],
)
def test_kinds(conditions: tuple[GoalCondition, ...], kind: GoalKind) -> None:
    assert goal(*conditions).kind is kind


def steps(*conditions: GoalCondition) -> list[str]:
    return [f"{s.action} {s.subject}" for s in goal(*conditions).steps]


def test_steps_follow_the_conditions() -> None:
    assert steps(of("block_1", "in", "bin_0"), of("mug_0", "held")) == ["pick block_1", "place block_1", "pick mug_0"]
    assert steps(of("mug_0", "held", "front_edge")) == ["pick mug_0", "carry mug_0"]
    assert steps(of("mug_0", "moved", "left", 0.05)) == ["push mug_0"]
    assert steps(of("mug_0", "facing", "book_0")) == ["pick mug_0", "turn mug_0"]
    assert steps(of("bin_0", "empty", "in")) == ["pick pen_0", "place pen_0"]


def test_what_is_held_need_not_be_put_down_outside_first() -> None:
    found = goal(of("pen_0", "held", "front_edge"), of("pen_0", "in", "bin_0", negated=True))
    assert found.conditions == (of("pen_0", "held", "front_edge"),)
    assert [str(s.action) for s in found.steps] == ["pick", "carry"]


def test_what_is_in_the_way_is_set_aside_first() -> None:
    assert steps(of("book_0", "on", "block_0")) == ["pick block_0", "place block_0", "pick book_0", "place book_0"]


def test_a_swap_uses_a_free_spot() -> None:
    target = goal(of("mug_0", "at", "plate_0"), of("plate_0", "at", "mug_0"))
    assert [f"{s.action} {s.subject}" for s in target.steps] == [
        "pick mug_0",
        "place mug_0",
        "pick plate_0",
        "place plate_0",
        "pick mug_0",
        "place mug_0",
    ]
    assert target.steps[1].conditions == ()
    checker = GoalChecker(target, geometry())
    rewards = [checker.reward(state) for state in states_of(target, geometry())]
    assert rewards[-1] == 1.0
    assert rewards == sorted(rewards)


def test_what_holds_already_needs_no_step() -> None:
    target = goal(of("plate_0", "at", "front"), of("mug_0", "at", "back"))
    assert {s.subject for s in target.steps} == {"mug_0"}
    assert not any(s.action is StepAction.PUSH for s in target.steps)
    assert not GoalChecker(target, geometry()).is_success(start_state(geometry()))


@pytest.mark.parametrize("words", ["the mug is where " * 20_000, "is on " * 50_000 + "x", "a" * 10**6])
def test_a_long_sentence_is_not_checked_and_costs_no_time(words: str) -> None:
    """The forms are tried in time that grows with a power of the length."""
    for given in ({"goals": (words,)}, {"actions": (words,)}, {"actions": (f"Pick({words})",)}):
        with soon(1.0), pytest.raises(GoalError, match=r"text\.max_instruction in STABLE_DATA_LIMITS") as caught:
            compiled(**given)
        assert caught.value.code == "goal_not_checkable"
        assert len(str(caught.value)) < 500
