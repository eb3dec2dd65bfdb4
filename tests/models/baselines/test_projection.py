"""The projection: least shifts, feasibility of what it gives, and honesty where there is no room."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.baselines.hulls import ConvexBodies
from models.baselines.projection import Freedom, ProjectionSettings, least_shift, project
from stable_data.scene import FloatArray
from tests.scenes import box

SETTINGS = ProjectionSettings(gap=0.0, influence=0.03, tolerance=3e-5, max_iterations=200)
CUBE = box(0.1, 0.1, 0.1).vertices
PARTED = np.array([[-0.01, 0, 0], [0.01, 0, 0]])


def anywhere(count: int) -> Freedom:
    far = np.full((count, 3), np.inf)
    return Freedom(np.ones((count, 3), np.bool_), -far, far)


def test_the_least_shift_of_one_constraint_goes_along_it() -> None:
    row = np.array([[3.0, 4.0]])
    assert least_shift(row, np.array([1.0])) == pytest.approx([0.12, 0.16], abs=1e-6)
    assert least_shift(row, np.array([-1.0])).tolist() == [0, 0]


@given(st.integers(0, 10**6))
def test_the_least_shift_is_feasible_and_no_other_is_shorter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, inside = rng.normal(size=(5, 8)), rng.normal(size=8)
    wanted = rows @ inside - rng.uniform(0, 1, 5)  # `inside` satisfies them
    shift = least_shift(rows, wanted)
    assert (rows @ shift >= wanted - 1e-4).all()
    assert shift @ shift <= inside @ inside + 1e-6
    # The shortest point of a convex set makes no acute angle with the way to any other.
    assert shift @ (inside - shift) >= -1e-4


def test_two_cubes_share_the_way() -> None:
    bodies = ConvexBodies([[CUBE], [CUBE]])
    start = np.array([[0.0, 0, 0], [0.08, 0.01, 0.02]])
    found = project(bodies, start, anywhere(2), SETTINGS)
    assert found.converged
    assert found.positions == pytest.approx(start + PARTED, abs=2e-5)


def test_a_gap_is_kept_and_what_is_fixed_stays() -> None:
    bodies = ConvexBodies([[CUBE], [CUBE]])
    start = np.array([[0.0, 0, 0], [0.08, 0.01, 0.02]])
    freedom = anywhere(2)
    freedom.is_free[0] = False
    found = project(bodies, start, freedom, ProjectionSettings(0.01, 0.2, 1e-5, 200))
    assert found.converged
    assert found.positions == pytest.approx(np.array([[0, 0, 0], [0.11, 0.01, 0.02]]), abs=2e-5)


def test_bodies_that_are_left_out_are_not_there() -> None:
    bodies = ConvexBodies([[CUBE]] * 3)
    start = np.array([[0.0, 0, 0], [0.08, 0.01, 0.02], [0.0, 0.01, 0.01]])
    found = project(bodies, start, anywhere(3), SETTINGS, among=np.array([0, 1]))
    assert found.converged
    assert found.positions[2].tolist() == start[2].tolist()
    assert found.positions[:2] == pytest.approx(start[:2] + PARTED, abs=2e-5)


@settings(max_examples=20)
@given(st.integers(0, 10**6))
def test_what_it_calls_solved_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hulls: list[list[FloatArray]] = [[rng.normal(0.0, 0.03, (12, 3))] for _ in range(8)]
    bodies, start = ConvexBodies(hulls), rng.uniform(0, 0.15, (8, 3))
    found = project(bodies, start, anywhere(8), SETTINGS)
    assert found.converged, found.reason
    assert bodies.distances(found.positions, 1.0).distance.min() >= -3e-5


def test_without_room_it_says_so() -> None:
    bodies = ConvexBodies([[CUBE]] * 3)
    start = np.array([[0.05, 0, 0], [0.1, 0, 0], [0.15, 0, 0]])
    is_free = np.tile([True, False, False], (3, 1))
    freedom = Freedom(is_free, np.full((3, 3), 0.0), np.full((3, 3), 0.25))
    fits = project(bodies, start, freedom, SETTINGS)
    assert fits.converged
    tight = Freedom(is_free, np.full((3, 3), 0.05), np.full((3, 3), 0.2))
    found = project(bodies, start, tight, SETTINGS)
    assert not found.converged
    assert found.missed == pytest.approx(0.0125, abs=1e-4)  # 5 cm too little, shared by two gaps and two limits
    assert "nearer than allowed" in found.reason


def test_it_stops_in_time() -> None:
    bodies = ConvexBodies([[CUBE], [CUBE]])
    start = np.array([[0.0, 0, 0], [0.08, 0.01, 0.02]])
    for bounded, words in (
        (ProjectionSettings(0.0, 0.03, 1e-5, 9, max_seconds=-1.0), "out of time"),
        (ProjectionSettings(0.0, 0.03, 1e-5, 1), "still moving"),
    ):
        found = project(bodies, start, anywhere(2), bounded)
        assert not found.converged
        assert words in found.reason


def test_concentric_bodies_are_parted() -> None:
    bodies = ConvexBodies([[CUBE], [CUBE / 2]])
    found = project(bodies, np.zeros((2, 3)), anywhere(2), SETTINGS)
    assert found.converged
    assert np.abs(found.positions[0] - found.positions[1]).max() == pytest.approx(0.075, abs=1e-4)


def test_it_gives_up_where_the_only_way_out_is_barred() -> None:
    bodies = ConvexBodies([[CUBE], [CUBE / 2]])
    start = np.array([[0.0, 0, 0], [0.0, 0, -0.02]])  # nearest out is down, where nothing may go
    is_free = np.array([[False, False, False], [False, False, True]])
    low, high = np.full((2, 3), -0.02), np.full((2, 3), 0.03)
    found = project(bodies, start, Freedom(is_free, low, high), ProjectionSettings(0.01, 0.2, 1e-5, 50_000))
    assert not found.converged
    assert found.num_iterations < 500
