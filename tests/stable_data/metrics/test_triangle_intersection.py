"""Whether two meshes cross is the same whether all their triangles are asked or the few that are left of them."""

import fcl
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stable_data.metrics.triangle_intersection import MeshPair, PosedTriangles, WorkBudget, boxes, near_triangles
from stable_data.scene import FloatArray
from tests.scenes import ball, bowl, box, sheet, triangles


def brute_force(a: FloatArray, b: FloatArray, shift: FloatArray) -> bool:
    bodies = []
    for soup in (a + shift, b):
        model = fcl.BVHModel()
        model.beginModel(3 * len(soup), len(soup))
        model.addSubModel(soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3))
        model.endModel()
        bodies.append(fcl.CollisionObject(model))
    return bool(fcl.collide(*bodies, fcl.CollisionRequest(), fcl.CollisionResult()) > 0)


def random_soup(rng: np.random.Generator, count: int, largest: float) -> FloatArray:
    centres = rng.uniform(-0.1, 0.1, (count, 1, 3)) * rng.uniform(0.2, 1.0, 3)
    return centres + rng.normal(0, largest * rng.uniform(0.02, 1, (count, 1, 1)), (count, 3, 3))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), few=st.integers(1, 40), many=st.integers(100, 1500), largest=st.floats(1e-4, 0.08),
    apart=st.floats(0.0, 0.25), margin=st.sampled_from([0.0, 5e-4, 3e-3, 5e-2]),
)  # fmt: skip
def test_thinned_meshes_cross_exactly_when_whole_ones_do(
    seed: int, few: int, many: int, largest: float, apart: float, margin: float
) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_soup(rng, many, largest), random_soup(rng, few, largest) + rng.normal(size=3) * apart
    pair = MeshPair(a, b, margin)
    for shift in rng.uniform(-margin, margin, (4, 3)):
        assert pair.cross(shift) == brute_force(a, b, shift)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), margin=st.sampled_from([0.0, 5e-4, 2e-2]))
def test_the_order_of_questions_does_not_matter(seed: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = triangles(ball(0.05, 4)), triangles(bowl(0.06, 0.004), (0.02, 0.0, rng.uniform(-0.02, 0.02), rng.uniform(0, 3)))
    shifts = rng.uniform(-margin, margin, (6, 3))
    pair = MeshPair(a, b, margin)
    answers = [pair.cross(shift, number % 2) for number, shift in enumerate(shifts)]
    assert answers == [MeshPair(a, b, margin).cross(shift) for shift in shifts]
    assert answers == [pair.cross(shift) for shift in shifts]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), margin=st.sampled_from([1e-3, 1e-2]))
def test_no_triangle_within_the_margin_is_dropped(seed: int, margin: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_soup(rng, 250, 0.01), random_soup(rng, 250, 0.01) + np.array([0.12, 0.0, 0.0])
    kept_a, kept_b = near_triangles(a, b, margin)
    corner = np.linalg.norm(a[:, None, :, None] - b[None, :, None, :], axis=-1).min(axis=(2, 3))
    near_a, near_b = np.nonzero(corner <= margin)
    assert np.isin(near_a, kept_a).all()
    assert np.isin(near_b, kept_b).all()


def test_far_meshes_leave_no_triangles() -> None:
    kept_a, kept_b = near_triangles(triangles(box(0.1, 0.1, 0.1)), triangles(box(0.1, 0.1, 0.1), (0.2, 0, 0, 0)), 0.05)
    assert len(kept_a) == len(kept_b) == 0


def test_boxes_that_meet_diagonally_do_not_make_meshes_cross() -> None:
    pair = MeshPair(triangles(ball(0.05)), triangles(ball(0.05), (0.08, 0.08, 0.0, 0.0)), 0.0)
    assert not pair.cross()
    assert pair.contact() is None


def test_crossing_is_symmetric() -> None:
    a, b = triangles(ball(0.05)), triangles(box(0.1, 0.1, 0.1), (0.09, 0.0, 0.0, 0.4))
    there, back = MeshPair(a, b, 0.01), MeshPair(b, a, 0.01)
    for shift in np.random.default_rng(0).uniform(-0.01, 0.01, (20, 3)):
        assert there.cross(shift) == back.cross(-shift)


def test_a_question_is_work_however_few_triangles_there_are() -> None:
    """Else hundreds of boxes in each other took minutes within the limit of half a minute."""
    budget = WorkBudget()
    cube = triangles(box(0.1, 0.1, 0.1))
    pair = MeshPair(cube, cube, 0.001, budget)
    before = budget.spent
    assert pair.cross()
    assert budget.spent - before > 100


def test_moving_both_meshes_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    for gap in (-0.002, 0.002):
        moved = (*rng.uniform(-1, 1, 3), rng.uniform(-3, 3))
        c, s = np.cos(moved[3]), np.sin(moved[3])
        x, y = moved[0] + c * (0.1 + gap), moved[1] + s * (0.1 + gap)
        a, b = triangles(box(0.1, 0.1, 0.1), moved), triangles(box(0.1, 0.1, 0.1), (x, y, moved[2], moved[3]))
        assert MeshPair(a, b, 0.0).cross() == (gap < 0)


def test_thin_sheets_cross_and_clear_each_other() -> None:
    lying = triangles(sheet(0.2, 0.2))
    standing = lying[:, :, [2, 1, 0]]  # in the plane x = 0
    assert MeshPair(lying, standing, 0.0).cross()
    assert MeshPair(lying, standing, 0.2).cross((0.0, 0.0, 0.099))
    assert not MeshPair(lying, standing, 0.2).cross((0.0, 0.0, 0.101))


def test_a_contact_names_the_faces_that_touch() -> None:
    contact = MeshPair(triangles(box(0.1, 0.1, 0.1), (0, 0, 0.0999, 0)), triangles(box(0.2, 0.2, 0.1)), 0.0).contact()
    assert contact is not None
    assert not contact.is_cut_short
    assert contact.normals_b[:, 2].max() == pytest.approx(1.0)
    assert (
        np.abs(contact.normals_a[:, 2]).max() == 0.0
    )  # the sides reach through it; the bottom is below it and touches nothing


def test_more_contacts_than_are_kept_are_reported_as_cut_short() -> None:
    a, b = triangles(ball(0.05, 5)), triangles(ball(0.05, 5), (0.05, 0.001, 0.002, 0.1))
    few, every = MeshPair(a, b, 0.0).contact(), MeshPair(a, b, 0.0).contact(every=True)
    assert few is not None
    assert every is not None
    assert few.is_cut_short
    assert not every.is_cut_short
    assert len(every.normals_a) > len(few.normals_a)


def test_boxes_are_coordinates_first() -> None:
    soup = np.random.default_rng(0).normal(size=(7, 3, 3))
    low, high = boxes(soup)
    assert np.array_equal(low.T, soup.min(axis=1))
    assert np.array_equal(high.T, soup.max(axis=1))
    assert np.array_equal(PosedTriangles(soup).box[0], soup.min(axis=(0, 1)))
