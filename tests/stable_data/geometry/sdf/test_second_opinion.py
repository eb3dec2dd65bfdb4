from dataclasses import replace

import numpy as np
import pytest
import trimesh

from stable_data.errors import ConfigError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.sdf import second_opinion as module
from stable_data.geometry.sdf.build import build_grid
from stable_data.geometry.sdf.second_opinion import PysdfDistance, build_grid_by_pysdf, has_pysdf, second_opinion

pytestmark = pytest.mark.skipif(not has_pysdf(), reason="pysdf is not installed")

ONE = (1.0, 1.0, 1.0)


def plate_with_a_ball() -> Mesh:
    """A thin plate of two long triangles a side, and a finely meshed ball above it: nearest vertices mislead there."""
    plate = trimesh.creation.box((1.0, 0.8, 0.05))
    ball = trimesh.creation.icosphere(4, 0.1).apply_translation((0.1, 0.0, 0.3))
    both = trimesh.util.concatenate([plate, ball])
    return Mesh(np.asarray(both.vertices, np.float64), np.asarray(both.faces, np.int64))


def test_distances_to_a_ball_are_right_on_both_sides() -> None:
    ball = trimesh.creation.icosphere(4, 0.5)
    distance = PysdfDistance(Mesh(np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)))
    points = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.9, 0.0]])
    assert distance(points) == pytest.approx([-0.5, -0.2, 0.4], abs=3e-3)


def test_a_right_grid_is_agreed_with_and_a_wrong_one_is_not() -> None:
    mesh = plate_with_a_ball()
    grid = build_grid(mesh)
    right = second_opinion(grid, mesh, ONE)
    assert (right.agreement, right.sign_disagreement) == (1.0, 0.0)
    assert not right.disagrees
    turned = second_opinion(replace(grid, values=-grid.values), mesh, ONE)
    assert turned.sign_disagreement == 1.0
    shifted = second_opinion(replace(grid, values=grid.values + np.float16(3 * grid.spacing)), mesh, ONE)
    assert shifted.agreement < 0.1
    assert turned.disagrees
    assert shifted.disagrees


def test_a_grid_by_pysdf_has_its_measured_errors() -> None:
    mesh = plate_with_a_ball()
    grid, exact = build_grid_by_pysdf(mesh), build_grid(mesh)
    assert grid.values.shape == exact.values.shape
    assert np.abs(grid.values.astype(np.float64) - exact.values).max() < 0.02
    assert 0 < grid.max_error < 0.05
    assert np.array_equal(build_grid_by_pysdf(mesh, is_sheet=True).values, build_grid(mesh, is_sheet=True).values)


def test_without_pysdf_there_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pysdf is not installed.*\[pysdf\]"):
        PysdfDistance(plate_with_a_ball())
