"""The requirements that follow from a reading."""

from dataclasses import replace

from models.instruction_reader.reading import InstructionReading, MentionedObject, MentionedRelation
from models.instruction_reader.reference import reference_of_reading
from stable_data.metrics.alignment import align
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop

MUG = MentionedObject("red mug", ("mug",))
TRAY = MentionedObject("tray", ("serving_tray", "decor_tray"))
VIOLIN = MentionedObject("violin", ())


def reading(*objects: MentionedObject, start: tuple[tuple[int, str, int], ...] = ()) -> InstructionReading:
    return InstructionReading(objects, tuple(MentionedRelation(*r) for r in start))


def test_known_objects_and_their_relations_are_required() -> None:
    found = reference_of_reading(reading(MUG, VIOLIN, TRAY, start=((0, "on", 2), (1, "left", 0), (0, "near", 2))), "task")
    assert found is not None
    assert [(r.instance, r.categories) for r in found.required] == [("0", ("mug",)), ("2", ("serving_tray", "decor_tray"))]
    assert found.entailed == (Relation("0", RelationKind.ON, "2"),)


def test_no_known_object_is_no_requirement() -> None:
    assert reference_of_reading(reading(VIOLIN), "task") is None
    assert reference_of_reading(reading(replace(MUG, change="add")), "task") is None


def test_a_region_and_nameless_contents_can_be_judged_in_a_scene() -> None:
    found = reference_of_reading(reading(replace(MUG, region="back_left"), replace(TRAY, is_filled=True)), "task")
    assert found is not None
    mug = SceneObject("mug_0", "mug", (0.1, 0.5, 0.05), 0.0, (0.08, 0.08, 0.1))
    tray = SceneObject("serving_tray_0", "serving_tray", (0.6, 0.3, 0.01), 0.0, (0.3, 0.2, 0.02))
    pen = SceneObject("pen_0", "pen", (0.6, 0.3, 0.025), 0.0, (0.14, 0.01, 0.01))
    table = Tabletop("coffee_table", (1.2, 0.6))
    assert align(Scene("s", table, (mug, tray, pen)), found).aws == 1.0
    empty = align(Scene("s", table, (mug, tray)), found)
    assert (len(empty.missing), len(empty.broken or ())) == (1, 1)


def test_contents_with_a_name_are_enough() -> None:
    found = reference_of_reading(reading(MUG, replace(TRAY, is_filled=True), start=((0, "on", 1),)), "task")
    assert found is not None
    assert len(found.required) == 2


def test_that_one_is_between_two_others_is_one_relation() -> None:
    between = ((0, "between", 2), (0, "between", 1), (1, "between", 2))
    found = reference_of_reading(reading(MUG, TRAY, TRAY, start=between), "task")
    assert found is not None
    assert found.entailed == (Relation("0", RelationKind.BETWEEN, "1, 2"),)
