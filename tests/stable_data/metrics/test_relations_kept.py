"""Relations before and after, on plain things."""

from dataclasses import replace

import numpy as np

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.metrics.relations_kept import RelationsKept, relations_kept
from stable_data.scene import Relation, RelationKind, Scene, SceneObject, Tabletop


def block(name: str, x: float, y: float, bottom: float) -> SceneObject:
    return SceneObject(name, "block", (x, y, bottom + 0.05), 0.0, (0.1, 0.1, 0.1))


def cube() -> Shape:
    stand_in = Shape.box((0.1, 0.1, 0.1))
    return Shape(np.array(stand_in.vertices), stand_in.faces)


SCENE = Scene(
    "s", Tabletop("table", (1.0, 1.0)), (block("a", 0.3, 0.3, 0.0), block("b", 0.3, 0.3, 0.1), block("c", 0.6, 0.3, 0.0))
)


def kept(before: Scene, after: Scene, shapes: list[Shape]) -> RelationsKept:
    """The counts, which are the same where the audits of both are known."""
    there = {o.instance for o in after.objects}
    later = [shape for o, shape in zip(before.objects, shapes, strict=True) if o.instance in there]
    found = relations_kept(before, after, shapes)
    audits = audit_scene(before, shapes), audit_scene(after, later)
    assert relations_kept(before, after, shapes, audits=audits) == found
    for known in ([(before, audits[0])], [(after, audits[1])], list(zip((before, after), audits, strict=True))):
        assert relations_kept(before, after, shapes, known=known) == found
    return found


def test_what_has_not_changed_is_kept() -> None:
    found = kept(SCENE, SCENE, [cube()] * 3)
    assert (found.on_in_held, found.on_in_kept) == (1, 1)
    assert found.directional_held == found.directional_kept > 0
    assert (found.asked_broken, found.asked_restored) == (0, 0)


def test_what_was_taken_down_and_turned_round_is_lost() -> None:
    after = replace(SCENE, objects=(SCENE["a"], block("b", 0.3, 0.8, 0.0), block("c", 0.1, 0.3, 0.0)))
    found = kept(SCENE, after, [cube()] * 3)
    assert found.on_in_share == 0
    assert found.directional_share == 0


def test_what_was_asked_for_is_restored() -> None:
    asked = replace(SCENE, relations=(Relation("c", RelationKind.ON, "a"),), objects=(SCENE["a"], SCENE["c"]))
    after = replace(asked, objects=(SCENE["a"], block("c", 0.3, 0.3, 0.1)))
    found = kept(asked, after, [cube()] * 2)
    assert (found.asked_broken, found.asked_restored) == (1, 1)
    assert kept(asked, asked, [cube()] * 2).asked_restored == 0


def test_dropped_objects_are_left_out() -> None:
    found = kept(SCENE, replace(SCENE, objects=(SCENE["a"], SCENE["c"])), [cube()] * 3)
    assert found.on_in_held == 0
    assert found.on_in_share is None
    assert found.directional_share == 1


def test_what_is_on_a_thing_through_another_one_is_kept() -> None:
    piled = replace(SCENE, objects=(SCENE["a"], SCENE["b"], block("c", 0.3, 0.3, 0.2)))
    swapped = replace(SCENE, objects=(SCENE["a"], block("b", 0.3, 0.3, 0.2), block("c", 0.3, 0.3, 0.1)))
    found = kept(piled, swapped, [cube()] * 3)
    assert (found.on_in_held, found.on_in_kept) == (2, 1)  # b is on a still, through c; c is on b no more


def test_what_is_stuck_in_a_thing_is_not_on_it_and_is_restored_where_asked_for() -> None:
    stuck = replace(SCENE, objects=(SCENE["a"], block("b", 0.31, 0.3, 0.07), SCENE["c"]))
    found = kept(stuck, SCENE, [cube()] * 3)
    assert found.on_in_held == 0
    asked = replace(stuck, relations=(Relation("b", RelationKind.ON, "a"),))
    found = kept(asked, SCENE, [cube()] * 3)
    assert (found.on_in_held, found.asked_broken, found.asked_restored) == (0, 1, 1)
