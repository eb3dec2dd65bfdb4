import math
from dataclasses import replace

import numpy as np
import pytest

from stable_data.geometry.shape import Shape
from stable_data.metrics.tidiness import NOTHING, Tidiness
from stable_data.scene import Scene
from tests.models.physics_corrector.certify.things import box, laid

BOOK = box(0.1, 0.1, 0.02)


def row(gap: float, yaw: float = 0.0) -> tuple[Scene, list[Shape]]:
    scene, shapes = laid(("a", BOOK, 0.3, 0.3, 0.0), ("b", BOOK, 0.4 + gap, 0.3, 0.0), ("c", BOOK, 0.5 + 2 * gap, 0.3, 0.0))
    objects = tuple(replace(o, support="table", yaw=yaw) for o in scene.objects)
    return replace(scene, objects=objects), list(shapes)


def test_figures_of_a_row() -> None:
    found = Tidiness.of(*row(0.02))
    assert found.spacing == pytest.approx([20, 20, 20])
    assert found.alignment == pytest.approx([0, 0, 0], abs=1e-9)
    assert found.facing == pytest.approx([0, 0, 0])
    assert Tidiness.of(*row(0.1, math.radians(100))).facing == pytest.approx([10, 10, 10])


def test_a_set_is_like_itself_and_a_wider_row_differs_by_its_spacing() -> None:
    one, other = Tidiness.of(*row(0.02)), Tidiness.of(*row(0.05))
    assert one.distance(one) == (0.0, 0.0, 0.0)
    spacing, alignment, facing = one.distance(other)
    assert spacing == pytest.approx(30)
    assert alignment == pytest.approx(0, abs=1e-9)
    assert facing == 0.0


def test_what_is_alone_has_no_neighbours_and_nothing_has_no_distance() -> None:
    scene, shapes = laid(("a", BOOK, 0.3, 0.3, 0.0))
    alone = Tidiness.of(scene, shapes)
    assert (len(alone.spacing), len(alone.facing)) == (0, 1)
    assert alone.distance(NOTHING) == (None, None, None)
    joined = Tidiness.joined([alone, Tidiness.of(*row(0.02))])
    assert (len(joined.spacing), len(joined.facing)) == (3, 4)
    assert np.array_equal(Tidiness.joined([]).spacing, NOTHING.spacing)
