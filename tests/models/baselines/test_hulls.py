"""Signed distances of convex bodies: analytic ones, their derivative, and that they are convex in the shift."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.baselines.hulls import ConvexBodies, solid_hull, table_box
from stable_data.errors import MeshError
from stable_data.scene import FloatArray, Tabletop
from tests.scenes import ball, box

CUBES = ConvexBodies([[box(0.1, 0.1, 0.1).vertices], [box(0.1, 0.1, 0.1).vertices]])
POINTS = np.random.default_rng(0).normal(0.0, 0.03, (2, 40, 3))
ROCKS = ConvexBodies([[POINTS[0]], [POINTS[1]]])


def between(bodies: ConvexBodies, shift: FloatArray) -> tuple[float, FloatArray]:
    found = bodies.distances(np.stack([shift, np.zeros(3)]), reach=5.0)
    return float(found.distance[0]), found.normal[0]


@pytest.mark.parametrize("gap", [-0.09, -0.02, -1e-4, 1e-4, 0.02, 0.4])
def test_boxes(gap: float) -> None:
    distance, normal = between(CUBES, np.array([0.1 + gap, 0.003, -0.002]))
    assert distance == pytest.approx(gap, abs=1e-7)
    assert normal == pytest.approx([1, 0, 0], abs=1e-6)


@pytest.mark.parametrize("gap", [-0.03, 0.05])
def test_balls(gap: float) -> None:
    balls = ConvexBodies([[ball(0.05, 4).vertices], [ball(0.03, 4).vertices]])
    direction = np.array([0.6, 0.64, 0.48])
    distance, normal = between(balls, direction * (0.08 + gap))
    assert distance == pytest.approx(gap, abs=5e-4)
    assert normal == pytest.approx(direction, abs=0.1)


shifts = st.tuples(*[st.floats(-0.15, 0.15)] * 3).map(np.array)


@given(shifts, shifts)
def test_the_tangent_is_never_above_the_distance(one: FloatArray, other: FloatArray) -> None:
    distance, normal = between(ROCKS, one)
    if np.isnan(normal).any():
        return  # they touch
    assert between(ROCKS, other)[0] >= distance + normal @ (other - one) - 1e-6


@given(shifts)
def test_the_normal_is_the_derivative(shift: FloatArray) -> None:
    distance, normal = between(ROCKS, shift)
    if abs(distance) < 1e-5:
        return
    assert np.linalg.norm(normal) == pytest.approx(1)
    assert between(ROCKS, shift + 1e-4 * normal)[0] == pytest.approx(distance + 1e-4, abs=2e-6)


def test_parts_of_one_body_do_not_meet_each_other() -> None:
    part = box(0.1, 0.1, 0.1).vertices
    bodies = ConvexBodies([[part, part + np.array([0.05, 0, 0])], [part]])
    found = bodies.distances(np.array([[0.0, 0, 0], [0.12, 0, 0]]), reach=1.0)
    assert found.distance == pytest.approx([0.02, -0.03], abs=1e-7)
    assert found.deepest(1).distance == pytest.approx([-0.03], abs=1e-7)
    assert (found.first.tolist(), found.second.tolist()) == ([0, 0], [1, 1])
    assert not len(bodies.distances(np.array([[0.0, 0, 0], [2.0, 0, 0]]), reach=1.0).distance)
    assert not len(bodies.distances(np.zeros((2, 3)), reach=1.0, among=np.array([1])).distance)


def test_sheets_get_a_thickness() -> None:
    sheet = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], np.float64)
    assert np.ptp(solid_hull(sheet), axis=0) == pytest.approx([0.1, 0.1, 5e-4])
    bodies = ConvexBodies([[sheet], [sheet]])
    assert between(bodies, np.array([0, 0, 0.01]))[0] == pytest.approx(0.01 - 5e-4, abs=1e-7)


@pytest.mark.parametrize(
    "points", [np.zeros((5, 3)), np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.0]]), np.full((4, 3), np.nan)]
)
def test_what_has_no_hull_is_refused(points: FloatArray) -> None:
    with pytest.raises(MeshError, match="no convex hull"):
        solid_hull(points)


def test_a_body_needs_a_part() -> None:
    with pytest.raises(MeshError, match="body 1 has no convex part"):
        ConvexBodies([[POINTS[0]], []])


def test_the_table_lies_below_zero() -> None:
    corners, middle = table_box(Tabletop("office_table", (1.2, 0.8)))
    low, high = (corners + middle).min(axis=0), (corners + middle).max(axis=0)
    assert low[:2].tolist() == [0, 0]
    assert high.tolist() == pytest.approx([1.2, 0.8, 0])
