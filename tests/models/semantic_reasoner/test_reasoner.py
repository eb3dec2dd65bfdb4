from collections.abc import Sequence
from dataclasses import replace

from models.semantic_reasoner.engines.protocol import Completion, Request
from models.semantic_reasoner.reasoner import SemanticReasoner
from models.semantic_reasoner.replies.checks import ReplyCheck, ReplyFault, form_check
from models.semantic_reasoner.replies.required_objects import RequiredObjects
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply, render_objects
from stable_data.scene import Stage, Tabletop
from tests.models.semantic_reasoner.language import known_categories
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, interpreter, thing

TABLE = Tabletop("office_table", (1.12, 0.593))
ASK = ReasonerQuestion("Put the mug on the book.", TABLE, Stage.TASK)
MUG = LayoutObject("mug_0", "a red mug", (9.0, 8.4, 10.0), (20.0, 30.5, 5.0), -15)
GOOD, ODD, BAD = (render_objects([replace(MUG, description=d)]) for d in ("a good mug", "an odd mug", "a bad mug"))


class Told:
    """An engine that says what it is told to, and remembers what it was asked."""

    name, repeats = "told", True

    def __init__(self, *rounds: Sequence[str | Completion]) -> None:
        self._rounds, self.asked = list(rounds), list[Sequence[Request]]()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.asked.append(requests)
        answers = self._rounds.pop(0)
        assert len(answers) == len(requests)
        return [a if isinstance(a, Completion) else Completion(a, 10, 5, cost=0.5) for a in answers]


def faults(reply: LayoutReply, ask: ReasonerQuestion) -> list[ReplyFault]:
    words = reply.objects[0].description if reply.objects else "nothing"
    if "bad" in words:
        return [ReplyFault("mug_bad", "mug_0 is bad; take another")]
    return [ReplyFault("mug_odd", "mug_0 is odd", is_hard=False)] if "odd" in words else []


def test_a_good_answer_is_taken_at_once() -> None:
    engine = Told([GOOD])
    (p,) = SemanticReasoner(engine, faults).propose([ASK], [7])
    assert render_objects(p.objects) == GOOD
    assert (p.tries, p.faults, p.refused, p.failure, p.cost) == (1, (), (), "", 0.5)


def test_only_what_was_refused_is_asked_again_with_another_seed_and_the_reason() -> None:
    engine = Told([BAD, GOOD, "no json"], [GOOD, GOOD])
    found = SemanticReasoner(engine, faults, tells_reasons=True).propose([ASK, ASK, ASK], [1, 2, 3])
    assert [render_objects(p.objects) for p in found] == [GOOD] * 3
    assert [p.tries for p in found] == [2, 1, 2]
    assert [p.refused[0].faults[0].code for p in found if p.refused] == ["mug_bad", "reply_not_json"]
    again = engine.asked[1][0]
    assert "mug_0 is bad" in again.messages[-1]["content"]
    assert again.seed != engine.asked[0][0].seed
    assert found[0].prompt_tokens == 20


def test_without_reasons_the_same_question_is_drawn_anew() -> None:
    engine = Told([BAD], [GOOD])
    SemanticReasoner(engine, faults).propose([ASK], [1])
    assert engine.asked[0][0].messages == engine.asked[1][0].messages
    assert engine.asked[0][0].seed != engine.asked[1][0].seed


def test_tries_are_bounded_and_the_last_reason_is_said() -> None:
    engine = Told([BAD], [BAD], [BAD])
    (p,) = SemanticReasoner(engine, faults, tries=3).propose([ASK], [1])
    assert p.reply is None
    assert (p.code, len(p.refused)) == ("reply_unusable", 3)
    assert "mug_0 is bad" in p.failure


def test_the_best_of_what_is_soft_is_taken_in_the_end_and_named() -> None:
    engine = Told([BAD], [ODD], [BAD])
    (p,) = SemanticReasoner(engine, faults, tries=3).propose([ASK], [1])
    assert render_objects(p.objects) == ODD
    assert [f.code for f in p.faults] == ["mug_odd"]
    assert p.tries == 3


def test_a_failure_of_one_does_not_touch_the_others() -> None:
    engine = Told([Completion("", failure="endpoint down", code="endpoint_down"), GOOD])
    asks = [ASK, replace(ASK, instruction=""), ASK]
    down, empty, fine = SemanticReasoner(engine, faults).propose(asks, [1, 2, 3])
    assert (down.code, empty.code) == ("endpoint_down", "instruction_invalid")
    assert fine.reply is not None
    assert [p.tries for p in (down, empty, fine)] == [1, 0, 1]


def test_a_cut_off_answer_is_asked_for_again() -> None:
    engine = Told([Completion("", failure="cut off", code="reply_cut")], [GOOD])
    (p,) = SemanticReasoner(engine, faults).propose([ASK], [1])
    assert p.reply is not None
    assert p.tries == 2


def test_nothing_asked_is_nothing_found() -> None:
    assert SemanticReasoner(Told(), faults).propose([], []) == []


def test_an_edit_that_does_something_oddly_is_better_than_one_that_does_nothing() -> None:
    edit = replace(ASK, wanted="edit", layout=(MUG,))
    nothing = render_objects([], ())
    odd = render_objects([replace(MUG, description="an odd, red mug")], ())

    def check(reply: LayoutReply, ask: ReasonerQuestion) -> list[ReplyFault]:
        return form_check(reply, ask) or [
            ReplyFault("mug_odd", "odd", is_hard=False),
            ReplyFault("mug_red", "red", is_hard=False),
        ]

    (p,) = SemanticReasoner(Told([nothing], [odd], [nothing]), check, tries=3).propose([edit], [1])
    assert render_objects(p.objects, ()) == odd
    (p,) = SemanticReasoner(Told([nothing], [nothing]), check, tries=2).propose([edit], [1])
    assert p.reply == LayoutReply((), ())
    assert [f.code for f in p.faults] == ["nothing_changed"]


def test_what_is_faulty_in_every_answer_is_left_out_in_the_end_and_what_rests_on_it_too() -> None:
    plate, bowl = replace(MUG, instance="plate_0"), replace(MUG, instance="bowl_0", description="a bowl")
    answers = [render_objects(objects) for objects in ([MUG, plate, bowl], [MUG, plate], [plate, bowl])]

    def check(reply: LayoutReply, ask: ReasonerQuestion) -> list[ReplyFault]:
        names = {o.instance for o in reply.objects}
        if "mug_0" not in names:
            return [ReplyFault("required_missing", "there is no mug")]
        if "plate_0" in names:
            return [ReplyFault("off_table", "plate_0 leaves the table", instance="plate_0")]
        return [ReplyFault("floats", "bowl_0 is in the air", instance="bowl_0")] if "bowl_0" in names else []

    (p,) = SemanticReasoner(Told(*([a] for a in answers)), check, tries=3).propose([ASK], [1])
    assert [o.instance for o in p.objects] == ["mug_0"]
    assert [(f.code, f.message) for f in p.faults] == [("left_out", "plate_0 is left out: plate_0 leaves the table")]
    assert (p.tries, len(p.refused), p.failure) == (3, 3, "")
    (p,) = SemanticReasoner(Told([answers[0]]), check, tries=1).propose([ASK], [1])
    assert [f.message for f in p.faults] == [
        "plate_0 is left out: plate_0 leaves the table",
        "bowl_0 is left out: bowl_0 is in the air",
    ]
    (p,) = SemanticReasoner(Told([answers[2]]), check, tries=1).propose([ASK], [1])
    assert (p.reply, p.code) == (None, "reply_unusable")


def test_a_long_later_list_is_taken_without_the_few_that_cannot_stay() -> None:
    """One of eight is not worth asking again for; one of seven is, and so is anything that the first stage lacks."""

    def check(reply: LayoutReply, ask: ReasonerQuestion) -> list[ReplyFault]:
        gone = [o.instance for o in reply.objects if o.description == "a bad mug"]
        return [ReplyFault("same_place", f"{name} is where another is", instance=name) for name in gone]

    bad = replace(MUG, instance="mug_9", description="a bad mug")
    eight = render_objects([bad, *(replace(MUG, instance=f"mug_{k}") for k in range(7))])
    seven = render_objects([bad, *(replace(MUG, instance=f"mug_{k}") for k in range(6))])
    later = replace(ASK, wanted=Stage.SECONDARY)
    (p,) = SemanticReasoner(Told([eight]), check).propose([later], [1])
    assert (len(p.objects), p.tries, [f.code for f in p.faults]) == (7, 1, ["left_out"])
    for ask, answer in ((later, seven), (ASK, eight)):
        (p,) = SemanticReasoner(Told([answer], [GOOD]), check).propose([ask], [1])
        assert (render_objects(p.objects), p.tries) == (GOOD, 2)


CHECK = ReplyCheck(STATISTICS, interpreter())
REQUIRED = RequiredObjects(STATISTICS, interpreter(), 60)


def rows_of_mugs(count: int, *others: LayoutObject) -> str:
    mugs = (thing(f"mug_{k}", 8 + 12 * (k % 9), 8 + 10 * (k // 9)) for k in range(count))
    return render_objects([*mugs, *others])


def test_more_than_there_is_room_for_is_not_asked_for() -> None:
    engine = Told()
    reasoner = SemanticReasoner(engine, CHECK, required=REQUIRED)
    found = reasoner.propose(
        [
            known_categories.ask("one thousand plates"),
            known_categories.ask("thirty plates", "whole"),
            known_categories.ask("Add 90 mugs.", "edit"),
        ],
        [1, 2, 3],
    )
    assert [(p.code, p.tries, p.reply) for p in found] == [("too_many_objects", 0, None)] * 3
    assert not engine.asked


def test_a_few_required_objects_that_cannot_stay_are_placed_anew_at_once() -> None:
    question = known_categories.ask("Put sixteen mugs on the table.")
    off, double = thing("mug_14", 150, 30), thing("mug_15", 8, 8)
    reasoner = SemanticReasoner(Told([rows_of_mugs(14, off, double)]), CHECK, required=REQUIRED)
    (p,) = reasoner.propose([question], [1])
    assert (p.tries, [f.code for f in p.faults]) == (1, ["placed_anew"] * 2)
    assert p.reply is not None
    assert not CHECK(p.reply, question)


def test_a_lacking_object_is_asked_for_again_before_it_is_added() -> None:
    lacking = rows_of_mugs(11)
    question = known_categories.ask("Put twelve mugs and a laptop on the table.")
    (p,) = SemanticReasoner(Told([lacking], [lacking]), CHECK, 2, required=REQUIRED).propose([question], [1])
    assert (p.tries, [f.code for f in p.faults]) == (2, ["placed_anew"] * 2)
    assert p.faults[0].message == "laptop_0 is placed anew: the answer lacks it"
    assert [o.category for o in p.objects].count("mug") == 12


def test_many_objects_are_not_asked_for_again_and_again() -> None:
    """What can be used is used as soon as the refused answers have sixty objects; a few objects get all their tries."""
    many, few = rows_of_mugs(29, thing("cup_0", 300, 5)), render_objects([thing("mug_0", 20, 20), thing("cup_0", 300, 5)])
    first, other = known_categories.ask("Put 29 mugs on the table."), known_categories.ask("Put a mug on the table.")
    (p,) = SemanticReasoner(Told([many], [many]), CHECK, 16, required=REQUIRED).propose([first], [1])
    assert (p.tries, [f.code for f in p.faults]) == (2, ["left_out"])
    (p,) = SemanticReasoner(Told(*[[few]] * 16), CHECK, 16, required=REQUIRED).propose([other], [1])
    assert (p.tries, len(p.objects)) == (16, 1)
