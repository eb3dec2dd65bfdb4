"""Variants of a scene: what a drawn layout keeps, what the comparison with the source finds, and which tasks are different."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from models.dual_system.algorithm1 import LoopSettings
from models.dual_system.new_layout import draw_layout
from models.dual_system.variant_comparison import compare_variant, kept_beside_clutter, without_clutter
from models.dual_system.variant_task import Axis, VariantTask
from models.dual_system.variants import NO_VARIANT, VariantWorld, vary
from stable_data.metrics.alignment import broken_relations
from stable_data.scene import TABLE, Relation, RelationKind, Scene, SceneObject, Tabletop, TaskInfo
from stable_data.scene_graph.relations import contacts_of, relations_of, scene_graph, yawed_rectangle

DESK = Tabletop("office_table", (1.2, 0.8), (0.9, 1.2, 0.5, 0.8))


def thing(name: str, x: float, y: float, z: float = 0.05, support: str = TABLE, size: float = 0.1) -> SceneObject:
    category, text = name.rpartition("_")[0], f"a {name.split('_')[0]}"
    position = (x, y, z)
    return SceneObject(
        name, category, position, 0.0, (size, size, 0.1), f"asset_{name}", (1.0, 1.0, 1.0), description=text, support=support
    )


STATED = (
    Relation("cup_0", RelationKind.LEFT_OF, "book_0"),
    Relation("book_0", RelationKind.IS_AT, "middle_middle"),
    Relation("coin_0", RelationKind.ON, "book_0"),
)
TASK = TaskInfo("", "Put the coin on the left-hand cup.", task_objects=("cup_0", "book_0", "coin_0"), relations=STATED)


def desk(task: TaskInfo | None = TASK) -> Scene:
    objects = (
        thing("cup_0", 0.2, 0.4),
        thing("book_0", 0.6, 0.4, size=0.2),
        thing("coin_0", 0.62, 0.43, 0.15, "book_0", 0.03),
        thing("cup_1", 0.9, 0.2),
        thing("plant_0", 0.2, 0.7),
    )
    scene = Scene("desk", DESK, objects, task)
    return replace(scene, relations=relations_of(scene_graph(scene, contacts_of(scene))))


@settings(max_examples=30)
@given(st.integers(0, 10_000))
def test_a_drawn_layout_keeps_the_stated_relations_and_what_things_are_on(seed: int) -> None:
    scene = desk()
    drawn = draw_layout(scene, np.random.default_rng(seed))
    assert drawn is not None
    assert broken_relations(drawn, STATED, contacts=contacts_of(drawn)) == ()
    outlines = {o.instance: shapely.Polygon(yawed_rectangle(o)) for o in drawn.objects}
    assert all(outlines[o.instance].within(shapely.box(0, 0, *DESK.size_xy).buffer(1e-9)) for o in drawn.objects)
    standing = [outlines[o.instance] for o in drawn.objects if o.support == TABLE]
    zone = shapely.box(0.9, 0.5, 1.2, 0.8)
    assert all(a.distance(b) > 0 for k, a in enumerate(standing) for b in [*standing[:k], zone])
    book, coin = drawn["book_0"], drawn["coin_0"]
    assert math.dist(book.position, coin.position) == pytest.approx(math.dist((0.6, 0.4, 0.05), (0.62, 0.43, 0.15)))
    assert coin.yaw == pytest.approx(book.yaw)
    found = compare_variant(scene, drawn, Axis.LAYOUT)
    assert found.is_varied
    assert not any("does not hold" in text for text in found.lost)


def test_a_layout_that_cannot_be_accepted_or_that_has_nothing_to_move_is_none() -> None:
    assert draw_layout(desk(), np.random.default_rng(0), lambda _: False) is None
    held = replace(desk(), fixed=frozenset(o.instance for o in desk().objects))
    assert draw_layout(held, np.random.default_rng(0)) is None


def test_a_tall_thing_comes_no_nearer_than_it_may() -> None:
    tall = replace(thing("lamp_0", 0.6, 0.6, 0.2), size=(0.1, 0.1, 0.4))
    scene = Scene("one", Tabletop("office_table", (1.2, 0.8)), (tall,))
    drawn = [draw_layout(scene, np.random.default_rng(seed)) for seed in range(50)]
    assert all(one is not None and one["lamp_0"].position[1] >= 0.55 - 1e-9 for one in drawn)


def changed(scene: Scene, name: str, **values: object) -> Scene:
    return replace(scene, objects=tuple(replace(o, **values) if o.instance == name else o for o in scene.objects))  # type: ignore[arg-type]


@pytest.mark.parametrize("axis", Axis)
def test_a_scene_is_no_variant_of_itself(axis: Axis) -> None:
    found = compare_variant(desk(), desk(), axis)
    assert not found.is_varied
    assert found.lost == ()


@pytest.mark.parametrize(
    ("axis", "name", "values", "lost"),
    [
        (Axis.LAYOUT, "plant_0", {"asset_id": "other"}, "plant_0 has another asset"),
        (Axis.LAYOUT, "cup_0", {"position": (0.8, 0.4, 0.05)}, "cup_0 left of book_0 does not hold"),
        (Axis.LAYOUT, "book_0", {"position": (0.3, 0.75, 0.05)}, "book_0 is at middle_middle does not hold"),
        (Axis.LAYOUT, "cup_1", {"position": (0.1, 0.1, 0.05)}, "'the left-hand cup' does not name cup_0"),
        (Axis.ASSETS, "plant_0", {"category": "lamp"}, "plant_0 is a lamp, not a plant"),
        (Axis.ASSETS, "coin_0", {"support": TABLE, "position": (0.4, 0.1, 0.05)}, "coin_0 on book_0 does not hold"),
        (Axis.TASK, "plant_0", {"position": (0.3, 0.7, 0.05)}, "plant_0 is not where it was"),
        (Axis.CLUTTER, "cup_0", {"position": (0.205, 0.4, 0.05)}, "cup_0 is not as it was"),
        (Axis.CLUTTER, "coin_0", {"tilt_quat_xyzw": (1.0, 0.0, 0.0, 0.0)}, "coin_0 is not as it was"),
    ],
)
def test_what_is_not_kept_is_told(axis: Axis, name: str, values: dict[str, object], lost: str) -> None:
    found = compare_variant(desk(), changed(desk(), name, **values), axis)
    assert any(text.startswith(lost) for text in found.lost), found.lost
    assert name in found.concerned or "cup_0" in found.concerned


def test_what_is_missing_or_new_is_told() -> None:
    fewer = replace(desk(), objects=desk().objects[:-1])
    assert compare_variant(desk(), fewer, Axis.ASSETS).lost == ("plant_0 is missing",)
    assert compare_variant(fewer, desk(), Axis.LAYOUT).lost == ("plant_0 is new",)
    assert compare_variant(desk(), replace(desk(), task=None), Axis.CLUTTER).lost == ("the task info",)
    assert compare_variant(desk(), fewer, Axis.CLUTTER).is_varied


def test_clutter_is_what_neither_the_task_nor_its_words_need() -> None:
    assert set(kept_beside_clutter(desk())) == {"cup_0", "book_0", "coin_0", "cup_1"}  # the other cup makes the left-hand one
    begun = without_clutter(desk())
    assert begun.nouns >= {"coin", "cup"}
    assert "plant_0" not in {o.instance for o in begun.scene.objects}


WORLD = VariantWorld(None, lambda _: (), lambda _: {})


def another(number: int, source: Scene) -> Scene | str:
    """The variant of the task of a scene, or the code of its failure."""
    task = VariantTask(f"desk~task_{number}", "", DESK, source=source, axis=Axis.TASK, number=number)
    with pytest.raises(StopIteration) as end:
        next(vary(task, 0, LoopSettings(), WORLD))
    made = end.value.value
    if made.failure is not None:
        return str(made.failure.code)
    assert made.task.instruction == made.scene.task.task
    assert made.task.reference is not None
    scene: Scene = made.scene
    return scene


def test_the_variants_of_a_task_differ_from_it_and_from_each_other() -> None:
    tasks = [TASK]
    for number in (1, 2, 3):
        made = another(number, desk())
        assert isinstance(made, Scene)
        assert made.task is not None
        assert made.poses().tolist() == desk().poses().tolist()
        assert set(made.task.task_objects) != set(TASK.task_objects)  # the goal of TASK is not known
        tasks.append(made.task)
    assert len({task.task for task in tasks}) == 4
    assert isinstance(another(1, desk(None)), Scene)  # a scene without a task gets one


def test_where_no_other_task_fits_there_is_no_variant() -> None:
    assert another(10_000, replace(desk(), objects=(thing("cup_0", 0.2, 0.4),), task=None, relations=())) == NO_VARIANT
