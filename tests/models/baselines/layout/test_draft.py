"""Drafts of language models: what is read, what is refused with a reason, and which relations obey the rules."""

import json
from typing import Any

import pytest

from models.baselines.layout.draft import (
    MOST_RELATIONS,
    OBJECTS_FORM,
    RELATIONS_FORM,
    RelationText,
    read_objects,
    read_relations,
    stacked,
)
from models.baselines.layout.layout_draft import relations_of_layout
from models.baselines.layout.relation_checks import check_relations
from models.baselines.placement.problem import Constraint, PlacementRelation
from models.semantic_reasoner.text.reply_json import LayoutObject
from stable_data.errors import SceneError
from stable_data.scene import TABLE, Tabletop
from tests.models.semantic_reasoner.language.known_categories import interpreter

R = PlacementRelation

DESK = Tabletop("office_table", (1.2, 0.6))


def entry(**more: Any) -> dict[str, Any]:
    return {"category": "mug", "description": "a white mug", "size": [11, 8.04, 9.5], "number": 1, **more}


def test_objects_are_numbered_within_their_category() -> None:
    found = read_objects({"objects": [entry(number=2), entry(category="Dinner Plate", size=[26, 26, 2]), entry()]}, DESK)
    assert [o.instance for o in found] == ["mug_0", "mug_1", "dinner_plate_0", "mug_2"]
    assert found[0].size_cm == (11.0, 8.0, 9.5)
    assert [o.instance for o in read_objects({"objects": [entry(category="mug_1")]}, DESK)] == ["mug_0"]
    (bare,) = read_objects({"objects": [{"category": "coffee_cup", "size": [8, 8, 9]}]}, DESK)
    assert bare.description == "coffee cup"


@pytest.mark.parametrize(
    ("document", "code"),
    [
        ([], "reply_malformed"),
        ({"items": []}, "reply_malformed"),
        ({"objects": []}, "layout_empty"),
        ({"objects": ["mug"]}, "reply_malformed"),
        ({"objects": [entry(category="42")]}, "reply_malformed"),
        ({"objects": [entry(size=[1, 2])]}, "reply_malformed"),
        ({"objects": [entry(size=[1, 2, -3])]}, "reply_malformed"),
        ({"objects": [entry(size=[1, 2, 1e9])]}, "reply_malformed"),
        ({"objects": [entry(number=0)]}, "reply_malformed"),
        ({"objects": [entry(number="two")]}, "reply_malformed"),
        ({"objects": [entry(number=10**400)]}, "reply_malformed"),
        ({"objects": [entry(number=200)]}, "too_many"),
        ({"objects": [entry()] * 200}, "too_many"),
        ({"objects": [entry(size=[0.11, 0.08, 0.1])]}, "unit"),
    ],
)
def test_a_list_of_objects_that_cannot_be_used_is_refused_with_a_reason(document: Any, code: str) -> None:
    with pytest.raises(SceneError) as refused:
        read_objects(document, DESK)
    assert refused.value.code == code
    if code == "too_many":
        assert "200 objects" in str(refused.value)


@pytest.mark.parametrize(
    ("document", "code"),
    [
        ({}, "reply_malformed"),
        ({"relations": [["mug_0", "on", "plate_0"]]}, "reply_malformed"),
        ({"relations": [{"subject": "mug_0", "relation": "on"}]}, "reply_malformed"),
        ({"relations": [{"subject": "a", "relation": "on", "target": str(k)} for k in range(MOST_RELATIONS + 1)]}, "too_many"),
    ],
)
def test_a_list_of_relations_that_cannot_be_used_is_refused(document: Any, code: str) -> None:
    with pytest.raises(SceneError) as refused:
        read_relations(document)
    assert refused.value.code == code


def test_an_empty_list_of_relations_is_one() -> None:
    assert read_relations({"relations": []}) == ()


@pytest.mark.parametrize(
    ("relation", "target", "found"),
    [
        ("left_of", "plate_0", "mug_0 left of plate_0"),
        ("To The Right Of", "plate_0", "mug_0 right of plate_0"),
        ("on top of", "plate_0", "mug_0 on plate_0"),
        ("inside", "plate_0", "mug_0 in plate_0"),
        ("next to", "plate_0", "mug_0 near plate_0"),
        ("is at", "back left", "mug_0 is at back_left"),
        ("is at", "left-back", "mug_0 is at back_left"),
        ("is at", "center", "mug_0 is at middle_middle"),
        ("is at", "left", "mug_0 is at middle_left"),
        ("is at", "the moon", None),
        ("face to", "front_left", "mug_0 face to front_left"),
        ("face to", "plate_0", None),
        ("hovers over", "plate_0", None),
        ("on", "The Plate-0", "mug_0 on plate_0"),
    ],
)
def test_the_words_of_a_relation_are_read(relation: str, target: str, found: str | None) -> None:
    constraint = RelationText("mug_0", relation, target).constraint
    assert (None if constraint is None else str(constraint)) == found


THINGS = tuple(
    LayoutObject(name, name, size, (0.0, 0.0, 0.0), 0)
    for name, size in {
        "mug_0": (11.0, 8.0, 9.5),
        "plate_0": (26.0, 26.0, 2.0),
        "tray_0": (40.0, 30.0, 4.0),
        "pen_0": (1.0, 15.0, 1.0),
        "cup_0": (8.0, 8.0, 10.0),
    }.items()
)


def checked(*relations: str) -> tuple[list[str], list[str]]:
    stated = []
    for text in relations:
        subject, _, rest = text.partition(" ")
        relation, _, target = rest.rpartition(" ")
        stated.append(RelationText(subject, relation, target))
    found = check_relations(stated, THINGS)
    return [str(c) for c in found.constraints], [f.code for f in found.faults if f.code != "unrelated"]


@pytest.mark.parametrize(
    ("second", "code"),
    [
        ("spoon_0 on plate_0", "object_unknown"),
        ("mug_0 on saucer_0", "object_unknown"),
        ("mug_0 orbits plate_0", "relation_unknown"),
        ("mug_0 left of mug_0", "relation_circle"),
        ("plate_0 on mug_0", "relation_circle"),
        ("mug_0 in tray_0", "relation_conflict"),
        ("mug_0 left of plate_0", "relation_conflict"),
        ("tray_0 in mug_0", "does_not_fit"),
        ("tray_0 left of pen_0", "relation_circle"),
        ("tray_0 behind plate_0", "relation_conflict"),
        ("cup_0 is at front_left", "relation_conflict"),
        ("cup_0 facing mug_0", "relation_conflict"),
    ],
)
def test_of_relations_that_exclude_each_other_the_first_stays(second: str, code: str) -> None:
    first = (
        "mug_0 on plate_0",
        "pen_0 left of cup_0",
        "cup_0 left of tray_0",
        "plate_0 in front of tray_0",
        "cup_0 is at back_right",
        "cup_0 face to left",
    )
    assert checked(*first) == (list(first), [])
    assert checked(*first, second) == (list(first), [code])


def test_what_is_said_of_the_table_or_twice_is_no_fault() -> None:
    assert checked("mug_0 on table", "pen_0 near cup_0", "pen_0 near cup_0") == (["pen_0 near cup_0"], [])
    assert checked("Tray_0 on Table") == ([], [])
    found = check_relations([RelationText("mug_0", "on", "the table")], THINGS)
    assert (found.num_related, "mug_0" in found.faults[0].message) == (1, False)
    assert checked("spoon_0 on table") == ([], ["object_unknown"])


def test_objects_that_no_relation_names_are_told() -> None:
    found = check_relations([RelationText("mug_0", "on", "plate_0")], THINGS)
    (fault,) = found.faults
    assert (fault.code, fault.message) == ("unrelated", "no relation says where tray_0, pen_0, cup_0 are")


def test_numbers_at_the_end_of_a_category_are_dropped_in_linear_time() -> None:
    long = "a" + "_1" * 60_000  # by a backtracking regular expression, minutes
    names = [("mug_1", "mug_0"), ("mp3_2_3", "mp3_0"), (long, "a_0"), (f"{long}_x", f"{long}_x_0")]
    for category, instance in names:
        (found,) = read_objects({"objects": [entry(category=category)]}, DESK)
        assert found.instance == instance


def test_a_long_chain_of_carriers_with_a_circle_ends() -> None:
    boxes = [LayoutObject(f"box_{k}", "a box", (10.0, 10.0, 5.0), (0.0, 0.0, 0.0), 0) for k in range(60)]
    stated = [RelationText(f"box_{k}", "on", f"box_{(k + 1) % 60}") for k in range(60)]
    found = check_relations(stated, boxes)
    assert len(found.constraints) == 59
    assert [f.code for f in found.faults] == ["relation_circle"]


def test_objects_without_places_stand_at_the_heights_of_their_carriers() -> None:
    constraints = Constraint("mug_0", R.ON, "plate_0"), Constraint("plate_0", R.IN, "tray_0")
    mug, plate, tray, *_ = stacked([o.to_scene_object() for o in (THINGS[0], THINGS[1], THINGS[2])], constraints)
    assert (tray.support, plate.support, mug.support) == (TABLE, "tray_0", "plate_0")
    assert tray.bottom == pytest.approx(0.0)
    assert plate.bottom == pytest.approx(0.004)
    assert mug.bottom == pytest.approx(plate.top)


def test_a_layout_gives_its_relations_after_those_of_the_instruction() -> None:
    table = Tabletop("office_table", (1.2, 0.6))
    layout = (
        LayoutObject("plate_0", "a plate", (26.0, 26.0, 2.0), (30.0, 30.0, 1.0), 0),
        LayoutObject("mug_0", "a red mug", (9.0, 8.0, 10.0), (30.0, 30.0, 7.0), 90),
        LayoutObject("mug_1", "a blue mug", (9.0, 8.0, 10.0), (70.0, 30.0, 5.0), 0),
        LayoutObject("serving_tray_0", "a tray", (60.0, 50.0, 2.0), (70.0, 30.0, 11.0), 0),
    )
    found = relations_of_layout(layout, "The red mug is on the plate. Lift it.", table, interpreter())
    stated = [str(c) for c in found.constraints]
    assert stated[0] == "mug_0 on plate_0"
    assert "mug_0 face to right" in stated
    assert not any(c.startswith("serving_tray_0 on") for c in stated)  # far too large for a mug
    assert found.faults == ()


@pytest.mark.parametrize(("holds", "relations"), [(None, ["mug_0 in plate_0"]), (True, ["mug_0 in plate_0"]), (False, [])])
def test_a_layout_puts_nothing_into_what_holds_nothing(holds: bool | None, relations: list[str]) -> None:
    sunk = (
        LayoutObject("plate_0", "a plate", (26.0, 26.0, 6.0), (30.0, 30.0, 3.0), 0),
        LayoutObject("mug_0", "a mug", (9.0, 8.0, 10.0), (30.0, 30.0, 7.5), 0),
    )
    found = relations_of_layout(sunk, "Lift it.", Tabletop("office_table", (1.2, 0.6)), None, lambda _: holds)
    assert [str(c) for c in found.constraints] == relations


def test_both_forms_are_strict_schemas() -> None:
    for form in (OBJECTS_FORM, RELATIONS_FORM):
        (key,) = form.schema()["properties"]
        item = form.schema()["properties"][key]["items"]
        assert item["additionalProperties"] is False
        assert set(item["required"]) == set(item["properties"])
        assert json.loads(form.text) == form.schema()
