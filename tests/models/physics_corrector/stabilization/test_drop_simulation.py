"""What is let go on or in a thing comes to lie there, goes where that goes, and else is where it was."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.physics_corrector.certify import certify
from models.physics_corrector.certify.mesh_queries import MeshQueries
from models.physics_corrector.stabilization.container_insertion import interior_of, is_inside, is_long, place_leaning
from models.physics_corrector.stabilization.drop_simulation import DropResult, drop_into_container, drop_new_objects
from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import audit_scene
from stable_data.rotations import rotation_matrix, stand_on_end
from stable_data.scene import QuatXyzw, Relation, RelationKind, Scene, SceneObject
from stable_data.simulation.collision_bodies import bodies_of
from stable_data.simulation.settling import settle
from tests.models.physics_corrector.geometry.shapes import scene, store, thing
from tests.scenes import box, hollow

LYING: QuatXyzw = (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4))
CUP = thing("cup", (0.5, 0.4, 0.05, 0.3))
NONE = frozenset[str]()


def stick(number: int, x: float, *, tilt: QuatXyzw = LYING) -> SceneObject:
    """Long along the mesh's z, 15 cm."""
    return thing(f"cube_{number}", (x, 0.4, 0.2, 0.0), scale=(0.1, 0.1, 1.5), tilt=tilt)


def with_relations(built: Scene, kind: RelationKind, *pairs: tuple[str, str]) -> Scene:
    return replace(built, relations=tuple(Relation(a, kind, b) for a, b in pairs))


def let_go(built: Scene, fixed: frozenset[str] = NONE) -> DropResult:
    return drop_new_objects(store().resolved(built)[0], {r.subject for r in built.relations}, fixed, store())


def steepness(o: SceneObject) -> float:
    """Sine of the slope of the mesh's z axis."""
    return float(abs(rotation_matrix(o.tilt_quat_xyzw)[2, 2]))


# --- cups


def test_the_interior_of_a_cup() -> None:
    room = interior_of(CUP, store().shape(CUP)[0])
    assert room is not None
    assert room.middle == pytest.approx(CUP.position[:2], abs=1e-3)
    assert room.radius == pytest.approx(0.035, rel=0.05)
    assert [room.floor, room.rim] == pytest.approx([0.015, 0.1])


@pytest.mark.parametrize("name", ["cube", "plate", "ball", "cloth"])
def test_what_has_no_walls_has_no_hollow(name: str) -> None:
    o = thing(name, (0.5, 0.4, 0.1, 0.0))
    assert interior_of(o, store().shape(o)[0]) is None


def test_only_slender_things_longer_than_the_cup_is_deep_lean() -> None:
    room = interior_of(CUP, store().shape(CUP)[0])
    assert room is not None
    assert is_long(stick(0, 0.5), room, store())
    assert not is_long(thing("cube", (0.5, 0.4, 0.1, 0.0)), room, store())
    assert not is_long(thing("cube", (0.5, 0.4, 0.1, 0.0), scale=(0.1, 0.1, 0.8)), room, store())


def test_as_many_stand_side_by_side_as_have_room() -> None:
    room = interior_of(CUP, store().shape(CUP)[0])
    assert room is not None
    found = place_leaning([stick(k, 0.5) for k in range(30)], room, store())
    assert 5 < len(found) < 30
    assert [o.instance for o in found] == [f"cube_{k}" for k in range(len(found))]
    assert all(is_inside(o, room, store()) and steepness(o) > 0.8 for o in found)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("is_down", [False, True])
def test_stood_on_end(axis: int, is_down: bool) -> None:
    way = rotation_matrix(stand_on_end(axis, is_down=is_down))[:, axis]
    assert list(way) == pytest.approx([0, 0, -1 if is_down else 1], abs=1e-12)


# --- letting go


@pytest.mark.parametrize("count", [1, 3])
def test_long_things_that_lie_lean_in_their_cup_and_stay(count: int) -> None:
    sticks = [stick(k, 0.3 + 0.2 * k) for k in range(count)]
    built = with_relations(scene(CUP, *sticks), RelationKind.IN, *((o.instance, "cup") for o in sticks))
    let = let_go(built)
    assert dict(let.carriers) == {o.instance: "cup" for o in sticks}
    assert let.scene["cup"] == store().resolved(built)[0]["cup"]
    assert all(steepness(let.scene[o.instance]) > 0.7 for o in sticks)
    resolved, shapes, _ = store().resolved(let.scene)
    bodies = bodies_of(resolved, shapes, store())
    assert settle([replace(bodies[0], movable=False), *bodies[1:]], resolved.table).stable
    done = certify(resolved, shapes)
    assert done.audit is not None
    assert done.audit.card().clean


def test_a_thing_over_another_comes_down_on_it_and_keeps_its_tilt() -> None:
    built = scene(thing("plate", (0.5, 0.4, 0.005, 0.0)), thing("cube", (0.52, 0.41, 0.3, 0.7)))
    let = let_go(with_relations(built, RelationKind.ON, ("cube", "plate")))
    cube = let.scene["cube"]
    assert cube.tilt_quat_xyzw == built["cube"].tilt_quat_xyzw
    assert cube.position == pytest.approx((0.52, 0.41, 0.06), abs=1e-3)
    resolved, shapes, _ = store().resolved(let.scene)
    audit = audit_scene(resolved, shapes)
    assert audit.card().clean
    assert audit.pairs == ()  # no contact is deep at all


def test_a_stack_is_drop_new_objects_from_below() -> None:
    cubes = (thing(f"cube_{k}", (0.5, 0.4, 0.6, 0.0), support=f"cube_{k - 1}" if k else "plate") for k in range(3))
    built = scene(thing("plate", (0.5, 0.4, 0.005, 0.0)), *cubes)
    pairs = (("cube_2", "cube_1"), ("cube_1", "cube_0"), ("cube_0", "plate"))
    let = let_go(with_relations(built, RelationKind.ON, *pairs))
    assert [let.scene[f"cube_{k}"].position[2] for k in range(3)] == pytest.approx([0.06, 0.16, 0.26], abs=1e-3)
    assert dict(let.carriers) == dict.fromkeys(("cube_0", "cube_1", "cube_2"), "plate")
    resolved, shapes, _ = store().resolved(let.scene)
    audit = audit_scene(resolved, shapes)
    assert audit.pairs == ()
    assert audit.card().clean


@pytest.mark.parametrize(("depth", "rise"), [(-1e-4, 0.0), (2e-5, 4e-5), (8e-5, 1e-4), (3e-4, 4e-4), (2e-3, 0.0)])
def test_what_is_a_little_deep_is_raised_and_what_is_deep_stays(depth: float, rise: float) -> None:
    resolved, shapes, _ = store().resolved(scene(thing("plate", (0.5, 0.4, 0.005, 0.0)), thing("cube", (0.5, 0.4, 0.06, 0.3))))
    meshes, poses = MeshQueries([s.as_mesh() for s in shapes]), resolved.poses()
    poses[1, 2] -= depth
    raised = meshes.raise_free(1, poses[1], [0], poses)
    assert raised - poses[1] == pytest.approx([0, 0, rise, 0], abs=1e-9)


def test_what_leans_in_an_askew_way_comes_to_lie_flat() -> None:
    tilt: QuatXyzw = (math.sin(math.radians(1)), 0.0, 0.0, math.cos(math.radians(1)))
    built = scene(thing("plate", (0.5, 0.4, 0.005, 0.0)), thing("cube", (0.5, 0.4, 0.2, 0.0), tilt=tilt))
    let = let_go(with_relations(built, RelationKind.ON, ("cube", "plate")))
    assert steepness(let.scene["cube"]) == pytest.approx(1, abs=1e-4)


def test_what_rolls_off_is_where_it_was() -> None:
    built = scene(thing("ball_0", (0.5, 0.4, 0.05, 0.0)), thing("ball_1", (0.52, 0.4, 0.2, 0.0)))
    let = let_go(with_relations(built, RelationKind.ON, ("ball_1", "ball_0")))
    assert let.scene == with_relations(built, RelationKind.ON, ("ball_1", "ball_0"))
    assert not let.carriers


@pytest.mark.parametrize("x", [0.595, 0.61, 0.7])
def test_what_is_proposed_at_or_beyond_an_edge_lies_flat_or_is_where_it_was(x: float) -> None:
    built = scene(thing("plate", (0.5, 0.4, 0.005, 0.0)), thing("cube", (x, 0.4, 0.06, 0.0), scale=(0.4, 0.4, 0.4)))
    cube = let_go(with_relations(built, RelationKind.ON, ("cube", "plate"))).scene["cube"]
    assert cube.tilt_quat_xyzw == built["cube"].tilt_quat_xyzw
    assert cube == built["cube"] or cube.position[0] <= 0.59 + 1e-3


def test_what_waits_for_its_own_turn_holds_nothing_up() -> None:
    """A cube stood under the plate as both were proposed: the plate comes down on the mat all the same."""
    built = scene(
        thing("cloth", (0.5, 0.4, 0.001, 0.0), scale=(2.0, 2.0, 1.0)),
        thing("plate", (0.5, 0.4, 0.2, 0.0), support="cloth"),
        thing("cube", (0.53, 0.4, 0.06, 0.0), scale=(0.3, 0.3, 0.6), support="plate"),
    )
    let = let_go(with_relations(built, RelationKind.ON, ("plate", "cloth"), ("cube", "plate")))
    assert steepness(let.scene["plate"]) > 0.9999
    assert let.scene["plate"].position[2] < 0.02
    assert let.scene["cube"].position[2] == pytest.approx(let.scene["plate"].position[2] + 0.035, abs=2e-3)


def test_what_is_to_be_on_a_cup_or_in_a_wide_bowl_does_not_lean_in_it() -> None:
    on_it = with_relations(scene(CUP, stick(0, 0.5)), RelationKind.ON, ("cube_0", "cup"))
    assert steepness(let_go(on_it).scene["cube_0"]) < 0.3
    wide = thing("bowl", (0.5, 0.4, 0.08, 0.0), scale=(2.0, 2.0, 2.0))
    room = interior_of(wide, store().shape(wide)[0])
    assert room is not None
    assert not is_long(stick(0, 0.5), room, store())


def test_a_spoon_alone_leans_across_its_bowl() -> None:
    """From the middle it would tip over the rim: it is far longer than the bowl is deep."""
    wide = thing("bowl", (0.5, 0.4, 0.06, 0.3), scale=(1.5, 1.5, 1.5))
    spoon = thing("cube", (0.55, 0.4, 0.2, 0.0), scale=(0.5, 0.12, 3.0))
    let = let_go(with_relations(scene(wide, spoon), RelationKind.IN, ("cube", "bowl")))
    assert dict(let.carriers) == {"cube": "bowl"}
    room = interior_of(let.scene["bowl"], store().shape(wide)[0])
    assert room is not None
    assert is_inside(let.scene["cube"], room, store())
    assert 0.2 < steepness(let.scene["cube"]) < 0.8


def test_what_leans_on_a_cup_from_outside_is_not_in_it() -> None:
    room = interior_of(CUP, store().shape(CUP)[0])
    assert room is not None
    assert room.reach == pytest.approx(0.045, abs=1e-3)
    angle = math.radians(12.5)
    out = stick(0, 0.538, tilt=(0.0, math.sin(angle), 0.0, math.cos(angle)))  # its foot is 3 cm nearer to the middle
    for yaw, x, bottom, is_in in (
        (0.0, 0.538, 0.012, True),
        (np.pi, 0.538, 0.012, False),
        (0.0, 0.538, 0.0, False),
        (0.0, 0.56, 0.012, False),
    ):
        assert is_inside(out.moved((x, 0.4, bottom + out.size[2] / 2), yaw), room, store()) is is_in


def test_what_lies_under_the_rim_of_a_bowl_is_not_in_it_and_stays() -> None:
    """A pen on a mat beside it, over which the rim reaches."""
    bowl = thing("bowl", (0.5, 0.4, 0.04, 0.0))
    mat = thing("plate_0", (0.5, 0.5, 0.0015, 0.0), scale=(1.5, 0.8, 0.3))
    pen = thing("cube_9", (0.5, 0.465, 0.0075, np.pi / 2), scale=(0.1, 0.09, 1.6), tilt=LYING, support="plate_0")
    built = scene(bowl, mat, pen, stick(0, 0.3))
    room = interior_of(bowl, store().shape(bowl)[0])
    assert room is not None
    assert room.reach > 0.08 > room.mouth > room.radius
    assert is_long(pen, room, store())
    assert not is_inside(pen, room, store())
    let = drop_new_objects(
        store().resolved(with_relations(built, RelationKind.IN, ("cube_0", "bowl")))[0], {"cube_0"}, NONE, store()
    )
    assert "cube_9" not in let.carriers
    assert let.scene["cube_9"] == store().resolved(built)[0]["cube_9"]


def test_the_hollow_turns_with_its_thing() -> None:
    """A cup whose hollow is not in the middle of its box, as that of one with a handle."""
    handle = box(0.06, 0.01, 0.04)
    joined = hollow(store().shape(CUP)[0], Shape(np.add(handle.vertices, (0.065, 0.0, 0.0)), handle.faces))
    middle = (joined.vertices.min(axis=0) + joined.vertices.max(axis=0)) / 2
    turned = replace(CUP, size=(0.135, 0.08, 0.1), yaw=np.pi / 2)
    found = interior_of(turned, Shape(joined.vertices - middle, joined.faces))
    assert found is not None
    assert list(found.middle) == pytest.approx([0.5, 0.4 - middle[0]], abs=2e-3)


def test_a_thick_thing_is_no_reason_that_thin_ones_do_not_stand() -> None:
    room = interior_of(CUP, store().shape(CUP)[0])
    assert room is not None
    thick = thing("cube_9", (0.5, 0.4, 0.2, 0.0), scale=(0.8, 0.8, 3.0))
    assert [o.instance for o in place_leaning([thick, stick(0, 0.5), stick(1, 0.5)], room, store())] == ["cube_0", "cube_1"]


def test_things_that_are_said_to_lie_on_each_other_are_left_alone() -> None:
    built = scene(thing("cube_0", (0.3, 0.4, 0.05, 0.0)), thing("cube_1", (0.6, 0.4, 0.05, 0.0)))
    pairs = (("cube_0", "cube_1"), ("cube_1", "cube_0"))
    assert not let_go(with_relations(built, RelationKind.ON, *pairs)).carriers
    assert not let_go(with_relations(built, RelationKind.ON, ("cube_0", "cube_0"))).carriers


def test_only_what_is_new_and_may_move_is_let_go() -> None:
    built = with_relations(scene(CUP, stick(0, 0.3)), RelationKind.IN, ("cube_0", "cup"))
    assert drop_new_objects(built, NONE, NONE, store()).scene == built
    assert let_go(built, frozenset({"cube_0"})).scene == built
    assert let_go(with_relations(built, RelationKind.IN, ("cube_0", "gone"))).carriers == {}


def test_those_that_lean_there_already_make_room_unless_they_must_stay() -> None:
    first = let_go(with_relations(scene(CUP, stick(0, 0.3)), RelationKind.IN, ("cube_0", "cup"))).scene
    both = replace(first, objects=(*first.objects, stick(1, 0.7)))
    for fixed in (NONE, frozenset({"cube_0"})):
        made = drop_into_container(both, "cup", {"cube_1"}, fixed, store())
        assert made is not None
        assert (made["cube_0"] == first["cube_0"]) == bool(fixed)
        assert steepness(made["cube_1"]) > 0.7
        resolved, shapes, _ = store().resolved(made)
        assert all(p.penetration is None or p.penetration < 1e-3 for p in audit_scene(resolved, shapes).pairs)


def test_what_is_too_thick_for_a_cup_does_not_stand_in_it() -> None:
    room = interior_of(CUP, store().shape(CUP)[0])
    assert room is not None
    assert not place_leaning([thing("cube", (0.5, 0.4, 0.2, 0.0), scale=(0.8, 0.8, 3.0))], room, store())


# --- going with what it lies on


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.1, 0.1), st.floats(-3, 3), st.floats(-1, 1)
)  # fmt: skip
def test_what_was_drop_new_objects_goes_where_its_carrier_goes(x: float, y: float, z: float, yaw: float, other: float) -> None:
    built = scene(
        thing("plate", (0.5, 0.4, 0.005, 0.2)), thing("cube", (0.55, 0.4, 0.06, 0.7)), thing("ball", (0.1, 0.1, 0.05, 0))
    )
    let = DropResult(built, {"cube": "plate"})
    moved = built.with_poses(np.add(built.poses(), [[x, y, z, yaw], [other, 0, 0, 1], [other, 0, 0, other]]))
    after = let.with_motion_of(moved)
    assert (after["plate"], after["ball"]) == (moved["plate"], moved["ball"])
    was, now = (np.subtract(s["cube"].position, s["plate"].position) for s in (built, after))
    assert np.linalg.norm(was) == pytest.approx(np.linalg.norm(now))
    assert now[2] == pytest.approx(was[2])
    assert after["cube"].yaw - after["plate"].yaw == pytest.approx(built["cube"].yaw - built["plate"].yaw)
    assert (
        np.arctan2(now[1], now[0]) - np.arctan2(was[1], was[0]) == pytest.approx(yaw, abs=1e-6)
        or abs(abs(np.arctan2(now[1], now[0]) - np.arctan2(was[1], was[0]) - yaw) - 2 * np.pi) < 1e-6
    )
