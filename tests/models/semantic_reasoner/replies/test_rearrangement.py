"""Several objects are placed together where moves of single ones do not make all stated relations hold."""

from collections.abc import Sequence

import numpy as np
import pytest

from models.semantic_reasoner.language.interpreter import compare_with_instruction, relations_of_task
from models.semantic_reasoner.replies.checks import ReplyCheck, ReplyFault
from models.semantic_reasoner.replies.rearrangement import rearrangements
from models.semantic_reasoner.replies.relation_repair import repair_relations
from models.semantic_reasoner.text.prompt import ReasonerQuestion
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from stable_data.scene import Relation, RelationKind, Tabletop
from stable_data.scene_graph.support_from_boxes import carriers_of
from tests.models.semantic_reasoner.language.known_categories import STATISTICS, ask, interpreter, thing

INTERPRET = interpreter()
CHECK = ReplyCheck(STATISTICS, INTERPRET)
LEFT, FRONT = RelationKind.LEFT_OF, RelationKind.IN_FRONT_OF


def stated_of(objects: Sequence[LayoutObject], said: ReasonerQuestion) -> tuple[Relation, ...]:
    layout = [o.to_scene_object() for o in (*said.layout, *objects)]
    found, _ = compare_with_instruction(layout, said.table, INTERPRET(said.instruction))
    assert found is not None
    return relations_of_task(found)


def repaired(objects: Sequence[LayoutObject], said: ReasonerQuestion, together: bool) -> LayoutReply | None:
    reply = LayoutReply(tuple(objects))
    found = repair_relations(reply, CHECK(reply, said), said, CHECK, stated_of(objects, said) if together else ())
    return None if found is None else found[0]


CASES = [
    (  # neither fits in front of or behind the other one where that stands
        "Take the tray that is behind the cutting board.",
        (0.9, 0.6),
        [thing("serving_tray_0", 25, 30), thing("cutting_board_0", 65, 30)],
    ),
    (  # each move that mends one relation breaks another one
        "The cup is left of the mug, the mug is left of the apple, and the apple is left of the orange. Lift the orange.",
        (0.5, 0.3),
        [thing("cup_0", 44, 15), thing("mug_0", 32, 15), thing("apple_0", 20, 15), thing("orange_0", 6, 15)],
    ),
]


@pytest.mark.parametrize(("instruction", "size", "objects"), CASES)
def test_objects_are_moved_together_where_one_move_after_the_other_fails(
    instruction: str, size: tuple[float, float], objects: list[LayoutObject]
) -> None:
    said = ask(instruction, size_xy=size)
    assert {f.code for f in CHECK(LayoutReply(tuple(objects)), said)} == {"relation_not_held"}
    assert repaired(objects, said, together=False) is None
    reply = repaired(objects, said, together=True)
    assert reply is not None
    assert not CHECK(reply, said)
    assert [o.instance for o in reply.objects] == [o.instance for o in objects]


def test_a_broken_relation_may_name_another_one_of_alike_objects() -> None:
    """The check compares what is said with the objects that fit best; what is stated is known by the names of before."""
    said = ask("Take the mug.")
    reply = LayoutReply((thing("mug_0", 60, 30), thing("mug_1", 100, 30), thing("cup_0", 30, 15)))
    fault = ReplyFault("relation_not_held", "", is_hard=False, relation=Relation("mug_1", RelationKind.IS_AT, "left"))
    checked = list[LayoutReply]()

    def check(candidate: LayoutReply, question: ReasonerQuestion) -> list[ReplyFault]:
        checked.append(candidate)
        return [fault] if len(checked) < 40 else []

    stated = [Relation("cup_0", LEFT, "mug_0"), Relation("mug_0", RelationKind.IS_AT, "left")]
    found = repair_relations(reply, [fault], said, check, stated)
    assert len(checked) > 1
    assert found is None or "mug_1 is moved so that mug_1 is at left" in found[1][0].message


def places(
    objects: Sequence[LayoutObject], stated: Sequence[Relation], movable: set[str], table: Tabletop
) -> dict[str, tuple[float, float, float]] | None:
    layout = {o.instance: o.to_scene_object() for o in objects}
    carriers = carriers_of(list(layout.values()), table)
    return next(rearrangements(layout, carriers, movable, stated, stated, table), None)


def test_what_stands_and_what_is_forbidden_is_kept_free() -> None:
    table = Tabletop("office_table", (1.2, 0.6), (0.0, 1.2, 0.4, 0.6))
    objects = [thing("mug_0", 20, 30), thing("cup_0", 100, 30), thing("laptop_0", 60, 15)]
    found = places(objects, [Relation("cup_0", LEFT, "mug_0")], {"mug_0", "cup_0"}, table)
    assert found is not None
    assert found.keys() == {"mug_0", "cup_0"}
    for name, half in (("mug_0", (0.055, 0.04)), ("cup_0", (0.04, 0.04))):
        low, high = np.subtract(found[name][:2], half), np.add(found[name][:2], half)
        assert high[1] <= 0.4
        assert (low >= 0).all()
        assert low[0] >= 0.6 + 0.165 or high[0] <= 0.6 - 0.165 or low[1] >= 0.15 + 0.115


def test_contents_go_along_and_what_may_not_move_stays() -> None:
    table = Tabletop("office_table", (1.2, 0.6))
    objects = [thing("plate_0", 20, 30), thing("mug_0", 20, 30, bottom=2.0), thing("cup_0", 60, 30)]
    stated = [Relation("cup_0", LEFT, "mug_0")]
    found = places(objects, stated, {"plate_0", "mug_0"}, table)
    assert found is not None
    assert found.keys() == {"plate_0"}  # the mug's carrier, right of the cup
    assert found["plate_0"][0] > 0.6
    assert places(objects, stated, {"mug_0"}, table) is None  # its carrier may not move


def test_only_what_is_linked_with_a_broken_relation_moves() -> None:
    table = Tabletop("office_table", (1.2, 0.6))
    objects = [thing("plate_0", 90, 45), thing("mug_0", 20, 30), thing("cup_0", 60, 30), thing("apple_0", 90, 15)]
    layout = {o.instance: o.to_scene_object() for o in objects}
    carriers = carriers_of(list(layout.values()), table)
    broken, holds = Relation("cup_0", LEFT, "mug_0"), Relation("apple_0", FRONT, "plate_0")
    found = next(rearrangements(layout, carriers, layout.keys(), [broken, holds], [broken], table))
    assert found.keys() == {"mug_0", "cup_0"}


def test_what_contradicts_itself_has_no_places() -> None:
    objects = [thing("mug_0", 20, 30), thing("cup_0", 60, 30), thing("apple_0", 90, 15)]
    circle = [Relation("mug_0", LEFT, "cup_0"), Relation("cup_0", LEFT, "apple_0"), Relation("apple_0", LEFT, "mug_0")]
    assert places(objects, circle, {o.instance for o in objects}, Tabletop("office_table", (1.2, 0.6))) is None
