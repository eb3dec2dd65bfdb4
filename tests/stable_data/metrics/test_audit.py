"""The audit of whole scenes: every verdict, and what becomes of what is not known."""

import time
from dataclasses import asdict, replace

import numpy as np
import pytest

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import PosedScene, _mark_support_cycles, audit_posed_scene, audit_scene
from stable_data.metrics.triangle_intersection import MeshPair
from stable_data.metrics.verdicts import TOLERANCE, Audit, ObjectVerdict, PairVerdict
from stable_data.scene import Scene
from tests.scenes import Placed, ball, ball_in_bowl, bowl, box, box_on_table, leaning_plate, overlapping_balls, scene_of

CUBE = box(0.1, 0.1, 0.1)
UNKNOWN = Shape.box((0.1, 0.1, 0.1))


def good(instance: str, floats: bool | None = False) -> ObjectVerdict:
    return ObjectVerdict(
        instance, floats, ("table",), 0.0, 0.0, leaves_table=False, enters_restricted_zone=False, has_mesh=True
    )


@pytest.mark.parametrize(
    "built", [box_on_table(), ball_in_bowl(), leaning_plate()], ids=["box", "ball in bowl", "leaning plate"]
)
def test_scenes_that_are_right_are_clean(built: tuple[Scene, list[Shape]]) -> None:
    card = audit_scene(*built).card()
    assert card.clean is True
    assert card.oc == card.float_rate == card.out_of_bounds_rate == card.max_penetration_mm == 0.0


def test_two_overlapping_balls_collide_at_the_tolerances_below_their_depth() -> None:
    card = audit_scene(*overlapping_balls(0.004)).card()
    assert card.max_penetration_mm == pytest.approx(4.0, rel=0.05)
    assert (card.oc_0mm, card.oc, card.oc_1mm, card.oc_10mm) == (1.0, 1.0, 1.0, 0.0)
    assert card.num_collisions == 1
    assert card.clean is False


def test_a_shallow_overlap_is_let_pass_at_the_tolerance() -> None:
    card = audit_scene(*overlapping_balls(3e-4)).card()
    assert (card.oc_0mm, card.oc, card.clean) == (1.0, 0.0, True)


def test_shares_are_of_all_unordered_pairs_and_of_all_objects() -> None:
    placed: list[Placed] = [
        ("a", CUBE, (0.2, 0.2, 0.05, 0.0)),
        ("b", CUBE, (0.29, 0.2, 0.05, 0.0)),
        ("c", CUBE, (0.7, 0.7, 0.06, 0.0)),
        ("d", CUBE, (0.99, 0.2, 0.05, 0.0)),
    ]
    card = audit_scene(*scene_of(placed)).card()
    assert card.oc == pytest.approx(1 / 6)
    assert card.float_rate == 1 / 4
    assert card.out_of_bounds_rate == 1 / 4
    assert card.max_gap_mm == pytest.approx(10.0)


def test_an_object_that_leaves_the_table_and_enters_the_zone_counts_once() -> None:
    card = audit_scene(*scene_of([("box", CUBE, (0.0, 0.5, 0.05, 0.0))], zone=(0.0, 0.2, 0.4, 0.6))).card()
    assert card.out_of_bounds_rate == 1.0


@pytest.mark.parametrize(("sunk", "clean"), [(4e-4, True), (6e-4, False), (0.03, False)])
def test_sinking_into_the_table_is_measured_and_bounded(sunk: float, clean: bool) -> None:
    card = audit_scene(*box_on_table(-sunk)).card()
    assert card.table_penetration_mm == pytest.approx(1e3 * sunk)
    assert card.clean is clean
    assert card.float_rate == 0.0


@pytest.mark.parametrize("offset", [0.1 * k for k in range(1, 9)])
@pytest.mark.parametrize("height", [0.043, 0.1, 0.117])
def test_what_is_off_by_the_tolerance_itself_is_let_pass(height: float, offset: float) -> None:
    # Lengths as a layout gives them: millimetres and halves of them, whose sums are rounded this way and that.
    block, wide = box(0.1, 0.1, height), 0.1 - 5e-4
    placed: list[Placed] = [
        ("sunk", block, (offset, 0.1, height / 2 - 5e-4, 0.0)),
        ("deep in it", block, (offset + wide, 0.1, height / 2, 0.0)),
        ("above the table", block, (offset, 0.4, height / 2 + 5e-4, 0.0)),
        ("above a thing", block, (offset, 0.4, height / 2 + height + 1e-3, 0.0)),
        ("over the edge", block, (0.05 - 1e-3, 0.6, height / 2, 0.0)),
        ("in the zone", block, (0.8, 0.8 - 0.05 + 1e-3, height / 2, 0.0)),
    ]
    audit = audit_scene(*scene_of(placed, size_xy=(1.2, 1.0), zone=(0.75, 0.85, 0.8, 1.0)))
    assert audit.card().clean is True
    assert len(audit.pairs) == 1
    over = [(n, s, (x, y, z + d, yaw)) for (n, s, (x, y, z, yaw)), d in zip(placed, (-1e-8, 0, 1e-8, 2e-8, 0, 0), strict=True)]
    worse = audit_scene(*scene_of(over, size_xy=(1.2, 1.0)))
    assert [o.floats for o in worse.objects] == [False, False, True, True, False, False]
    assert worse.card().clean is False


@pytest.mark.parametrize("depth", [5e-4, 1e-3, 1e-2])
def test_a_pair_as_deep_as_a_tolerance_is_not_deeper(depth: float) -> None:
    for k in range(20):
        at = 0.1 + 0.037 * k
        placed: list[Placed] = [("a", CUBE, (at, 0.5, 0.05, 0.0)), ("b", CUBE, (at + 0.1 - depth, 0.5, 0.05, 0.0))]
        audit = audit_scene(*scene_of(placed))
        assert audit.share_deeper(depth) == 0.0
        assert audit.share_deeper(0.97 * depth) == 1.0


def test_the_tolerance_moves_every_verdict() -> None:
    placed: list[Placed] = [
        ("sunk", CUBE, (0.2, 0.2, 0.048, 0.0)),
        ("lifted", CUBE, (0.5, 0.5, 0.052, 0.0)),
        ("left", CUBE, (0.2, 0.7, 0.05, 0.0)),
        ("right", CUBE, (0.298, 0.7, 0.05, 0.0)),
    ]
    assert audit_scene(*scene_of(placed)).card().clean is False
    assert audit_scene(*scene_of(placed), tolerance=3e-3).card().clean is True


def test_what_is_deeper_than_asked_is_infinite_and_all_else_is_as_ever() -> None:
    placed: list[Placed] = [
        ("left", CUBE, (0.2, 0.2, 0.05, 0.0)),
        ("right", CUBE, (0.2997, 0.2, 0.05, 0.0)),  # 0.3 mm
        ("deep", CUBE, (0.2, 0.295, 0.05, 0.0)),  # 5 mm
        ("unknown", UNKNOWN, (0.2, 0.11, 0.05, 0.0)),
    ]
    scene, shapes = scene_of(placed)
    whole, brief = PosedScene(scene, shapes), PosedScene(scene, shapes, TOLERANCE)
    assert brief.penetration(0, 1) == whole.penetration(0, 1) == pytest.approx(3e-4, rel=0.02)
    assert whole.penetration(0, 2) == pytest.approx(5e-3, rel=0.02)
    assert brief.penetration(0, 2) == np.inf
    assert brief.penetration(0, 3) is None


def test_answers_of_another_audit_are_reused_for_objects_that_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    placed: list[Placed] = [
        ("lower", CUBE, (0.2, 0.2, 0.05, 0.0)),
        ("upper", CUBE, (0.2, 0.2, 0.149, 0.0)),
        ("beside", CUBE, (0.295, 0.2, 0.05, 0.0)),
        ("unknown", UNKNOWN, (0.2, 0.11, 0.05, 0.0)),
        ("twin", CUBE, (0.2, 0.2, 0.05, 0.0)),
    ]
    scene, shapes = scene_of(placed)
    audit = audit_scene(scene, shapes)
    again = PosedScene(scene, shapes)
    again.reuse(scene, audit)
    assert audit_posed_scene(again) == audit
    judged: list[frozenset[str]] = []
    pair = PosedScene.pair

    def note(self: PosedScene, first: int, second: int, margin: float) -> MeshPair:
        judged.append(frozenset((self.instances[first], self.instances[second])))
        return pair(self, first, second, margin)

    monkeypatch.setattr(PosedScene, "pair", note)
    less = scene_of([*placed[:2], ("beside", CUBE, (0.295, 0.2, 0.05, 0.1)), ("new", CUBE, (0.2, 0.295, 0.05, 0.0))])
    turned = PosedScene(*less)
    turned.reuse(scene, audit)
    found = audit_posed_scene(turned)
    assert frozenset(("lower", "upper")) not in judged
    assert {frozenset(("lower", "beside")), frozenset(("lower", "new"))} <= set(judged)
    assert found == audit_scene(*less)
    judged.clear()
    cut = PosedScene(scene, shapes)
    cut.reuse(scene, replace(audit, is_cut_short=True))
    assert audit_posed_scene(cut) == audit
    assert frozenset(("lower", "upper")) in judged


def test_an_empty_scene_is_clean() -> None:
    card = audit_scene(*scene_of([])).card()
    assert (card.clean, card.num_objects, card.oc, card.float_rate, card.max_gap_mm) == (True, 0, 0.0, 0.0, 0.0)


def test_boxes_that_do_not_meet_settle_what_a_missing_mesh_leaves_open() -> None:
    card = audit_scene(*scene_of([("known", CUBE, (0.2, 0.2, 0.05, 0.0)), ("unknown", UNKNOWN, (0.7, 0.7, 0.05, 0.0))])).card()
    assert (card.num_unknown_pairs, card.oc, card.num_without_mesh) == (0, 0.0, 1)
    assert card.float_rate == 0.0  # it stands on the table
    assert card.clean is None  # but not by its mesh


def test_a_box_that_stands_in_beyond_an_edge_leaves_open_whether_its_mesh_is() -> None:
    placed: list[Placed] = [
        ("over the edge", UNKNOWN, (0.99, 0.2, 0.05, 0.0)),
        ("in the zone", UNKNOWN, (0.2, 0.2, 0.05, 0.0)),
        ("inside", UNKNOWN, (0.6, 0.6, 0.05, 0.0)),
    ]
    audit = audit_scene(*scene_of(placed, zone=(0.1, 0.2, 0.1, 0.3)))
    assert [(o.leaves_table, o.enters_restricted_zone) for o in audit.objects] == [(None, False), (False, None), (False, False)]
    assert [o.is_outside for o in audit.objects] == [None, None, False]
    assert audit.card().out_of_bounds_rate is None
    assert audit.card().clean is None
    known: list[Placed] = [*placed, ("outside", CUBE, (0.0, 0.6, 0.05, 0.0))]
    assert audit_scene(*scene_of(known)).card().clean is False


def test_a_missing_mesh_that_may_collide_is_unknown_and_never_a_pass() -> None:
    audit = audit_scene(*scene_of([("known", CUBE, (0.2, 0.2, 0.05, 0.0)), ("unknown", UNKNOWN, (0.29, 0.2, 0.05, 0.0))]))
    assert audit.pairs == (PairVerdict("known", "unknown", None),)
    card = audit.card()
    assert (card.num_unknown_pairs, card.num_collisions) == (1, 0)
    assert card.oc is card.oc_0mm is card.oc_1mm is card.oc_10mm is card.max_penetration_mm is card.clean is None


def test_a_known_failure_decides_although_something_is_unknown() -> None:
    placed: list[Placed] = [
        ("known", CUBE, (0.2, 0.2, 0.05, 0.0)),
        ("unknown", UNKNOWN, (0.29, 0.2, 0.05, 0.0)),
        ("in the air", CUBE, (0.7, 0.7, 0.2, 0.0)),
    ]
    assert audit_scene(*scene_of(placed)).card().clean is False


def test_unknown_support_makes_the_rate_and_clean_unknown() -> None:
    placed: list[Placed] = [("unknown", UNKNOWN, (0.2, 0.2, 0.05, 0.0)), ("upper", CUBE, (0.2, 0.2, 0.1503, 0.0))]
    card = audit_scene(*scene_of(placed)).card()
    assert card.float_rate is card.max_gap_mm is card.clean is None


@pytest.mark.parametrize(
    ("pairs", "floats", "clean"),
    [
        ((), False, True),
        ((PairVerdict("a", "b", 1e-4),), False, True),
        ((PairVerdict("a", "b", None),), False, None),
        ((), None, None),
        ((PairVerdict("a", "b", None),), True, False),
        ((PairVerdict("a", "b", 1e-2),), None, False),
    ],
)
def test_clean_is_decided_by_failures_first_and_unknowns_second(
    pairs: tuple[PairVerdict, ...], floats: bool | None, clean: bool | None
) -> None:
    assert Audit("s", pairs, (good("a", floats), good("b")), 0).card().clean is clean


def test_pairs_that_are_apart_are_not_listed() -> None:
    placed: list[Placed] = [("a", ball(0.05), (0.2, 0.2, 0.05, 0.0)), ("b", ball(0.05), (0.28, 0.28, 0.05, 0.0))]
    assert audit_scene(*scene_of(placed)).pairs == ()


def test_what_a_card_counts_is_a_plain_number() -> None:
    leaning, shapes = box_on_table()
    leaning = replace(leaning, objects=(replace(leaning.objects[0], tilt_quat_xyzw=(np.sin(0.1), 0.0, 0.0, np.cos(0.1))),))
    card = audit_scene(leaning, shapes).card()
    assert card.num_tilted == 1
    assert {type(value) for value in asdict(card).values()} <= {int, float, bool, type(None)}


def test_rows_say_the_same_in_millimetres() -> None:
    audit = audit_scene(*overlapping_balls(0.004))
    rows = audit.rows()
    assert rows["pairs"] == [{"first": "left", "second": "right", "penetration_mm": 1e3 * (audit.pairs[0].penetration or 0)}]
    assert [row["supports"] for row in rows["verdicts"]] == [o.supports for o in audit.objects]
    assert set(rows["verdicts"][0]) == {
        n.removesuffix("_mm") + ("_mm" if n in ("gap", "table_penetration") else "") for n in asdict(audit.objects[0])
    }


def _verdict(instance: str, *supports: str) -> ObjectVerdict:
    return ObjectVerdict(instance, not supports, supports, 0.0, 0.0, False, False, True)


def test_things_that_only_carry_each_other_float() -> None:
    objects = (_verdict("cup", "toy"), _verdict("toy", "cup"), _verdict("ball", "toy"))
    assert [o.floats for o in _mark_support_cycles(objects)] == [True, True, False]


def test_a_circle_that_a_missing_mesh_might_carry_is_unknown() -> None:
    objects = (_verdict("cup", "toy"), _verdict("toy", "cup"), _verdict("die", "box"), _verdict("box", "die"))
    assert [o.floats for o in _mark_support_cycles(objects, {"toy"})] == [None, None, True, True]
    # Two balls in the air that are in each other, one of them above a thing without a mesh.
    placed: list[Placed] = [
        ("left", ball(0.05), (0.5, 0.5, 0.3, 0.0)),
        ("right", ball(0.05), (0.596, 0.5, 0.3, 0.0)),
        ("unknown", UNKNOWN, (0.45, 0.5, 0.2, 0.0)),
    ]
    for count, floats in ((2, True), (3, None)):
        left, right, *_ = audit_scene(*scene_of(placed[:count])).objects
        assert (left.supports, right.supports) == (("right",), ("left",))
        assert left.floats is right.floats is floats


def test_a_circle_that_stands_on_something_does_not_float() -> None:
    objects = (_verdict("cup", "toy", "table"), _verdict("toy", "cup"))
    assert [o.floats for o in _mark_support_cycles(objects)] == [False, False]


def copies(num: int) -> tuple[Scene, list[Shape]]:
    """Twelve balls and bowls in a row, each in its neighbours, and each so many times in the same place."""
    kinds = [ball(0.05), bowl(0.06, 0.004)]
    row = [(kinds[k % 2], (0.1 + 0.07 * k, 0.5, kinds[k % 2].size[2] / 2, 0.3 * k)) for k in range(12)]
    return scene_of([(f"{k}_{copy}", *placed) for copy in range(num) for k, placed in enumerate(row)])


def test_objects_in_the_same_place_are_judged_once() -> None:
    begun = time.process_time()
    many = audit_scene(*copies(20))
    assert time.process_time() - begun < 10  # seconds; each pair on its own takes minutes
    few = audit_scene(*copies(2))
    assert not many.notices

    def depths(audit: Audit) -> dict[tuple[str, str], set[float | None]]:
        found: dict[tuple[str, str], set[float | None]] = {}
        for pair in audit.pairs:
            first, second = sorted(name.split("_")[0] for name in (pair.first, pair.second))
            found.setdefault((first, second), set()).add(pair.penetration)
        return found

    assert depths(many) == depths(few)
    assert all(len(same) == 1 for same in depths(many).values())
    assert len(many.pairs) == 400 * 11 + 190 * 12
    for ours, theirs in zip(many.objects[:24], few.objects, strict=True):
        assert replace(ours, supports=()) == replace(theirs, supports=())
        assert set(theirs.supports) <= set(ours.supports)


def test_a_mesh_is_in_its_copy_as_deep_as_the_two_would_be_told_apart() -> None:
    placed: list[Placed] = [("a", CUBE, (0.5, 0.5, 0.05, 0.3)), ("b", CUBE, (0.5, 0.5, 0.05, 0.3))]
    nearly = [placed[0], ("b", CUBE, (0.5 + 1e-7, 0.5, 0.05, 0.3))]
    for built in (placed, nearly):
        [pair] = audit_scene(*scene_of(built)).pairs
        assert pair.penetration == pytest.approx(0.1)


def cut_short(built: tuple[Scene, list[Shape]], limit: int) -> Audit:
    posed = PosedScene(*built)
    posed.budget.limit = limit
    return audit_posed_scene(posed)


def test_what_is_beyond_the_budget_of_work_is_unknown_and_said() -> None:
    scene, shapes = copies(2)
    objects = tuple(replace(o, yaw=o.yaw + 1e-4 * k) for k, o in enumerate(scene.objects[:16]))
    scene, shapes = replace(scene, objects=objects), shapes[:16]
    posed = PosedScene(scene, shapes)
    whole, half = audit_posed_scene(posed), posed.budget.spent // 2
    part = cut_short((scene, shapes), half)
    assert part == cut_short((scene, shapes), half)
    assert not whole.is_cut_short
    assert whole.notices == ()
    assert part.is_cut_short
    known = {(p.first, p.second): p.penetration for p in whole.pairs}
    found = {(p.first, p.second): p.penetration for p in part.pairs}
    assert known.keys() <= found.keys()
    assert None in found.values()
    assert any(found.values())
    assert all(depth is None or depth == known[pair] for pair, depth in found.items())
    [notice] = part.notices
    assert (notice.step, notice.code) == ("audit", "audit_cut_short")
    assert f"{sum(depth is None for depth in found.values())} pairs of objects unknown" in notice.message


def test_an_audit_that_was_cut_short_passes_nothing() -> None:
    placed: list[Placed] = [("lower", CUBE, (0.5, 0.5, 0.05, 0.0)), ("upper", CUBE, (0.5, 0.5, 0.15, 0.0))]
    assert audit_scene(*scene_of(placed)).card().clean is True
    audit = cut_short(scene_of(placed), 0)
    assert audit.card().clean is None
    assert audit.card().num_unknown_pairs == 1
    assert (audit.objects[1].floats, audit.objects[1].gap) == (None, None)


def test_fixed_objects_are_obstacles_but_are_not_judged() -> None:
    """Two walls in each other, one of them through the table and over its edge, and a box in one of them."""
    wall = box(0.02, 0.4, 0.3)
    placed: list[Placed] = [
        ("0_wall_0", wall, (0.0, 0.2, 0.1, 0.0)),
        ("1_wall_0", wall, (0.01, 0.2, 0.35, 0.3)),
        ("2_box_0", CUBE, (0.055, 0.2, 0.05, 0.0)),
        ("3_box_0", CUBE, (0.3, 0.2, 0.05, 0.0)),
    ]
    scene, shapes = scene_of(placed)
    fixed = replace(scene, fixed=frozenset({"0_wall_0", "1_wall_0"}))
    audit = audit_scene(fixed, shapes)
    assert [(p.first, p.second) for p in audit.pairs] == [("0_wall_0", "2_box_0")]
    card = audit.card()
    assert (card.num_objects, card.float_rate, card.out_of_bounds_rate, card.table_penetration_mm) == (2, 0.0, 0.0, 0.0)
    assert card.oc == 1 / 5  # six pairs but for that of the walls
    assert [row["instance"] for row in audit.rows()["verdicts"]] == ["2_box_0", "3_box_0"]
    assert audit_scene(scene, shapes).card().num_collisions == 2
