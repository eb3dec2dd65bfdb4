"""How boxes are compared and fitted."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stable_data.assets.box_fitting import box_proportions, size_score, stretched_scale, uniform_scale_factor
from stable_data.rotations import rotated_extents
from stable_data.scene import UPRIGHT, QuatXyzw, Vec3
from tests.stable_data.assets.bag_of_words import LAID

EDGE = st.floats(1e-3, 1e3)
BOX = st.tuples(EDGE, EDGE, EDGE)
FACTOR = st.floats(1e-6, 1e6)


def score(one: Vec3, other: Vec3) -> float:
    return float(size_score(box_proportions(one), box_proportions(other)))


@given(BOX, BOX, FACTOR, FACTOR)
def test_the_score_knows_proportions_alone(one: Vec3, other: Vec3, a: float, b: float) -> None:
    enlarged = score((a * one[0], a * one[1], a * one[2]), (b * other[0], b * other[1], b * other[2]))
    assert enlarged == pytest.approx(score(one, other), abs=1e-9)
    assert 0 <= enlarged <= 1


@given(BOX, FACTOR)
def test_a_box_scores_one_with_itself_enlarged_and_its_factor_is_found(box: Vec3, factor: float) -> None:
    wanted = (factor * box[0], factor * box[1], factor * box[2])
    assert score(wanted, box) == pytest.approx(1)
    assert uniform_scale_factor(wanted, box) == pytest.approx(factor)


def test_the_score_is_the_cosine() -> None:
    assert score((3, 4, 0), (4, 3, 0)) == pytest.approx(24 / 25)
    assert score((1, 0, 0), (0, 0, 1)) == 0


@given(BOX, BOX)
def test_no_factor_comes_nearer_and_the_diagonal_is_never_longer(wanted: Vec3, box: Vec3) -> None:
    w, e = np.array(wanted), np.array(box)
    factor = float(uniform_scale_factor(w, e))
    distance = np.linalg.norm(w - factor * e)
    for other in (0.99 * factor, 1.01 * factor):
        assert distance <= np.linalg.norm(w - other * e)
    assert np.linalg.norm(factor * e) <= np.linalg.norm(w) * (1 + 1e-9)
    assert distance == pytest.approx(
        np.linalg.norm(w) * math.sqrt(max(0.0, 1 - score(wanted, box) ** 2)), abs=1e-6 * float(np.linalg.norm(w))
    )


def test_a_sheet_keeps_its_length_however_thin_it_is_wanted() -> None:
    assert uniform_scale_factor((0.21, 0.30, 0.001), (210, 300, 5)) == pytest.approx(0.001, rel=1e-3)


def test_boxes_that_share_no_edge_still_get_a_factor() -> None:
    assert uniform_scale_factor((0.3, 0.0, 0.0), (0.0, 0.0, 2.0)) == pytest.approx(0.15)


TURNS = Rotation.create_group("O").as_quat()


@given(BOX, BOX, st.integers(0, len(TURNS) - 1))
def test_a_stretched_mesh_fills_the_wanted_box_at_every_right_angle(wanted: Vec3, extents: Vec3, turn: int) -> None:
    x, y, z, w = (float(q) for q in TURNS[turn])
    tilt: QuatXyzw = (x, y, z, w)
    scale, distortion = stretched_scale(wanted, rotated_extents(extents, tilt), tilt)
    assert scale is not None
    a, b, c = (s * e for s, e in zip(scale, extents, strict=True))
    assert rotated_extents((a, b, c), tilt) == pytest.approx(wanted)
    assert distortion == pytest.approx(max(scale) / min(scale))


def test_a_laid_bottle_is_stretched_along_its_own_axes() -> None:
    scale, distortion = stretched_scale((0.1, 0.8, 0.1), (1.0, 4.0, 1.0), LAID)
    assert scale == pytest.approx((0.1, 0.1, 0.2))
    assert distortion == pytest.approx(2)


@pytest.mark.parametrize(
    ("wanted", "box", "tilt"),
    [((1, 1, 1), (1, 1, 1), (0.6, 0.0, 0.0, 0.8)), ((1, 1, 0), (1, 1, 1), UPRIGHT), ((1, 1, 1), (1, 1, 0), UPRIGHT)],
)
def test_what_leans_or_is_flat_cannot_be_stretched(wanted: Vec3, box: Vec3, tilt: QuatXyzw) -> None:
    assert stretched_scale(wanted, box, tilt) == (None, math.inf)
