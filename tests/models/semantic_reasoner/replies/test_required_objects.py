"""Instructions that ask for very many objects are refused at once, or get all of them."""

from collections import Counter

import pytest

from models.semantic_reasoner.replies.checks import ReplyCheck, ReplyFault
from models.semantic_reasoner.replies.required_objects import RequiredObjects
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutReply
from stable_data.errors import SceneError
from stable_data.scene import Stage
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, ask, interpreter, thing

REQUIRED = RequiredObjects(STATISTICS, interpreter(), 60)
CHECK = ReplyCheck(STATISTICS, interpreter())


def refusal(question: ReasonerQuestion) -> str:
    with pytest.raises(SceneError) as caught:
        REQUIRED.check_room(question)
    assert caught.value.code == "too_many_objects"
    return str(caught.value)


@pytest.mark.parametrize(
    ("instruction", "reason"),
    [
        ("one thousand plates", "requires 1,000 objects, expected at most 60 (reasoner.checks.most_objects); ask for fewer"),
        ("a million mugs", "requires 1,000,000 objects, expected at most 60"),
        ("Forty mugs, thirty plates and a pen", "requires 71 objects, expected at most 60"),
        (
            "30 plates",
            "requires 30 objects on the table, whose 120 x 60 cm have room for 10; ask for fewer, or for a larger table",
        ),
        (
            "There are fifty oranges on the plate.",
            "requires 50 objects on the plate, which has room for at most 48; ask for fewer",
        ),
        (
            "There are twenty oranges in the mug.",
            "requires 20 objects in the mug, which has room for at most 14; ask for fewer",
        ),
    ],
)
def test_what_cannot_have_room_is_refused_with_what_is_asked_and_what_can_be(instruction: str, reason: str) -> None:
    assert reason in refusal(ask(instruction))


@pytest.mark.parametrize(
    "instruction",
    [
        "Put forty mugs on the table.",
        "There are fifty cookies on the plate.",
        "a stack of thirty plates",
        "A book on the pen.",
        "Go!",
    ],
)
def test_what_may_have_room_is_not_refused(instruction: str) -> None:
    REQUIRED.check_room(ask(instruction))


def test_a_larger_table_and_a_larger_bound_have_room_for_more() -> None:
    REQUIRED.check_room(ask("30 plates", size_xy=(2.4, 1.2)))
    RequiredObjects(STATISTICS, interpreter(), 80).check_room(ask("seventy cookies"))
    assert "room for 0" in refusal(ask("Close the laptop.", size_xy=(0.2, 0.2)))
    assert "room for 4" in refusal(ask("Put ten plates on the table.", zone=(0.6, 1.2, 0.0, 0.6)))


def test_an_edit_may_name_many_objects_and_add_few() -> None:
    there = [thing("plate_0", 20, 20)]
    REQUIRED.check_room(ask("Remove the seventy mugs.", "edit", there))
    assert "requires 70 objects" in refusal(ask("Add seventy mugs.", "edit", there))
    assert "requires 2,000 objects, expected at most 1,000; ask" in refusal(ask("Remove the 2,000 mugs.", "edit", there))
    assert "requires 30 objects on the table" in refusal(ask("Add thirty plates.", "edit", there))


def test_later_stages_are_not_judged() -> None:
    REQUIRED.check_room(ask("one thousand plates", Stage.IMPORTANT, [thing("plate_0", 20, 20)]))


def test_what_a_reply_lacks_is_added_beside_it() -> None:
    question = ask("Put twelve mugs and a laptop on the table.")
    reply = LayoutReply((thing("mug_0", 30, 30, size=(10.0, 8.0, 9.0)), thing("mug_3", 60, 30), thing("pen_0", 90, 30)))
    off = thing("mug_1", 140, 30)
    removed = [(off, ReplyFault("off_table", "mug_1 leaves the table")), (thing("cup_0", 300, 0), ReplyFault("floats", "high"))]
    whole, faults, left = next(REQUIRED.completed(reply, removed, question))
    assert not CHECK(whole, question)
    assert whole.objects[:3] == reply.objects
    assert Counter(o.category for o in whole.objects) == {"mug": 12, "laptop": 1, "pen": 1}
    assert len({o.instance for o in whole.objects}) == 14
    assert [f.code for f in faults] == ["placed_anew"] * 11
    assert {f.message.partition(": ")[2] for f in faults} == {
        "mug_1 leaves the table",
        "the answer has too few of them",
        "the answer lacks it",
    }
    assert left == removed[1:]
    sizes = {o.size_cm for o in whole.objects if o.category == "mug"}
    assert (10.0, 8.0, 9.0) in sizes


def test_where_there_is_no_room_others_are_removed_and_then_all_placed_anew_and_small() -> None:
    question = ask("Put eight plates on the table.")
    plates = [thing(f"plate_{k}", 30 + 50 * k, 30) for k in range(2)]
    reply = LayoutReply((*plates, thing("serving_tray_0", 100, 20), thing("pen_0", 55, 5)))
    found = list(REQUIRED.completed(reply, [], question))
    assert all(not any(f.is_hard for f in CHECK(whole, question)) for whole, _, _ in found)
    assert all(sum(o.category == "plate" for o in whole.objects) == 8 for whole, _, _ in found)
    _, faults, left = found[0]  # two rows of four have no room beside the plates where these are
    assert {f.message.partition(": ")[2] for f in faults} > {"the answer has too few of them"}
    assert [o.instance for o, _ in left] == ["serving_tray_0", "pen_0"]
    assert {o.size_cm for o in found[-1][0].objects} == {(23.5, 23.5, 1.8)}


def test_nothing_is_added_where_there_is_no_room_at_all() -> None:
    assert not list(REQUIRED.completed(LayoutReply(()), [], ask("Put eleven plates on the table.")))
