"""What objects are told apart by."""

import pytest

from stable_data.instructions.naming import Distinction, ObjectName, holds_relation, mentions
from stable_data.instructions.wording.vocabulary import answers_to
from stable_data.scene import RelationKind
from tests.stable_data.instructions.tables import DINING, MUG, TABLES, Table, Thing, table


def row(*things: tuple[str, float, float, str], size: tuple[float, float] = (1.2, 0.6)) -> Table:
    return table("coffee_table", [Thing(name, x, y, MUG, words=words) for name, x, y, words in things], size)


def test_one_of_a_kind_needs_no_more_than_its_noun() -> None:
    lone = row(("mug_0", 0.3, 0.3, ""), ("vase_0", 0.8, 0.3, ""))
    assert lone.words("mug_0")[:2] == ["the mug", "the cup"]


def test_a_synonym_that_another_thing_answers_to_is_not_said_of_it_alone() -> None:
    two = row(("mug_0", 0.3, 0.3, ""), ("teacup_0", 0.8, 0.3, ""))
    assert "the mug" in two.words("mug_0")
    assert "the cup" not in two.words("mug_0")
    assert "the left-hand cup" in two.words("mug_0")


def test_a_general_noun_is_not_said_of_one_thing_where_a_special_one_is_there_too() -> None:
    two = row(("bowl_0", 0.3, 0.3, ""), ("cereal_bowl_0", 0.8, 0.3, ""))
    assert "the bowl" not in two.words("bowl_0")
    assert "the cereal bowl" in two.words("cereal_bowl_0")


def test_colours_tell_apart_where_both_are_known_and_differ() -> None:
    assert "the red mug" in DINING.words("mug_0")
    assert "the white mug" not in DINING.words("mug_0")  # of its rim
    near = row(("mug_0", 0.3, 0.3, "blue mug"), ("mug_1", 0.8, 0.3, "navy mug"))
    assert not [w for w in near.words("mug_0") if "blue" in w]
    unknown = row(("mug_0", 0.3, 0.3, "blue mug"), ("mug_1", 0.8, 0.3, "a mug"))
    assert not [w for w in unknown.words("mug_0") if "blue" in w]


def test_sizes_tell_apart_only_where_they_differ_clearly() -> None:
    sizes = [(0.06, 0.06, 0.07), (0.09, 0.09, 0.1), (0.091, 0.09, 0.1)]
    three = table("x", [Thing(f"vase_{k}", 0.2 + 0.3 * k, 0.3, size) for k, size in enumerate(sizes)], (1.2, 0.6))
    assert "the smallest vase" in three.words("vase_0")
    assert not [w for k in (1, 2) for w in three.words(f"vase_{k}") if "large" in w or "big" in w]


def test_places_tell_apart() -> None:
    three = row(("mug_0", 0.2, 0.3, ""), ("mug_1", 0.5, 0.3, ""), ("mug_2", 0.9, 0.3, ""))
    assert "the leftmost mug" in three.words("mug_0")
    assert "the middle mug" in three.words("mug_1")
    assert "the rightmost mug" in three.words("mug_2")
    close = row(("mug_0", 0.5, 0.3, ""), ("mug_1", 0.51, 0.3, ""))
    assert close.words("mug_0") == []


def test_other_things_tell_apart() -> None:
    things = [
        Thing("book_0", 0.3, 0.3, (0.15, 0.2, 0.03)),
        Thing("mug_0", 0.3, 0.3, MUG, z=0.03),
        Thing("mug_1", 0.9, 0.3, MUG),
        Thing("lamp_0", 1.0, 0.3, (0.1, 0.1, 0.4)),
    ]
    two = table("coffee_table", things, (1.2, 0.6))
    assert {"the mug that is on the book", "the mug resting on the book"} <= set(two.words("mug_0"))
    assert "the mug that is next to the lamp" in two.words("mug_1")
    (name,) = [n for n in two.namer.names("2_mug_0") if n.words == "the mug that is on the book"]
    assert name.anchor == "1_book_0"
    assert name.relation == holds_relation(two.graph, "2_mug_0", RelationKind.ON, "1_book_0")


@pytest.mark.parametrize("one", TABLES, ids=lambda t: t.scene.scene_id)
def test_no_two_objects_share_a_name(one: Table) -> None:
    owner: dict[str, str] = {}
    for o in one.scene.objects:
        for name in one.namer.names(o.instance):
            assert owner.setdefault(name.words, o.instance) == o.instance
            assert answers_to(o.category, name.noun)
            if name.relation is not None:
                kind = name.relation.kind
                node = one.graph.nodes[name.relation.subject]
                assert one.graph.has_edge(name.relation.subject, name.relation.target, key=kind) or (
                    kind is RelationKind.IS_AT and node["cell"] == name.relation.target
                )


def test_a_name_that_the_words_of_a_task_complete() -> None:
    things = [
        Thing("bowl_0", 0.3, 0.3, (0.2, 0.2, 0.1), container=True),
        Thing("apple_0", 0.3, 0.3, (0.05, 0.05, 0.05), z=0.005),
        Thing("apple_1", 0.31, 0.1, (0.05, 0.05, 0.05)),
    ]
    one = table("x", things, (1.2, 0.6))
    assert [n.words for n in one.namer.linked_names("2_apple_0", "1_bowl_0")] == ["the apple"]
    assert one.namer.linked_names("3_apple_1", "1_bowl_0") == ()


def test_mentions_are_the_longest_names_in_the_order_of_the_text() -> None:
    text = "Put the left-hand plate next to the red mug, then take The Right-Hand Plate."
    found = mentions(text, DINING.namer)
    assert [m.instance.split("_", 1)[1] for m in found] == ["plate_0", "mug_0", "plate_1"]
    assert [text[m.start : m.end].lower() for m in found] == [m.name.words for m in found]


def test_short_names_end_with_their_noun() -> None:
    assert ObjectName("the red mug", "mug", Distinction.LOOK).is_short
    assert not ObjectName("the mug that is on the book", "mug", Distinction.CARRIER).is_short
