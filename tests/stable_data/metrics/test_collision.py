"""Depths of shapes whose overlap is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.geometry.shape import Shape
from stable_data.metrics.collision import DEEPEST, LEVELS, is_nested, penetration
from stable_data.metrics.triangle_intersection import MeshPair
from stable_data.metrics.verdicts import TOLERANCE
from tests.scenes import ball, bowl, box, hollow, sheet, triangles

CUBE = box(0.1, 0.1, 0.1)


@pytest.mark.parametrize("depth", [2e-4, 5e-4, 1e-3, 2.5e-3, 7e-3, 1.5e-2, 3e-2, 4.5e-2])
def test_boxes_that_overlap_along_x_are_that_deep(depth: float) -> None:
    assert penetration(triangles(CUBE), triangles(CUBE, (0.1 - depth, 0.0, 0.0, 0.0))) == pytest.approx(depth, rel=0.021)


@pytest.mark.parametrize("depth", [1e-3, 1e-2, 3e-2])
def test_a_contact_normal_parts_boxes_that_are_turned(depth: float) -> None:
    yaw = 0.5  # none of the fixed directions: 0.5 rad off x, 0.29 rad off the diagonal
    other = ((0.1 - depth) * np.cos(yaw), (0.1 - depth) * np.sin(yaw), 0.0, yaw)
    assert penetration(triangles(CUBE, (0, 0, 0, yaw)), triangles(CUBE, other)) == pytest.approx(depth, rel=0.025)


@pytest.mark.parametrize("depth", [5e-4, 3e-3, 2e-2])
@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.6, 0.8)])
def test_balls_are_as_deep_as_their_radii_say(depth: float, direction: tuple[float, float, float]) -> None:
    x, y, z = np.array(direction) * (0.1 - depth)
    found = penetration(triangles(ball(0.05, 5)), triangles(ball(0.05, 5), (x, y, z, 0.0)))
    assert found == pytest.approx(depth, rel=0.03, abs=6e-5)  # the facets lie up to 0.02 mm inside each sphere


@settings(max_examples=12, deadline=None)
@given(yaw=st.floats(-3.1, 3.1), x=st.floats(-2, 2), depth=st.floats(3e-4, 2e-2))
def test_depth_does_not_depend_on_where_the_pair_stands(yaw: float, x: float, depth: float) -> None:
    c, s = np.cos(yaw), np.sin(yaw)
    reach = 0.1 - depth
    found = penetration(triangles(CUBE, (x, -x, 0.3, yaw)), triangles(CUBE, (x + c * reach, s * reach - x, 0.3, yaw)))
    assert found == pytest.approx(depth, rel=0.025)


@settings(max_examples=10, deadline=None)
@given(x=st.floats(0.0, 0.09), y=st.floats(-0.05, 0.05), yaw=st.floats(0, 1.5))
def test_depth_is_symmetric(x: float, y: float, yaw: float) -> None:
    a, b = triangles(ball(0.05)), triangles(CUBE, (x, y, 0.01, yaw))
    there, back = penetration(a, b), penetration(b, a)
    assert there == pytest.approx(back, rel=0.05, abs=1e-5)


def test_a_box_inside_a_box_is_deepest() -> None:
    inner = box(0.02, 0.02, 0.02)
    assert penetration(triangles(inner), triangles(CUBE)) == DEEPEST
    assert penetration(triangles(CUBE), triangles(inner)) == DEEPEST


def test_boxes_that_cannot_be_parted_within_the_last_level_are_deepest() -> None:
    large = box(0.4, 0.4, 0.4)
    assert penetration(triangles(large), triangles(large, (0.01, 0.0, 0.0, 0.3))) == DEEPEST
    assert LEVELS[-1] < DEEPEST


def test_touching_faces_are_no_deeper_than_a_hundredth_of_a_millimetre() -> None:
    assert penetration(triangles(CUBE), triangles(CUBE, (0.1, 0.0, 0.0, 0.0))) <= 1e-5


def test_boxes_that_are_a_hair_apart_do_not_collide() -> None:
    assert penetration(triangles(CUBE), triangles(CUBE, (0.1 + 1e-6, 0.0, 0.0, 0.0))) == 0.0


def test_a_ball_in_a_hollow_bowl_does_not_collide() -> None:
    assert penetration(triangles(ball(0.03)), triangles(bowl(0.08, 0.005), (0.0, 0.0, 0.004, 0.0))) == 0.0


def test_a_ball_sunk_into_a_bowls_bottom_is_that_deep() -> None:
    # The bowl's inner bottom lies at -0.035 in its own frame.
    found = penetration(triangles(ball(0.03, 4), (0.0, 0.0, -0.035 + 0.03 - 0.002, 0.0)), triangles(bowl(0.08, 0.005)))
    assert found == pytest.approx(0.002, rel=0.1)


def test_a_sheet_through_a_box_is_parted_along_its_shortest_way() -> None:
    found = penetration(triangles(sheet(0.3, 0.3)), triangles(box(0.1, 0.1, 0.02), (0.0, 0.0, 0.006, 0.0)))
    assert found == pytest.approx(0.004, rel=0.025)


def test_a_sheet_inside_a_box_nests() -> None:
    assert penetration(triangles(sheet(0.05, 0.05)), triangles(CUBE)) == DEEPEST


def test_an_open_mesh_has_no_inside() -> None:
    open_box = Shape(CUBE.vertices, CUBE.faces[:-2])
    assert not is_nested(triangles(box(0.02, 0.02, 0.02)), triangles(open_box))
    assert is_nested(triangles(box(0.02, 0.02, 0.02)), triangles(CUBE))


def test_an_inside_out_solid_still_has_an_inside() -> None:
    turned = Shape(CUBE.vertices, CUBE.faces[:, ::-1].copy())
    assert is_nested(triangles(box(0.02, 0.02, 0.02)), triangles(turned))


def test_the_hollow_of_a_closed_shell_is_not_its_inside() -> None:
    cavity = box(0.08, 0.08, 0.08)
    shell = hollow(CUBE, Shape(cavity.vertices, cavity.faces[:, ::-1].copy()))
    assert not is_nested(triangles(box(0.02, 0.02, 0.02)), triangles(shell))
    assert penetration(triangles(box(0.02, 0.02, 0.02)), triangles(shell)) == 0.0


def test_a_pair_that_was_thinned_for_support_serves() -> None:
    a, b = triangles(CUBE), triangles(CUBE, (0.098, 0.0, 0.0, 0.0))
    assert penetration(a, b, MeshPair(a, b, 5e-4)) == penetration(a, b)


@pytest.mark.parametrize("depth", [5e-6, 3e-4, TOLERANCE, 7e-4, 4e-3, 0.08])
def test_a_depth_over_the_greatest_that_is_measured_is_infinite_and_others_are_as_ever(depth: float) -> None:
    a, b = triangles(CUBE), triangles(CUBE, (0.1 - depth, 0.0, 0.0, 0.0))
    whole = penetration(a, b)
    assert penetration(a, b, most=TOLERANCE) == (np.inf if whole > TOLERANCE else whole)
    assert penetration(a, b, most=1.5e-3) == (np.inf if whole > 2e-3 else whole)  # the levels are steps
