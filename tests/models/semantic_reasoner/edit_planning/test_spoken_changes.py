"""What the words of an edit say more surely than the network: each test has one turn of phrase, read by the shipped reader."""

import pytest

from models.semantic_reasoner.edit_planning.planner import EditPlanner
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.errors import SceneError
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, ask, interpreter, thing


def described(instance: str, words: str, x: float, y: float) -> LayoutObject:
    one = thing(instance, x, y)
    return LayoutObject(instance, words, one.size_cm, one.position_cm, 0)


MUG, OTHER, THIRD = (
    described("mug_0", "a red mug with a gold rim", 15, 15),
    described("mug_1", "a blue mug", 60, 15),
    described("mug_2", "a blue mug", 105, 15),
)
CAN, APPLE, PLATE = (
    described("can_0", "a tin of olives", 30, 45),
    described("apple_0", "a green apple", 75, 45),
    thing("plate_0", 100, 45),
)
LAYOUT = (MUG, OTHER, THIRD, CAN, APPLE, PLATE)


def planned(instruction: str, layout: tuple[LayoutObject, ...] = LAYOUT) -> LayoutReply:
    return EditPlanner(interpreter(), STATISTICS)(ask(instruction, "edit", layout))


def categories(reply: LayoutReply) -> list[str]:
    return [o.category for o in reply.objects]


def test_the_others_of_a_kind_go() -> None:
    assert set(planned("Keep the red mug, drop the others.").removed) == {"mug_1", "mug_2"}


def test_what_is_said_to_stay_stays() -> None:
    assert planned("The apple can go, the plate stays.").removed == ("apple_0",)


def test_what_comes_instead_replaces() -> None:
    found = planned("An orange instead of the apple, same spot.")
    assert (found.removed, categories(found)) == (("apple_0",), ["orange"])


def test_what_is_exchanged_for_one_was_mentioned_before() -> None:
    found = planned("We want oranges, no apples. Exchange the apple for one.")
    assert found.removed == ("apple_0",)
    assert set(categories(found)) == {"orange"}


def test_a_place_that_is_left_is_taken() -> None:
    found = planned("Get rid of the apple; the red mug can then have its place.")
    assert found.removed == ("apple_0",)
    assert [(o.instance, o.position_cm[:2]) for o in found.objects] == [("mug_0", (75.0, 45.0))]


def test_a_thing_is_found_by_its_look_and_its_part() -> None:
    assert planned("The thing with the gold rim, get rid of it.").removed == ("mug_0",)


def test_what_has_no_name_is_found_by_its_place() -> None:
    between = "What's that between the can and the plate? Don't want it there, delete."
    assert planned(between).removed == ("apple_0",)


def test_a_part_of_a_new_object_is_no_object() -> None:
    assert categories(planned("Add a white mug with a gold rim behind the apple.")) == ["mug"]
    assert categories(planned("Add a napkin for a cookie to the left of the apple.")) == ["napkin"]


def test_a_turn_is_no_object() -> None:
    (turned,) = planned("Turn the can round.").objects
    assert (turned.instance, turned.z_rotation_deg) == ("can_0", 180)


def test_what_is_taken_back_is_not_said() -> None:
    (moved,) = planned("The red mug goes behind the plate... no, I mean behind the apple.").objects
    assert moved.instance == "mug_0"
    assert abs(moved.position_cm[0] - APPLE.position_cm[0]) < abs(moved.position_cm[0] - PLATE.position_cm[0])


def test_the_noun_is_the_one_after_of() -> None:
    marbles = tuple(
        LayoutObject(f"marble_set_{k}", "a group of marbles", (9.0, 9.0, 3.0), (20.0 + 40.0 * k, 15.0, 1.5), 0)
        for k in range(2)
    )
    assert set(planned("Both little heaps of marbles have to go.", marbles).removed) == {"marble_set_0", "marble_set_1"}


def test_a_word_elsewhere_tells_several_apart() -> None:
    cans = (described("can_0", "a tin of olives", 30, 45), described("can_1", "a tin of beans", 60, 45))
    assert planned("Who wants olives? Just get that can out of the picture.", cans).removed == ("can_0",)
    with pytest.raises(SceneError, match="can_0, can_1") as caught:
        planned("Just get that can out of the picture.", cans)
    assert caught.value.code == "ambiguous"


def test_one_of_another_kind_has_the_look_that_none_of_its_kind_has() -> None:
    found = planned("Put the red mug to the left of the green one.")
    (moved,) = found.objects
    assert moved.instance == "mug_0"
    assert moved.position_cm[0] < APPLE.position_cm[0]


def test_an_edit_that_changes_nothing_fails() -> None:
    with pytest.raises(SceneError, match="no change is understood") as caught:
        planned("Put the red mug on the red one.")
    assert caught.value.code in ("edit_unread", "ambiguous")


def test_a_look_may_have_two_words() -> None:
    layout = (LayoutObject("tumbler_0", "an orange tumbler", (8.0, 8.0, 12.0), (30.0, 30.0, 6.0), 0), APPLE)
    (changed,) = planned("orange is sooo 2010, make the tumbler mint green", layout).objects
    assert changed.instance == "tumbler_0"
    assert {"mint", "green"} <= set(changed.description.split())


def test_what_is_taken_out_goes() -> None:
    assert planned("Take out the can and move the apple to the front left corner.").removed == ("can_0",)


def test_two_go_together() -> None:
    assert set(planned("Remove the can along with its apple.").removed) == {"can_0", "apple_0"}


def test_a_carrier_goes_with_its_contents() -> None:
    layout = (
        described("serving_tray_0", "a red tray", 30, 30),
        LayoutObject("apple_0", "a green apple", (8.0, 8.0, 8.0), (30.0, 30.0, 8.0), 0),
        described("mug_0", "a mug", 90, 30),
    )
    alone = planned("Take the tray away.", layout)
    both = planned("Take the tray away and whatever is on it.", layout)
    assert (alone.removed, set(both.removed)) == (("serving_tray_0",), {"serving_tray_0", "apple_0"})


def test_the_top_of_a_pile_is_where_things_go() -> None:
    napkins = tuple(LayoutObject(f"napkin_{k}", "a napkin", (20.0, 20.0, 1.0), (40.0, 30.0, 0.5 + k), 0) for k in range(2))
    (moved,) = planned("Put the apple on the napkins.", (*napkins, APPLE)).objects
    assert moved.position_cm[2] > 2.0


def test_what_is_put_on_the_table_leaves_its_carrier() -> None:
    layout = (
        described("serving_tray_0", "a red tray", 30, 30),
        LayoutObject("apple_0", "a green apple", (8.0, 8.0, 8.0), (30.0, 30.0, 8.0), 0),
    )
    (moved,) = planned("Stand the apple on the tabletop.", layout).objects
    assert moved.instance == "apple_0"
    assert moved.position_cm[2] == pytest.approx(4.0)


def test_a_new_thing_has_the_place_that_is_spoken_of() -> None:
    (new,) = planned("Nothing stands in the back left corner. Add an orange there.").objects
    assert (new.category, new.position_cm[0] < 40, new.position_cm[1] > 30) == ("orange", True, True)


def test_parts_and_purposes_of_a_new_object_are_no_objects() -> None:
    assert categories(planned("Exchange the can for a small mug with a lid and a clasp.")) == ["mug"]
    assert categories(planned("Add a red mug without a handle behind the apple.")) == ["mug"]
