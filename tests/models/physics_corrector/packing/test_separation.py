"""Parting of crowds: the quadratic programme, relations won back, bodies left out and put back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.physics_corrector.packing.no_fit_polygon import RigidGroup, no_fit
from models.physics_corrector.packing.packing_problem import AXES, BodyArrays, OrderConstraint, PackingProblem
from models.physics_corrector.packing.projection import box_dual, is_free_of_overlap, project
from models.physics_corrector.packing.relation_recovery import recover_relations
from models.physics_corrector.packing.separation import separate_bodies
from models.physics_corrector.packing.slab_outline import rectangle
from models.physics_corrector.packing.subset_packing import pack_subset
from stable_data.scene import FloatArray, RelationKind


def crowd_of(
    sizes: list[tuple[float, float]], places: FloatArray, table: tuple[float, float], orders: tuple[OrderConstraint, ...] = ()
) -> PackingProblem:
    """Rectangles at their middles on a table."""
    halves = np.array(sizes) / 2
    parts = [RigidGroup(rectangle(-half, half), place) for half, place in zip(halves, places, strict=True)]
    low, high = halves - places, np.array(table) - halves - places
    bodies = BodyArrays(np.ones(len(sizes)), np.zeros_like(places), low, high)
    return PackingProblem(no_fit(parts), np.arange(len(sizes)), bodies, orders, 5e-4)


def order(first: int, second: int, kind: RelationKind, places: FloatArray) -> OrderConstraint:
    return OrderConstraint(first, second, np.array(AXES[kind]), places[first] - places[second])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 30), st.integers(1, 12))
def test_the_dual_is_solved_whatever_it_starts_from(seed: int, num_rows: int, num_columns: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, linear = rng.normal(size=(num_rows, num_columns)), rng.normal(size=num_rows)
    upper = rng.uniform(0.1, 3.0, num_rows)
    for start in (np.zeros(num_rows), rng.uniform(0.0, 5.0, num_rows)):
        x = box_dual(matrix, linear, upper, start, 200)
        gradient = matrix @ (x @ matrix) - linear + 2e-4 * x
        assert (x >= 0).all()
        assert (x <= upper).all()
        # Karush-Kuhn-Tucker: no step within the bounds goes down.
        assert np.abs(x - np.clip(x - gradient, 0.0, upper)).max() < 1e-3


def test_two_bodies_part_evenly() -> None:
    crowd = crowd_of([(0.1, 0.1), (0.1, 0.1)], np.array([[0.48, 0.5], [0.52, 0.5]]), (1.0, 1.0))
    shifts, is_parted = project(crowd, np.zeros((2, 2)), np.zeros((2, 2)), 16)
    assert is_parted
    assert shifts[1] - shifts[0] == pytest.approx((0.0605, 0.0), abs=3e-4)
    assert shifts.sum(axis=0) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_a_relation_that_was_given_up_is_won_back() -> None:
    places = np.array([[0.3, 0.3], [0.6, 0.3], [0.45, 0.6]])
    crowd = crowd_of([(0.1, 0.1)] * 3, places, (1.0, 0.8), (order(0, 1, RelationKind.LEFT_OF, places),))
    swapped = np.array([[0.45, 0.0], [0.0, 0.0], [0.0, 0.0]])
    assert crowd.broken(swapped).all()
    shifts = recover_relations(crowd, swapped, np.zeros((3, 2)), 8)
    assert not crowd.broken(shifts).any()
    assert is_free_of_overlap(crowd, shifts)
    assert np.abs(shifts).max() < 0.01


def test_only_the_bodies_around_one_make_room_for_it() -> None:
    """A row of squares, of which each touches the next: two rings around the third are the first five."""
    places = np.column_stack([0.1 + 0.11 * np.arange(8), np.full(8, 0.3)])
    crowd = crowd_of([(0.1, 0.1)] * 8, places, (1.2, 0.6), (order(0, 7, RelationKind.LEFT_OF, places),))
    around = crowd.around(2, np.zeros((8, 2)), 0.03, 2)
    assert np.flatnonzero(around.is_free).tolist() == [0, 1, 2, 3, 4]
    assert len(around.orders) == 1
    there = np.zeros((8, 2))
    there[2] = (0.05, 0.0)
    shifts, is_parted = project(around, there, there, 16)
    assert is_parted
    np.testing.assert_array_equal(shifts[5:], 0.0)
    assert is_free_of_overlap(crowd, shifts)


def test_bodies_that_are_without_leave_no_trace() -> None:
    places = np.array([[0.3, 0.3], [0.32, 0.3], [0.7, 0.3]])
    crowd = crowd_of([(0.1, 0.1)] * 3, places, (1.0, 0.6), (order(0, 2, RelationKind.LEFT_OF, places),))
    fewer = crowd.without([0])
    assert not is_free_of_overlap(crowd, np.zeros((3, 2)))
    assert is_free_of_overlap(fewer, np.zeros((3, 2)))
    assert not fewer.orders
    assert len(fewer.broken(np.zeros((3, 2)))) == 0
    shifts, is_parted = project(fewer, np.zeros((3, 2)), np.zeros((3, 2)), 4)
    assert is_parted
    assert not shifts.any()


def test_what_was_left_out_is_put_back_where_there_is_room() -> None:
    places = np.array([[0.15, 0.15], [0.16, 0.15], [0.15, 0.16], [0.2, 0.2], [0.2, 0.21]])
    crowd = crowd_of([(0.2, 0.2)] * 3 + [(0.09, 0.09)] * 2, places, (0.42, 0.42))
    found = pack_subset(crowd, np.zeros((5, 2)), [])
    assert found is not None
    shifts, out = found
    assert not out
    assert is_free_of_overlap(crowd, shifts)


@pytest.mark.parametrize("spare", [[], [4], [3, 4, 0]])
def test_only_what_may_be_left_out_is(spare: list[int]) -> None:
    places = np.array([[0.1, 0.1], [0.3, 0.1], [0.1, 0.3], [0.3, 0.3], [0.2, 0.2]])
    crowd = crowd_of([(0.2, 0.2)] * 4 + [(0.1, 0.1)], places, (0.402, 0.402))
    found = separate_bodies(crowd, np.zeros((5, 2)), spare, 4)
    if not spare:
        assert found is None
        return
    assert found is not None
    shifts, out = found
    assert len(out) == 1
    assert set(out) <= set(spare)
    assert is_free_of_overlap(crowd.without(out), shifts)
