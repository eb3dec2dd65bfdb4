"""The handwritten instructions can be judged: the embedded world has what they need, and nothing of what it shall not have."""

from collections import Counter

from stable_data.embedded_world.families.catalogue import BY_CATEGORY
from stable_data.instructions.wording.vocabulary import closeness
from stable_data.scene import RelationKind
from tests.models.semantic_reasoner.handwritten import read_handwritten

TABLES = {"office_table", "dining_table", "kitchen_counter", "coffee_table", "bathroom_vanity", "dressing_table"}
UNSEEN = {"nightstand", "tv_stand"}
KINDS = {
    RelationKind.IN,
    RelationKind.ON,
    RelationKind.LEFT_OF,
    RelationKind.RIGHT_OF,
    RelationKind.IN_FRONT_OF,
    RelationKind.BEHIND,
}


def test_there_are_forty_over_all_kinds_of_tables() -> None:
    found = read_handwritten()
    assert len({one.instruction for one in found}) == 40
    count = Counter(one.table.table_type for one in found)
    assert set(count) == TABLES | UNSEEN
    assert min(count.values()) >= 3
    assert sum(bool(one.unknown) for one in found) == 6
    assert {r.kind for one in found for r in one.reference.entailed} == KINDS


def test_the_embedded_world_has_every_object_that_is_asked_for() -> None:
    asked = {category for one in read_handwritten() for r in one.reference.required for category in r.categories}
    assert asked <= set(BY_CATEGORY)


def test_the_embedded_world_has_nothing_like_the_unknown_ones() -> None:
    for one in read_handwritten():
        for thing in one.unknown:
            assert thing in one.instruction
            assert not [category for category in BY_CATEGORY if closeness(category, thing)]


def test_nothing_is_said_to_be_in_or_on_itself_or_in_two_things() -> None:
    for one in read_handwritten():
        carried = [r.subject for r in one.reference.entailed if r.kind in (RelationKind.IN, RelationKind.ON)]
        assert len(set(carried)) == len(carried)
        assert all(r.subject != r.target for r in one.reference.entailed)
