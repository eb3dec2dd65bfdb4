"""Edits that are planned from their instructions, read by the shipped reader."""

from dataclasses import replace

import pytest

from models.semantic_reasoner.edit_planning.planner import EditPlanner
from models.semantic_reasoner.language.interpreter import InstructionInterpreter
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.errors import SceneError
from stable_data.scene import Relation, RelationKind, Tabletop
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, ask, interpreter, thing

RED, BLUE = (
    LayoutObject("mug_0", "a red mug", (8.0, 8.0, 9.5), (30.0, 30.0, 4.8), 0),
    LayoutObject("mug_1", "a blue mug", (8.0, 8.0, 9.5), (90.0, 20.0, 4.8), 0),
)
PLATE, TRAY = thing("plate_0", 60, 30), thing("serving_tray_0", 95, 42)
LAYOUT = (RED, BLUE, PLATE, TRAY)


def planned(instruction: str) -> LayoutReply:
    return EditPlanner(interpreter(), STATISTICS)(ask(instruction, "edit", LAYOUT))


def test_an_object_goes() -> None:
    assert planned("Remove the red mug.") == LayoutReply((), ("mug_0",))


def test_an_object_moves_beside_another_one() -> None:
    (moved,) = planned("Move the red mug to the left of the plate.").objects
    assert moved.instance == "mug_0"
    dx, dy = moved.position_cm[0] - PLATE.position_cm[0], moved.position_cm[1] - PLATE.position_cm[1]
    assert dx < -abs(dy)
    assert abs(dx) >= 17.0  # the boxes do not overlap


def test_an_object_moves_onto_another_one() -> None:
    (moved,) = planned("Put the blue mug on the plate.").objects
    assert moved.instance == "mug_1"
    assert moved.position_cm[2] == pytest.approx(2.0 + 4.8, abs=0.1)


def test_an_object_comes_with_the_usual_size() -> None:
    (new,) = planned("Add an apple to the right of the plate.").objects
    assert new.instance == "apple_0"
    assert new.position_cm[0] > PLATE.position_cm[0]
    assert new.size_cm == pytest.approx((8.0, 8.0, 8.0), abs=0.1)


def test_an_object_takes_the_place_of_another_one() -> None:
    found = planned("Replace the plate with a laptop.")
    assert found.removed == ("plate_0",)
    assert [(o.instance, o.position_cm[:2]) for o in found.objects] == [("laptop_0", (60.0, 30.0))]


def test_an_object_gets_another_look() -> None:
    (changed,) = planned("Make the red mug green.").objects
    assert (changed.instance, changed.position_cm) == ("mug_0", RED.position_cm)
    assert "green" in changed.description


def test_others_of_the_same_kind_are_a_new_look() -> None:
    found = planned("Replace all the mugs with white ones.")
    assert (found.removed, {o.instance for o in found.objects}) == ((), {"mug_0", "mug_1"})
    assert all("white" in o.description for o in found.objects)


def test_those_that_look_so_already_stay() -> None:
    (changed,) = planned("Replace all the mugs with red ones.").objects
    assert changed.instance == "mug_1"


def test_an_object_goes_where_another_one_moves_to() -> None:
    found = {
        o.instance: o.position_cm
        for o in planned("Put the red mug on the plate, and move the plate to the front left corner.").objects
    }
    assert found["plate_0"][0] < 40.0
    assert abs(found["mug_0"][0] - found["plate_0"][0]) < 6.0


def test_several_that_fit_are_asked_back() -> None:
    with pytest.raises(SceneError, match="mug_0, mug_1") as caught:
        planned("Remove the mug.")
    assert caught.value.code == "ambiguous"


def test_an_instruction_that_changes_nothing_is_refused() -> None:
    with pytest.raises(SceneError, match="no change is understood") as caught:
        planned("What a lovely day it is.")
    assert caught.value.code == "edit_unread"


def test_the_reasoner_with_a_planner_does_not_ask_its_engine() -> None:
    class NoEngine:
        def complete(self, _: object) -> list[object]:
            raise AssertionError("the engine is asked")

    planner = EditPlanner(InstructionInterpreter(STATISTICS), STATISTICS)
    reasoner = SemanticReasoner(NoEngine(), plan_edit=planner)  # type: ignore[arg-type]
    clear, several = reasoner.propose(
        [ask(text, "edit", LAYOUT) for text in ("Remove the red mug.", "Remove the mug.")], [0, 1]
    )
    assert clear.reply == LayoutReply((), ("mug_0",))
    assert (several.reply, several.code) == (None, "ambiguous")


def test_the_wanted_relations_are_stated() -> None:
    assert planned("Put the blue mug on the plate.").relations == (Relation("mug_1", RelationKind.ON, "plate_0"),)
    found = planned("Add an apple to the right of the plate.")
    assert found.relations == (Relation("apple_0", RelationKind.RIGHT_OF, "plate_0"),)
    assert planned("Move the blue mug to the back left corner.").relations == (
        Relation("mug_1", RelationKind.IS_AT, "back_left"),
    )


def test_the_thing_that_is_said_to_be_beside_another_one_moves() -> None:
    (moved,) = planned("See the plate? The blue mug should stand in front of it.").objects
    assert moved.instance == "mug_1"
    (moved,) = planned("Behind the plate is where the blue mug should go.").objects
    assert moved.instance == "mug_1"


def test_a_new_thing_stands_on_a_new_thing() -> None:
    found = planned("Add a serving tray in the back left corner with an apple on it.")
    tray, apple = (next(o for o in found.objects if o.category == c) for c in ("serving_tray", "apple"))
    assert apple.position_cm[2] > tray.position_cm[2]
    assert apple.position_cm[:2] == pytest.approx(tray.position_cm[:2], abs=10)


def test_what_a_moved_thing_carries_comes_along() -> None:
    on_tray = replace(RED, position_cm=(95.0, 42.0, TRAY.size_cm[2] + 4.8))
    found = EditPlanner(interpreter(), STATISTICS)(
        ask("Move the red mug, tray and all, to the front left corner.", "edit", (on_tray, BLUE, PLATE, TRAY))
    )
    assert [o.instance for o in found.objects] == ["serving_tray_0"]
    found = EditPlanner(interpreter(), STATISTICS)(
        ask("Move the red mug together with its tray to the front left corner.", "edit", (on_tray, BLUE, PLATE, TRAY))
    )
    assert [o.instance for o in found.objects] == ["serving_tray_0"]
    found = EditPlanner(interpreter(), STATISTICS)(
        ask("Move the red mug from the tray to the front left corner.", "edit", (on_tray, BLUE, PLATE, TRAY))
    )
    assert [o.instance for o in found.objects] == ["mug_0"]


def test_a_thing_comes_between_two_others() -> None:
    (new,) = planned("Add an apple between the red mug and the plate.").objects
    assert RED.position_cm[0] < new.position_cm[0] < PLATE.position_cm[0]


def test_a_place_avoids_the_restricted_zone() -> None:
    table = Tabletop("bathroom_vanity", (1.2, 0.6), (0.4, 0.8, 0.0, 0.3))
    question = replace(
        ask("Add an apple in front of the plate.", "edit", (replace(PLATE, position_cm=(78.0, 45.0, 1.0)),)), table=table
    )
    (new,) = EditPlanner(interpreter(), STATISTICS)(question).objects
    x, y, _ = new.position_cm
    assert not (36 < x < 84 and y < 34)
