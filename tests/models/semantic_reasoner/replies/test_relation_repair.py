"""What an instruction says of the start is made so where every answer had it otherwise, and what was moved is said."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.replies.checks import ReplyCheck, ReplyFault
from models.semantic_reasoner.replies.relation_repair import repair_relations
from models.semantic_reasoner.text.prompt import ReasonerQuestion, assistant_message
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, ask, interpreter, thing

CHECK = ReplyCheck(STATISTICS, interpreter())
MUG, PLATE = thing("mug_0", 20, 10), thing("plate_0", 70, 30)
CUP, APPLE, TRAY = thing("cup_0", 30, 45), thing("apple_0", 70, 50), thing("serving_tray_0", 70, 30)


def righted(objects: Sequence[LayoutObject], said: ReasonerQuestion) -> tuple[LayoutReply, tuple[ReplyFault, ...]] | None:
    reply = LayoutReply(tuple(objects))
    return repair_relations(reply, CHECK(reply, said), said, CHECK)


@pytest.mark.parametrize(
    ("instruction", "objects"),
    [
        ("Move the mug that is in the front right corner to the back.", [MUG, PLATE]),
        ("Move the plate that is in the back left corner to the front.", [PLATE, thing("mug_0", 70, 30, bottom=2.0)]),
        ("Take the mug off the plate.", [PLATE, MUG]),
        ("The mug is to the right of the plate but should be to the left of it. Move it.", [PLATE, MUG]),
        ("Sort the cup, the apple and the mug standing behind the plate by height.", [PLATE, CUP, APPLE, MUG]),
        ("The mug is in front of the cup but should be behind it. Move it.", [TRAY, thing("mug_0", 60, 36, bottom=4.0), CUP]),
        ("Take the tin out of the tray.", [TRAY, thing("can_0", 20, 30)]),
        ("Take the mug that is in the back right corner off the plate.", [PLATE, MUG]),
        ("Take the mug that stands between the plate and the cup.", [PLATE, MUG, CUP]),
    ],
)
def test_things_are_put_where_the_instruction_says(instruction: str, objects: list[LayoutObject]) -> None:
    said = ask(instruction)
    assert {f.code for f in CHECK(LayoutReply(tuple(objects)), said)} == {"relation_not_held"}
    found = righted(objects, said)
    assert found is not None
    reply, told = found
    assert not CHECK(reply, said)
    assert {f.code for f in told} == {"moved_to_hold"}
    assert all("as the instruction says" in f.message and not f.is_hard for f in told)
    stays = [o for o in objects if not any(f.message.startswith(o.instance) for f in told)]
    carried = {"mug_0"} if "back left" in instruction else set()
    assert [o for o in reply.objects if o in stays] == [o for o in stays if o.instance not in carried]


def test_what_lies_on_a_thing_goes_along() -> None:
    plate, mug = PLATE, thing("mug_0", 71, 31, bottom=2.0)
    found = righted([plate, mug], ask("Move the plate that is in the back left corner to the front."))
    assert found is not None
    moved_plate, moved_mug = found[0].objects
    off = [round(b - a, 1) for a, b in zip(moved_plate.position_cm, moved_mug.position_cm, strict=True)]
    assert off == [round(b - a, 1) for a, b in zip(plate.position_cm, mug.position_cm, strict=True)]


def test_what_lies_the_wrong_way_round_is_turned_over() -> None:
    plate, mug, apple = thing("plate_0", 70, 30), thing("mug_0", 70, 30, bottom=2.0), thing("apple_0", 30, 45)
    said = ask("Take the plate off the mug.")
    found = righted([plate, mug, apple], said)
    assert found is not None
    reply, told = found
    assert not CHECK(reply, said)
    assert [f.message.split(" so ")[0] for f in told] == ["plate_0 is moved"]
    lower, upper = reply.objects[1], reply.objects[0]
    assert lower.position_cm[2] == pytest.approx(lower.size_cm[2] / 2, abs=0.06)  # the mug is on the table now
    assert upper.position_cm[2] - upper.size_cm[2] / 2 >= lower.size_cm[2] - 0.5
    assert reply.objects[2] == apple


def test_what_shall_be_emptied_gets_something() -> None:
    found = righted([PLATE, MUG], ask("Take everything off the plate."))
    assert found is not None
    assert [f.message.split(" so ")[0] for f in found[1]] == ["mug_0 is moved"]


def test_what_cannot_be_put_right_is_left_to_others() -> None:
    aside = ask("Take the mug off the plate.")
    assert righted([replace(PLATE, position_cm=(300.0, 30.0, 1.0)), MUG], aside) is None  # it is not its only fault
    narrow = ask("The mug is to the left of the plate. Lift it.", size_xy=(0.28, 0.3))
    assert righted([thing("plate_0", 14, 14), thing("mug_0", 14, 15, bottom=2.0)], narrow) is None  # no room


@pytest.mark.parametrize(
    ("instruction", "objects", "most_moves"),
    [
        ("There are forty cookies on the plate.", [PLATE, *(thing(f"cookie_{k}", 5 + 2 * k, 6) for k in range(40))], 40),
        ("Take the ten cookies out of the mug.", [MUG, *(thing(f"cookie_{k}", 5 + 7 * k, 45) for k in range(10))], 10),
        ("There is a stack of six plates.", [thing(f"plate_{k}", 14 + 30 * (k % 3), 14 + 30 * (k // 3)) for k in range(6)], 5),
    ],
)
def test_many_things_are_put_on_or_in_their_carriers_at_once(
    instruction: str, objects: list[LayoutObject], most_moves: int
) -> None:
    said, num_checks = ask(instruction), 0

    def check(reply: LayoutReply, question: ReasonerQuestion) -> list[ReplyFault]:
        nonlocal num_checks
        num_checks += 1
        return CHECK(reply, question)

    reply = LayoutReply(tuple(objects))
    found = repair_relations(reply, CHECK(reply, said), said, check)
    assert found is not None
    assert not CHECK(found[0], said)
    assert num_checks == 1
    assert 0 < len(found[1]) <= most_moves


def test_a_search_among_many_layouts_ends() -> None:
    """Twenty mugs do not stay on a pen, wherever each of them is tried."""
    mugs = (thing(f"mug_{k}", 10 + 11 * (k % 10), 16 + 10 * (k // 10)) for k in range(20))
    assert righted([thing("pen_0", 60, 5), *mugs], ask("There are twenty mugs on the pen.")) is None


def test_it_is_the_last_resort() -> None:
    said = ask("Take the mug off the plate.")
    wrong, right = (assistant_message(objects) for objects in ([PLATE, MUG], [PLATE, thing("mug_0", 70, 30, bottom=2.0)]))

    def proposal(*answers: str) -> tuple[int, set[str]]:
        replies = iter(answers)
        engine = ScriptedEngine(lambda request: next(replies))
        (found,) = SemanticReasoner(engine, CHECK, tries=len(answers)).propose([said], [0])
        assert found.reply is not None
        assert not CHECK(found.reply, said)
        return found.tries, {f.code for f in found.faults}

    assert proposal(wrong, right) == (2, set())
    assert proposal(wrong, wrong) == (2, {"moved_to_hold"})
