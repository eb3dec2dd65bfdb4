"""Groups, tables and scenes: clear of each other, as full as wanted, clean, at rest, and the same every time."""

from collections import Counter

import numpy as np
import pytest
import shapely

from stable_data.embedded_world import scenes
from stable_data.embedded_world.families.catalogue import BY_CATEGORY, asset
from stable_data.embedded_world.groups import bath, desk, dining, kitchen, lounge
from stable_data.embedded_world.groups.arrangement import (
    GroupItem,
    GroupSampler,
    fill_container,
    heap_in_bowl,
    lean_in_cup,
    row,
    stack,
)
from stable_data.embedded_world.placing import TableOccupancy, compose, lower_group
from stable_data.embedded_world.plans import TABLES, UNSEEN_TABLES, Slot
from stable_data.embedded_world.scenes import EmbeddedScene, make_scene, plan_of, scene_id_of, table_type_of
from stable_data.embedded_world.settling import audit, bodies_of, instance_names, unclean_objects, unsteady_objects
from stable_data.errors import ConfigError, SceneError
from stable_data.scene import Tabletop
from stable_data.simulation.settling import settle

pytestmark = pytest.mark.sim

GROUPS = [
    (module.__name__.rsplit(".", 1)[1], name)
    for module in (bath, desk, dining, kitchen, lounge)
    for name, found in vars(module).items()
    if callable(found) and not name.startswith("_") and getattr(found, "__module__", "") == module.__name__
]
MODULES = {"bath": bath, "desk": desk, "dining": dining, "kitchen": kitchen, "lounge": lounge}


@pytest.fixture(scope="module")
def made() -> list[EmbeddedScene]:
    return [make_scene(number, seed=5) for number in range(12)]


@pytest.fixture
def kit(rng: np.random.Generator) -> GroupSampler:
    return GroupSampler(rng)


@pytest.mark.parametrize(("room", "name"), GROUPS)
def test_group_is_of_known_things_each_carrier_before_what_it_carries(room: str, name: str, kit: GroupSampler) -> None:
    for _ in range(6):
        group = getattr(MODULES[room], name)(kit)
        assert group
        assert all(item.key.split("/")[0] in BY_CATEGORY for item in group)
        assert all(np.isfinite([item.x, item.y, item.yaw]).all() for item in group)


def test_row_is_as_wide_as_its_things_and_gaps(kit: GroupSampler) -> None:
    items = [kit.item(key) for key in ("mug/0", "mug/1", "mug/2")]
    placed = row(items, 0.03)
    bounds = shapely.union_all([item.outline() for item in placed]).bounds
    assert bounds[2] - bounds[0] == pytest.approx(sum(item.size[0] for item in items) + 0.06)
    assert placed[0].outline().distance(placed[1].outline()) == pytest.approx(0.03)


def test_stack_stays_over_its_first_thing(kit: GroupSampler) -> None:
    placed = stack([GroupItem("book/0"), GroupItem("book/1")], kit, shift=0.005)
    assert abs(placed[1].x) <= 0.005


def test_contents_lie_within_their_container_and_apart(kit: GroupSampler) -> None:
    crate = GroupItem("crate/0", 0.2, 0.1, 0.4)
    group = fill_container(crate, [GroupItem("can/0", yaw=k) for k in range(20)], kit)
    assert 2 <= len(group) < 21
    outlines = [item.outline() for item in group[1:]]
    assert all(crate.outline().contains(o) for o in outlines)
    assert all(not a.intersects(b) for k, a in enumerate(outlines) for b in outlines[k + 1 :])


def test_heap_and_leaning_things_stay_in_what_holds_them(kit: GroupSampler) -> None:
    bowl = GroupItem("bowl/0")
    for item in heap_in_bowl(bowl, [GroupItem("egg/0")] * 3, kit)[1:]:
        assert bowl.outline().contains(shapely.Point(item.x, item.y))
    holder = GroupItem("pen_holder/0")
    hollow = asset("pen_holder/0").hollow
    assert hollow is not None
    group = lean_in_cup(holder, ["pen/0", "pen/1"], kit)
    assert len(group) == 3
    assert all(item.tilt_quat_xyzw != GroupItem("pen/0").tilt_quat_xyzw for item in group[1:])


def test_household_is_the_same_for_a_scene(kit: GroupSampler) -> None:
    assert len({kit.own("plate") for _ in range(20)}) == 1
    assert len({kit.key("plate") for _ in range(60)}) > 1
    assert len({kit.decided("cloth", 0.5) for _ in range(20)}) == 1


def test_group_that_does_not_fit_is_left_out(kit: GroupSampler) -> None:
    ground = TableOccupancy(Tabletop("office_table", (0.2, 0.2)))
    assert ground.place_group([GroupItem("serving_tray/0")], Slot(dining.tea_tray), kit, 30) == []


def test_lowered_things_are_just_clear() -> None:
    low, high = lower_group([GroupItem("book/0"), GroupItem("eraser/0")])
    gap = high.z - high.shape.size[2] / 2 - (low.z + low.shape.size[2] / 2)
    assert 0 < gap < 2e-4


@pytest.mark.parametrize("table_type", [*TABLES, *UNSEEN_TABLES])
def test_composed_groups_are_apart_on_the_table_and_out_of_the_sink(table_type: str, kit: GroupSampler) -> None:
    plan = plan_of(table_type)
    zone = (0.3, 0.7, 0.1, 0.4) if plan.has_sink else None
    table = Tabletop(table_type, (plan.width[1], plan.depth[1]), zone)
    placed = compose(plan, table, kit, 14, 30)
    assert 4 <= len(placed) <= 30
    top = shapely.box(0, 0, *table.size_xy)
    groups: dict[int, list[shapely.Polygon]] = {}
    for thing in placed:
        assert top.contains(thing.item.outline())
        groups.setdefault(thing.group, []).append(thing.item.outline())
    outlines = [shapely.union_all(found) for found in groups.values()]
    assert all(a.distance(b) > 0.005 for k, a in enumerate(outlines) for b in outlines[k + 1 :])
    if zone is not None:
        assert not any(o.intersects(shapely.box(zone[0], zone[2], zone[1], zone[3])) for o in outlines)


def test_instance_names_count_all_and_each_kind() -> None:
    assert instance_names(["mug", "pen", "mug"]) == ["1_mug_0", "2_pen_0", "3_mug_1"]


def test_tables_are_taken_in_turn_and_one_in_25_is_unseen() -> None:
    kinds = Counter(table_type_of(number) for number in range(300))
    assert set(kinds) == {*TABLES, *UNSEEN_TABLES}
    assert sum(kinds[t] for t in UNSEEN_TABLES) == 12
    assert {kinds[t] for t in TABLES} == {48}
    assert scene_id_of(7) == "coffee_table_00007"
    assert scene_id_of(7, ("nightstand",)) == "nightstand_00007"


def test_made_scenes_are_clean_at_rest_and_full(made: list[EmbeddedScene]) -> None:
    for one in made:
        card = audit(one.scene, one.placed).card()
        assert card.clean
        assert not unsteady_objects(one.scene, one.placed)
        assert scenes.FEWEST <= len(one.placed) <= scenes.MOST
    assert 9 < np.mean([len(one.placed) for one in made]) < 20


def test_made_scenes_are_stable_for_the_whole_verdict(made: list[EmbeddedScene]) -> None:
    for one in made[:4]:
        assert settle(bodies_of(one.scene, one.placed), one.scene.table).stable


def test_scene_is_the_same_for_the_same_seed_and_another_for_another(made: list[EmbeddedScene]) -> None:
    assert make_scene(3, seed=5).scene == made[3].scene
    assert make_scene(3, seed=6).scene != made[3].scene


def test_scene_has_a_task_of_its_own_objects_and_a_record(made: list[EmbeddedScene]) -> None:
    for one in made:
        task = one.scene.task
        assert task is not None
        assert set(task.task_objects) <= {o.instance for o in one.scene.objects}
        assert one.scene.source is not None
        record = one.scene.source[scenes.RECORD]
        assert record["keys"] == [thing.item.key for thing in one.placed]
        assert record["depth"] >= 1


def test_scene_that_never_passes_is_an_error_with_a_record(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "_ATTEMPTS", 2)
    monkeypatch.setattr(scenes, "unsteady_objects", lambda scene, placed: frozenset(range(len(placed))))
    with pytest.raises(SceneError, match=r"none of 2 compositions came to rest clean .*not at rest") as caught:
        make_scene(0)
    assert caught.value.code == "synth_failed"


def test_unclean_group_is_taken_away_and_the_rest_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    found = unclean_objects
    calls: list[int] = []

    def first_is_bad(judged):  # type: ignore[no-untyped-def]
        calls.append(len(judged.objects))
        return frozenset({0}) if len(calls) == 1 else found(judged)

    monkeypatch.setattr(scenes, "unclean_objects", first_is_bad)
    one = make_scene(1, seed=5)
    assert len(one.placed) < calls[0]
    assert one.scene.source is not None
    assert one.scene.source[scenes.RECORD]["rejected"]["not clean"] >= 1


def test_unknown_table_is_named() -> None:
    with pytest.raises(ConfigError, match="table is 'bar', expected one of"):
        make_scene(0, tables=("bar",))
