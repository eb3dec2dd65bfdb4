"""What carries an object, and how far it is from its support."""

import numpy as np
import pytest

from stable_data.geometry.shape import Shape
from stable_data.metrics.audit import PosedScene, audit_scene
from stable_data.metrics.support import carries, distance_to_surface
from stable_data.metrics.triangle_intersection import MeshPair
from tests.scenes import Placed, ball, ball_in_bowl, box, box_on_table, leaning_plate, scene_of, sheet, triangles

CUBE = box(0.1, 0.1, 0.1)
ON_TABLE: Placed = ("base", CUBE, (0.5, 0.5, 0.05, 0.0))


def floats(placed: list[Placed], tolerance: float = 5e-4) -> dict[str, bool | None]:
    return {o.instance: o.floats for o in audit_scene(*scene_of(placed), tolerance).objects}


@pytest.mark.parametrize(("gap", "expected"), [(0.0, False), (4e-4, False), (6e-4, True), (5e-3, True)])
def test_a_box_above_the_table_floats_beyond_half_a_millimetre(gap: float, expected: bool) -> None:
    (verdict,) = audit_scene(*box_on_table(gap)).objects
    assert verdict.floats is expected
    assert verdict.supports == (() if expected else ("table",))
    assert verdict.gap == pytest.approx(gap, abs=1e-9)


@pytest.mark.parametrize(("gap", "expected"), [(-1e-3, False), (0.0, False), (4e-4, False), (6e-4, True)])
@pytest.mark.parametrize("upper_first", [True, False])
def test_a_box_above_a_box_floats_beyond_half_a_millimetre(gap: float, expected: bool, upper_first: bool) -> None:
    upper: Placed = ("upper", CUBE, (0.52, 0.51, 0.15 + gap, 0.4))
    assert floats([upper, ON_TABLE] if upper_first else [ON_TABLE, upper])["upper"] is expected


def test_the_tolerance_is_how_far_an_object_is_lowered() -> None:
    upper: Placed = ("upper", CUBE, (0.52, 0.51, 0.1525, 0.4))
    assert floats([ON_TABLE, upper], 3e-3)["upper"] is False
    assert floats([ON_TABLE, upper], 2e-3)["upper"] is True


def test_a_box_that_only_touches_a_vertical_wall_floats() -> None:
    wall: Placed = ("wall", box(0.1, 0.1, 0.3), (0.5, 0.5, 0.15, 0.0))
    for reach in (0.0, -1e-5, -3e-4):
        assert floats([wall, ("stuck", CUBE, (0.6 + reach, 0.5, 0.15, 0.0))])["stuck"] is True


def test_an_object_sunk_into_its_support_is_carried_by_it() -> None:
    narrow: Placed = ("narrow", box(0.05, 0.05, 0.1), (0.5, 0.5, 0.05, 0.0))
    for depth in (1e-3, 5e-3):
        assert floats([narrow, ("wide", CUBE, (0.5, 0.5, 0.15 - depth, 0.0))])["wide"] is False
        assert floats([ON_TABLE, ("small", box(0.05, 0.05, 0.05), (0.5, 0.5, 0.125 - depth, 0.0))])["small"] is False


def test_what_lies_on_an_object_does_not_carry_it() -> None:
    hanging: Placed = ("hanging", CUBE, (0.5, 0.5, 0.2, 0.0))
    on_top: Placed = ("on top", CUBE, (0.5, 0.5, 0.2999, 0.0))
    assert floats([hanging, on_top]) == {"hanging": True, "on top": False}


def test_an_object_that_hangs_over_the_edge_is_still_carried_by_the_table() -> None:
    (verdict,) = audit_scene(*scene_of([("box", CUBE, (0.0, 0.5, 0.05, 0.0))])).objects
    assert not verdict.floats
    assert verdict.leaves_table


def test_an_object_beside_the_table_floats() -> None:
    (verdict,) = audit_scene(*scene_of([("box", CUBE, (-0.2, 0.5, 0.05, 0.0))])).objects
    assert verdict.floats
    assert verdict.leaves_table
    assert verdict.gap == pytest.approx(0.1)  # the farthest that is looked


def test_each_object_of_a_stack_is_carried_by_the_one_below() -> None:
    stack: list[Placed] = [(f"box {k}", CUBE, (0.5, 0.5, 0.05 + 0.1 * k, 0.1 * k)) for k in range(4)]
    audit = audit_scene(*scene_of(stack))
    assert [o.supports for o in audit.objects] == [("table",), ("box 0",), ("box 1",), ("box 2",)]
    assert not any(o.floats for o in audit.objects)


def test_one_object_may_be_carried_by_several() -> None:
    bridge: list[Placed] = [
        ("left", CUBE, (0.4, 0.5, 0.05, 0.0)),
        ("right", CUBE, (0.6, 0.5, 0.05, 0.0)),
        ("plank", box(0.3, 0.1, 0.02), (0.5, 0.5, 0.1101, 0.0)),
    ]
    assert audit_scene(*scene_of(bridge)).objects[2].supports == ("left", "right")


def test_a_ball_is_carried_by_the_bowl_that_it_lies_in() -> None:
    audit = audit_scene(*ball_in_bowl())
    assert audit.pairs == ()
    assert [o.supports for o in audit.objects] == [("table",), ("bowl",)]
    assert audit.objects[1].gap == pytest.approx(2e-4, abs=3e-4)


def test_a_leaning_plate_is_carried_by_the_table_and_the_edge_that_it_leans_on() -> None:
    audit = audit_scene(*leaning_plate())
    assert audit.pairs == ()
    assert set(audit.objects[0].supports) == {"table", "block"}


@pytest.mark.parametrize("flipped", [False, True])
def test_a_sheet_carries_whichever_way_it_is_wound(flipped: bool) -> None:
    flat = sheet(0.3, 0.3)
    wound = Shape(flat.vertices, flat.faces[:, ::-1].copy()) if flipped else flat
    assert floats([("sheet", wound, (0.5, 0.5, 0.02, 0.0)), ("box", CUBE, (0.5, 0.5, 0.0701, 0.0))])["box"] is False


def test_a_contact_that_carries_is_found_among_very_many_that_do_not() -> None:
    # A fine tube around a fine ball touches it all round; a floor of two triangles below carries it.
    rod = ball(0.05, 5)
    around = Shape(rod.vertices * (1.0, 1.0, 6.0), rod.faces)
    pair = MeshPair(triangles(rod, (0.03, 0, 0, 0)), triangles(around), 5e-4)
    assert carries(pair, 5e-4) is carries(
        MeshPair(triangles(around), triangles(rod, (0.03, 0, 0, 0)), 5e-4), 5e-4, upper_is_first=False
    )


def test_a_missing_mesh_leaves_open_what_it_might_carry() -> None:
    stand_in = Shape.box((0.1, 0.1, 0.1))
    on_top: Placed = ("upper", CUBE, (0.5, 0.5, 0.15, 0.0))
    assert floats([("base", stand_in, (0.5, 0.5, 0.05, 0.0)), on_top])["upper"] is None
    assert floats([("base", stand_in, (0.5, 0.5, 0.05, 0.0)), ("upper", CUBE, (0.8, 0.5, 0.15, 0.0))])["upper"] is True


def test_another_support_closes_what_a_missing_mesh_left_open() -> None:
    stand_in: Placed = ("unknown", Shape.box((0.1, 0.1, 0.1)), (0.55, 0.5, 0.05, 0.0))
    base: Placed = ("base", CUBE, (0.45, 0.5, 0.05, 0.0))
    assert floats([stand_in, base, ("upper", box(0.2, 0.1, 0.02), (0.5, 0.5, 0.11, 0.0))])["upper"] is False


def test_the_gap_is_the_distance_to_the_nearest_support() -> None:
    upper: Placed = ("upper", CUBE, (0.5, 0.5, 0.157, 0.0))
    posed = PosedScene(*scene_of([ON_TABLE, upper]))
    assert posed.gap(0) == 0.0
    assert posed.gap(1) == pytest.approx(0.007, rel=1e-5)


def test_the_gap_of_a_sunk_object_is_the_least_distance_of_its_bottom_region() -> None:
    assert PosedScene(*box_on_table(-4e-4)).gap(0) == 0.0
    assert PosedScene(*box_on_table(-0.02)).gap(0) == pytest.approx(0.015, abs=2e-3)  # the region is 5 mm high


def test_distance_to_a_surface_is_exact_and_bounded() -> None:
    points = np.array([[0.0, 0.0, 0.2], [0.3, 0.0, 0.0], [0.07, 0.08, 0.01]])
    surface = triangles(CUBE)
    assert distance_to_surface(points[:1], surface, 1.0) == pytest.approx(0.15)
    assert distance_to_surface(points, surface, 1.0) == pytest.approx(np.hypot(0.02, 0.03))
    assert distance_to_surface(points, surface, 0.01) == 0.01
