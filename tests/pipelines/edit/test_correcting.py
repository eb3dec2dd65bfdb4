"""The correction of edited scenes: what is asked for holds, by another form of the object if need be, and the others stay."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import pytest

from models.physics_corrector.certify.correction import Correction
from models.semantic_reasoner.editing import EditResult, apply_edit
from models.semantic_reasoner.text.reply_json import LayoutObject, LayoutReply
from pipelines.correct.scene_shard import corrector_of
from pipelines.edit.assets import AssetFinder
from pipelines.edit.correcting import EditCorrector, missed_relations
from pipelines.edit.tilts import fit_tilts
from pipelines.execution.item_progress import ItemProgress
from pipelines.sources.assets import AssetLibraries
from pipelines.sources.scenes import FolderSource
from stable_data.metrics.audit import PosedScene, audit_posed_scene
from stable_data.scene import TABLE, UPRIGHT, Relation, RelationKind, Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import cell_of
from tests.pipelines.edit.edit_runs import SMALL


@dataclass(frozen=True)
class Things:
    """The objects of the embedded dataset, to lay tables with."""

    source: FolderSource

    def scene(self, scene_id: str) -> Scene:
        return self.source.take(scene_id, SMALL.scene_settings(), ItemProgress("read")).scene

    @cached_property
    def by_category(self) -> dict[str, SceneObject]:
        found: dict[str, SceneObject] = {}
        for scene_id in self.source.scene_ids:
            for o in self.scene(scene_id).objects:
                found.setdefault(o.category, o)
        return found

    def thing(self, category: str, x: float, y: float, bottom: float = 0.0, yaw: float = 0.0) -> SceneObject:
        o = self.by_category[category]
        return replace(o, instance=f"{category}_0", position=(x, y, bottom + o.size[2] / 2), yaw=yaw, support=TABLE)

    def correct(self, edited: EditResult, before: Scene | None = None) -> Correction:
        store = self.source.store
        scene, _, _ = store.resolved(edited.scene)
        if before is not None:
            scene = fit_tilts(scene, before, edited, store)
        audit = audit_posed_scene(PosedScene(scene, store.shapes(scene)[0]))
        done = EditCorrector(SMALL, corrector_of(SMALL, store), store).correct(scene, audit, edited, edited.untouched)
        if done.certified is not None:
            assert done.card_after is not None
            assert done.card_after.clean
        return done


@pytest.fixture(scope="module")
def things(dataset: Path) -> Things:
    return Things(FolderSource(dataset))


def table(*objects: SceneObject, size: tuple[float, float] = (0.9, 0.6), wanted: tuple[Relation, ...] = ()) -> Scene:
    return Scene("edited", Tabletop("office_table", size), objects, relations=wanted)


def test_a_thing_is_turned_where_it_fits_in_no_other_way(things: Things) -> None:
    wanted = (Relation("comb_0", RelationKind.IS_AT, "back_middle"),)
    scene = table(things.thing("comb", 0.06, 0.45), size=(0.12, 0.6), wanted=wanted)
    done = things.correct(EditResult(scene, changed=("comb_0",), wanted=wanted))
    assert done.certified is not None
    assert not missed_relations(wanted, done)
    assert abs(math.sin(done.certified["comb_0"].yaw)) == pytest.approx(1.0)


def test_a_new_thing_is_smaller_where_it_fits_in_no_other_way(things: Things) -> None:
    wanted = (Relation("book_0", RelationKind.IN, "basket_0"),)
    scene = table(things.thing("basket", 0.4, 0.3), things.thing("book", 0.4, 0.3, 0.02), wanted=wanted)
    done = things.correct(EditResult(scene, added=("book_0",), wanted=wanted))
    assert done.certified is not None
    assert not missed_relations(wanted, done)
    assert done.certified["book_0"].size[0] < 0.9 * scene["book_0"].size[0]
    assert done.certified["basket_0"].position == scene["basket_0"].position
    moved = things.correct(EditResult(scene, changed=("book_0",), wanted=wanted))  # one that is there already keeps its size
    assert moved.certified is not None
    assert moved.certified["book_0"].size == scene["book_0"].size
    assert missed_relations(wanted, moved) == [*wanted]


def test_a_thing_stands_on_end_where_it_fits_in_no_other_way(things: Things) -> None:
    wanted = (Relation("soap_0", RelationKind.IN, "brush_holder_0"),)
    scene = table(things.thing("brush_holder", 0.4, 0.3), things.thing("soap", 0.4, 0.3, 0.02), wanted=wanted)
    done = things.correct(EditResult(scene, changed=("soap_0",), wanted=wanted))
    assert done.certified is not None
    assert not missed_relations(wanted, done)
    assert done.certified["soap_0"].size[2] == pytest.approx(max(scene["soap_0"].size))


def test_others_make_room_for_what_is_asked_for_and_only_then(things: Things) -> None:
    jar, book = things.thing("cream_jar", 0.45, 0.3), things.thing("book", 0.45, 0.3)
    for cell, stays in (("middle_middle", False), ("front_left", True)):
        wanted = (Relation("cream_jar_0", RelationKind.IS_AT, cell),)
        scene = table(jar, book, size=(0.6, 0.5), wanted=wanted)
        scene = replace(scene, objects=(jar, replace(book, position=(0.3, 0.25, book.position[2]))))
        done = things.correct(EditResult(scene, added=("cream_jar_0",), wanted=wanted))
        assert done.certified is not None
        assert cell_of(done.certified["cream_jar_0"].position, (0.6, 0.5)) == cell
        assert (done.certified["book_0"].position == scene["book_0"].position) == stays


def test_what_floated_before_is_lowered_where_it_is(things: Things) -> None:
    scene = things.scene("coffee_table_00001")
    control = scene["4_remote_control_0"]
    x, y, z = control.position
    raised = replace(control, position=(x, y, z + 0.012))
    objects = tuple(raised if o is control else o for o in scene.objects if o.instance != "8_tea_light_0")
    edited = EditResult(replace(scene, objects=objects, relations=()), removed=("8_tea_light_0",))
    done = things.correct(edited)
    assert done.certified is not None
    for o in done.certified.objects:
        was = edited.scene[o.instance]
        assert o.position[:2] == was.position[:2]
        assert (o.position == was.position) == (o.instance != control.instance)


def test_a_missed_relation_is_told_from_a_layout_without_room(things: Things) -> None:
    wanted = (Relation("cream_jar_0", RelationKind.IS_AT, "middle_middle"),)
    scene = table(things.thing("cream_jar", 0.3, 0.25), size=(0.6, 0.5), wanted=wanted)
    zoned = replace(scene, table=replace(scene.table, restricted_zone=(0.15, 0.45, 0.12, 0.38)))
    done = things.correct(EditResult(zoned, added=("cream_jar_0",), wanted=wanted))
    assert done.certified is not None
    assert missed_relations(wanted, done) == [*wanted]


def test_a_brush_lies_on_the_table_and_leans_in_a_cup(things: Things) -> None:
    before = things.scene("dressing_table_00003")
    brush = before["7_makeup_brush_0"]
    assert brush.support == "6_brush_holder_0"
    out = replace(brush, position=(0.6, 0.1, brush.size[2] / 2), support=TABLE)
    scene = replace(before, objects=tuple(out if o is brush else o for o in before.objects), relations=())
    done = things.correct(EditResult(scene, changed=(brush.instance,)), before)
    assert done.certified is not None
    lying = done.certified[brush.instance]
    assert lying.size[2] < 0.05 < 0.15 < max(lying.size)
    wanted = (Relation(brush.instance, RelationKind.IN, "6_brush_holder_0"),)
    back = replace(lying, position=(*before["6_brush_holder_0"].position[:2], 0.02), support="6_brush_holder_0")
    again = tuple(back if o.instance == brush.instance else o for o in done.certified.objects)
    scene = replace(before, objects=again, relations=wanted)
    edited = EditResult(scene, changed=(brush.instance,), wanted=wanted)
    returned = things.correct(edited, done.certified)
    assert returned.certified is not None
    assert not missed_relations(wanted, returned)
    assert returned.certified[brush.instance].size[2] > 0.14


def test_an_asset_that_is_modelled_along_the_other_side_is_turned(things: Things, dataset: Path) -> None:
    scene = things.scene("coffee_table_00001")
    finder = AssetFinder(things.source, AssetLibraries(scenes=str(dataset)))
    long_along_x = LayoutObject("table_knife_0", "a table knife", (20.0, 2.0, 0.7), (40.0, 40.0, 0.4), 0)
    edited = apply_edit(scene, LayoutReply((long_along_x,)))
    (name,) = edited.added
    knife = finder.assign(edited, "edit", 0).scene[name]
    assert max(knife.size) == pytest.approx(0.2, rel=0.1)
    along_y = knife.size[1] > knife.size[0]
    assert abs(math.sin(knife.yaw)) == pytest.approx(1.0 if along_y else 0.0, abs=1e-9)
    assert knife.tilt_quat_xyzw == pytest.approx(UPRIGHT, abs=0.05)
