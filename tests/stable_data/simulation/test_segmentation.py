"""Segments of a picture: what is in front hides what is behind, and the pixels are those of the picture."""

import numpy as np
import pytest
import trimesh

from stable_data.geometry.mesh import Mesh
from stable_data.scene import IntArray, Scene, Tabletop
from stable_data.simulation.offscreen import can_render
from stable_data.simulation.segmentation import NOTHING, segment_view

pytestmark = pytest.mark.skipif(not can_render(), reason="this machine cannot render")

SIZE = (160, 120)
EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


def cube(x: float, y: float, side: float = 0.1) -> Mesh:
    made = trimesh.creation.box((side, side, side))
    return Mesh(np.add(made.vertices, (x, y, side / 2)), np.asarray(made.faces))


def segments(*surfaces: Mesh) -> IntArray:
    low, high = np.zeros(3), np.array([1.0, 0.6, 0.3])
    return segment_view(Scene("s", Tabletop("office_table", (1.0, 0.6)), ()), surfaces, low, high, size=SIZE, view="front")


def test_each_surface_is_seen_on_its_side() -> None:
    seen = segments(cube(0.2, 0.3), EMPTY, cube(0.8, 0.3))
    assert seen.shape == SIZE[::-1]
    assert set(np.unique(seen)) == {NOTHING, 0, 2}
    left, right = ((np.nonzero(seen == k)[1]).mean() for k in (0, 2))
    assert left < SIZE[0] / 2 < right
    assert left + right == pytest.approx(SIZE[0] - 1, abs=1.0)


def test_what_is_in_front_hides_what_is_behind() -> None:
    behind = segments(EMPTY, cube(0.5, 0.4))
    both = segments(cube(0.5, 0.28), cube(0.5, 0.4))
    assert 0 < (both == 1).sum() < (behind == 1).sum()
    assert not ((both == 1) & (behind != 1)).any()


def test_nothing_is_seen_of_nothing() -> None:
    flat = Mesh(np.ones((3, 3)) * 0.5, np.array([[0, 1, 2]]))
    assert (segments(EMPTY, EMPTY) == NOTHING).all()
    assert (segments(flat) == NOTHING).all()
    assert (segments() == NOTHING).all()


def test_a_split_surface_covers_the_same_pixels() -> None:
    whole = cube(0.5, 0.3)
    halves = Mesh(whole.vertices, whole.faces[:6]), Mesh(whole.vertices, whole.faces[6:])
    assert ((segments(*halves) != NOTHING) == (segments(whole) == 0)).all()
